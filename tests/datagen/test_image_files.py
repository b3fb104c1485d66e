# SPDX-License-Identifier: GPL-3.0-or-later
import numpy as np
import OpenEXR
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from timesplat.datagen import image_files

shapes = st.tuples(st.integers(1, 40), st.integers(1, 20))


@given(hnp.arrays(np.uint8, shapes.map(lambda s: (*s, 4))))
def test_png_round_trip(tmp_path_factory, rgba):
    path = tmp_path_factory.getbasetemp() / "x.png"
    image_files.write_png(path, rgba)
    with Image.open(path) as im:
        assert im.mode == "RGBA" and np.array_equal(np.asarray(im), rgba)


@given(shapes, st.integers(0, 99), st.booleans())
def test_exr_is_what_openexr_reads_and_reads_what_it_writes(tmp_path_factory, shape, seed, smooth):
    path, rng = tmp_path_factory.getbasetemp() / "x.exr", np.random.default_rng(seed)
    x = np.zeros(shape) if smooth else rng.normal(size=shape)
    channels = {"B": x.astype(np.float16), "Z": (x * 3).astype(np.float32), "a.b.X": x.astype(np.float32)}
    image_files.write_exr(path, channels)
    with OpenEXR.File(str(path), separate_channels=True) as f:
        assert all(np.array_equal(f.channels()[k].pixels, v) for k, v in channels.items())
    with pytest.raises(ValueError, match="compressed"):
        image_files.read_exr(path)
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    parts = [OpenEXR.Part(dict(header), {k: v}, name=k) for k, v in channels.items()]
    OpenEXR.File(parts).write(str(path))
    read = image_files.read_exr(path)
    assert all(np.array_equal(read[k], v) for k, v in channels.items())
