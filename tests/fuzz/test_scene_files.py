# SPDX-License-Identifier: GPL-3.0-or-later
"""Damaged pictures with cameras, in every layout: one sentence, or cameras and pictures that are sound."""

import functools
import json
import random
import shutil
import struct
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from timesplat.datagen.errors import InputError
from timesplat.datagen.image_files import read_exr, write_exr
from timesplat.datagen.passes import Passes, read_passes, write_passes
from timesplat.datagen.readers import open_sequence
from timesplat.datagen.scene.gltf import check_gltf
from timesplat.datagen.sequence import Sequence, View, write_sequence
from timesplat.datagen.track_file import SurfaceTracks, read_tracks, write_tracks

from ..datagen.readers import worlds
from .damage import damaged, damaged_json, is_a_sentence, no_hang, suite


def _ours(folder: Path, taken) -> None:
    seq = Sequence(24, 20, 24.0, 0, 11)
    for k, shot in enumerate(taken):
        lens = shot.lens
        seq.views.append(View(k, "0", "random", shot.c2w, lens.fx, lens.fy, lens.cx, lens.cy, f"images/{k:04d}.png"))
    write_sequence(seq, folder, lambda root: worlds.write_pictures(root, taken))


@functools.cache
def layouts() -> Path:
    """A folder with a small scene in each layout."""
    root = Path(tempfile.mkdtemp(prefix="timesplat-fuzz-"))
    taken = worlds.shots(4)
    _ours(root / "ours", taken)
    worlds.write_pictures(worlds.write_transforms(root / "nerfstudio", taken), taken)
    for name in ("text", "binary"):
        names, points = [f"{k:04d}.png" for k in range(len(taken))], worlds.BALLS.tolist()
        worlds.write_pictures(worlds.write_colmap(root / name, taken, names, name == "binary", points=points), taken)
    groups = [[replace(s, camera=str(k)) for k, s in enumerate(taken)] for _ in range(2)]
    worlds.write_panoptic(root / "panoptic", groups)
    return root


def check_layout(seed: int) -> None:
    r = random.Random(seed)
    source = layouts() / r.choice(("ours", "nerfstudio", "text", "binary", "panoptic"))
    with tempfile.TemporaryDirectory() as tmp, no_hang(60):
        folder = Path(tmp) / "scene"
        shutil.copytree(source, folder)
        files = sorted(f for f in folder.rglob("*") if f.is_file())
        told = [f for f in files if f.suffix not in (".png", ".jpg")]
        file = r.choice(told if r.random() < 0.85 else files)
        if file.suffix == ".json":
            file.write_text(damaged_json(file.read_text(), r))
        else:
            file.write_bytes(damaged(file.read_bytes(), r, 200))
        try:
            seq = open_sequence(folder)
            pictures = [seq.load_image(i) for i in range(len(seq.views))]
        except InputError as e:
            is_a_sentence(e, tmp)
            return
        assert all(p.shape == (seq.height, seq.width, 4) and p.dtype == np.uint8 for p in pictures)
        for v in seq.views:
            assert np.isfinite(v.c2w).all() and np.isfinite([v.fx, v.fy, v.cx, v.cy, v.frame]).all() and v.fx > 0
        assert np.isfinite(seq.times()).all() and np.abs(seq.times()).max(initial=0) < 1e6


test_damaged_layouts, test_damaged_layouts_by_the_thousand = suite(check_layout, 100)


# ---------------------------------------------------------------- single files


@functools.cache
def single() -> dict[str, bytes]:
    found = {}
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as tmp:
        file = Path(tmp) / "a"
        turn = np.zeros((3, 5, 4), np.float16)
        turn[..., 0] = 1
        ends = np.zeros(3, np.int32), np.full(3, 4, np.int32)
        write_tracks(
            file.with_suffix(".npz"), SurfaceTracks(np.ones((3, 5, 3), np.float32), turn, *ends, np.ones(3, np.float32))
        )
        found[".npz"] = file.with_suffix(".npz").read_bytes()
        flow = rng.normal(size=(2, 6, 5, 2)).astype(np.float32)
        write_passes(file.with_suffix(".exr"), Passes(np.ones((6, 5), np.float32), *flow))
        found["passes.exr"] = file.with_suffix(".exr").read_bytes()
        write_exr(file.with_suffix(".exr"), {"R": np.ones((6, 5), np.float32)})
        found["ours.exr"] = file.with_suffix(".exr").read_bytes()
    points = rng.normal(size=(5, 3)).astype("<f4").tobytes()
    document = {
        "asset": {"version": "2.0"}, "buffers": [{"byteLength": len(points)}],
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": len(points)}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 5, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
    }  # fmt: skip
    found[".gltf"] = json.dumps(document).encode()
    text = found[".gltf"] + b" " * (-len(found[".gltf"]) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(points), b"BIN\0") + points
    found[".glb"] = struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
    return found


def check_single(seed: int) -> None:
    r = random.Random(seed)
    name = r.choice(sorted(single()))
    with tempfile.TemporaryDirectory() as tmp, no_hang():
        path = Path(tmp) / f"a{name}"
        if name == ".gltf":
            path.write_text(damaged_json(single()[name].decode(), r))
        elif name == ".glb" and r.random() < 0.5:
            data = single()[name]
            length = struct.unpack_from("<I", data, 12)[0]
            text = damaged_json(data[20 : 20 + length].decode(), r).encode()
            path.write_bytes(data[:12] + struct.pack("<I4s", len(text), b"JSON") + text + data[20 + length :])
        else:
            path.write_bytes(damaged(single()[name], r, 300))
        try:
            if name == ".npz":
                tracks = read_tracks(path, 5)
                assert np.isfinite(tracks.position).all()
            elif name == "passes.exr":
                passes = read_passes(path, (6, 5))
                assert not np.isnan(passes.depth).any() and np.isfinite(passes.flow_next).all()
            elif name == "ours.exr":
                read_exr(path)
            else:
                check_gltf(path, path.parent)
        except InputError as e:
            is_a_sentence(e, path)
        except (ValueError, OSError):  # `Sequence.load_tracks` turns it into a sentence
            assert name in (".npz", "ours.exr")
        except (struct.error, IndexError, KeyError):  # as `capture._read` does of what Blender wrote
            assert name == "ours.exr"


def test_a_zip_of_a_kind_that_python_does_not_know():
    check_single(132_172_960_312)


test_damaged_single_files, test_damaged_single_files_by_the_thousand = suite(check_single, 200)
