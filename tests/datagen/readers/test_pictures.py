# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of every kind as RGBA of one size."""

import numpy as np
import pytest
from PIL import Image

from timesplat.datagen.readers.lenses import Lens
from timesplat.datagen.readers.pictures import (
    Pictures,
    Source,
    background_of,
    read_mask,
    read_picture,
    scaled_to,
    size_of,
)
from timesplat.datagen.sequence import InputError, View

REMEDY = "do something"


def view(name):
    return View(0, "0", "", np.eye(4), 1, 1, 0, 0, name)


def test_kinds(tmp_path):
    ramp = np.arange(0, 256, 17, np.uint8).reshape(4, 4)
    Image.fromarray(ramp.astype(np.uint16) * 257).save(tmp_path / "deep.png")
    Image.fromarray(ramp).save(tmp_path / "grey.png")
    Image.fromarray(np.dstack([ramp] * 3)).quantize(16).save(tmp_path / "palette.png")
    Image.fromarray(np.dstack([ramp, 255 - ramp]), "LA").save(tmp_path / "la.png")
    assert Image.open(tmp_path / "deep.png").mode.startswith("I")
    for name in ("deep", "grey", "palette", "la"):
        rgba = read_picture(tmp_path / f"{name}.png", True, REMEDY)
        assert rgba.shape == (4, 4, 4) and (rgba[..., :3] == ramp[..., None]).all(), name
        assert (rgba[..., 3] == (255 - ramp if name == "la" else 255)).all()
    assert size_of(tmp_path / "la.png", True, REMEDY) == ((4, 4), False, True)
    assert size_of(tmp_path / "deep.png", True, REMEDY)[2] is False


def test_exif_turns_where_it_is_asked(tmp_path):
    picture = np.zeros((4, 6, 3), np.uint8)
    picture[0, 0] = 255
    exif = Image.Exif()
    exif[0x0112] = 6  # a quarter to the right
    Image.fromarray(picture).save(tmp_path / "a.png", exif=exif)
    assert size_of(tmp_path / "a.png", True, REMEDY)[:2] == ((4, 6), True)
    assert size_of(tmp_path / "a.png", False, REMEDY)[:2] == ((6, 4), True)
    turned = read_picture(tmp_path / "a.png", True, REMEDY)
    assert turned.shape == (6, 4, 4) and turned[0, 3, 0] == 255
    assert read_picture(tmp_path / "a.png", False, REMEDY)[0, 0, 0] == 255


def test_masks(tmp_path):
    inside = np.zeros((4, 6), np.uint8)
    inside[1:3, 2:5] = 1
    Image.fromarray(inside).save(tmp_path / "ones.png")
    Image.fromarray(inside.astype(bool)).save(tmp_path / "bits.png")
    Image.fromarray(inside * np.uint8(255)).save(tmp_path / "bytes.png")
    Image.fromarray(inside.astype(np.uint16) * 65535).save(tmp_path / "deep.png")
    Image.fromarray(np.dstack([inside * 0] * 3 + [inside * 255])).save(tmp_path / "alpha.png")
    for name in ("ones", "bits", "bytes", "deep", "alpha"):
        assert (read_mask(tmp_path / f"{name}.png", REMEDY) == inside * 255).all(), name


def test_damage_is_named(tmp_path):
    (tmp_path / "a.png").write_bytes(b"\x89PNG no")
    for call in (lambda p: read_picture(p, True, REMEDY), lambda p: size_of(p, True, REMEDY)):
        with pytest.raises(InputError, match=r"a\.png: the image cannot be read .*; do something"):
            call(tmp_path / "a.png")
        with pytest.raises(InputError, match=r"b\.png: the image is missing; do something"):
            call(tmp_path / "b.png")
    with pytest.raises(InputError, match=r"a\.png: the mask cannot be read"):
        read_mask(tmp_path / "a.png", REMEDY)


def blob(size, at, radius):
    """A soft spot: its middle of mass is at `at`, in pixels."""
    y, x = np.meshgrid(np.arange(size[1]) + 0.5, np.arange(size[0]) + 0.5, indexing="ij")
    alpha = np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / 2 / radius**2)
    return np.rint(np.dstack([np.full((size[1], size[0], 3), 90.0), 255 * alpha])).astype(np.uint8)


@pytest.mark.parametrize("other", [(32, 24), (128, 96), (96, 96), (40, 72)])
def test_brought_to_one_size_with_exact_intrinsics(tmp_path, other):
    """What a ray shows in a picture of another size, it shows after that is resized."""
    ray = np.array([0.07, -0.04])
    lenses = [Lens(64, 48, 60, 60, 31, 26)] * 2 + [
        Lens(*other, 0.9 * other[0], 1.1 * other[1], 0.45 * other[0], 0.55 * other[1])
    ]
    sources = {}
    for k, lens in enumerate(lenses):
        at = ray * (lens.fx, lens.fy) + (lens.cx, lens.cy)
        Image.fromarray(blob((lens.width, lens.height), at, lens.width / 20)).save(tmp_path / f"{k}.png")
        sources[f"{k}.png"] = Source(tmp_path / f"{k}.png", None, lens)
    pictures = Pictures(sources, None, True, REMEDY)
    assert (pictures.width, pictures.height) == (64, 48)
    for name in sources:
        fx, fy, cx, cy = pictures.intrinsics(name)
        rgba = pictures(view(name))
        assert rgba.shape == (48, 64, 4) and np.abs(rgba[..., :3][rgba[..., 3] > 100].astype(int) - 90).max() <= 3
        a = rgba[..., 3].astype(float)
        mass = np.array([(a.sum(0) * (np.arange(64) + 0.5)).sum(), (a.sum(1) * (np.arange(48) + 0.5)).sum()]) / a.sum()
        np.testing.assert_allclose(mass, ray * (fx, fy) + (cx, cy), atol=0.1)


def test_a_scene_without_alpha_is_filled(tmp_path):
    for k, size in enumerate([(20, 10), (20, 10), (10, 20)]):
        Image.new("RGB", size, (9, 99, 199)).save(tmp_path / f"{k}.png")
    sources = {
        f"{k}.png": Source(tmp_path / f"{k}.png", None, Lens(*s, 10, 10, s[0] / 2, s[1] / 2))
        for k, s in enumerate([(20, 10), (20, 10), (10, 20)])
    }
    whole, fitted = (Pictures(sources, None, has_alpha, REMEDY) for has_alpha in (False, True))
    assert whole.intrinsics("2.png") == (20, 20, 10, 5) and fitted.intrinsics("2.png") == (5, 5, 10, 5)
    assert (whole(view("2.png")) == (9, 99, 199, 255)).all()


def test_alpha_alone_reads_the_mask_alone(tmp_path):
    mask = np.zeros((8, 16), np.uint8)
    mask[:, :8] = 255
    Image.fromarray(mask).save(tmp_path / "m.png")
    pictures = Pictures(
        {"a": Source(tmp_path / "none.png", tmp_path / "m.png", Lens(16, 8, 9, 9, 8, 4))}, None, True, ""
    )
    assert pictures.alpha(view("a"), 4).tolist() == [[1, 1, 0, 0]] * 2


def test_what_is_said_of_backgrounds(tmp_path):
    Image.new("RGB", (8, 8), (255, 255, 255)).save(tmp_path / "a.png")
    noise = np.random.default_rng(0).integers(0, 256, (8, 8, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "b.png")
    white, none = (Source(tmp_path / n, None, Lens(8, 8, 9, 9, 4, 4)) for n in ("a.png", "b.png"))
    masked = Source(tmp_path / "a.png", tmp_path / "a.png", white.lens)
    found, told = background_of([white], False, False, "auto", REMEDY)
    assert found and found.colour == (255, 255, 255) and "#ffffff" in told and "as measured" in told
    found, told = background_of([none], False, False, "auto", REMEDY)
    assert found is None and "the whole scene" in told
    assert background_of([none], False, False, "black", REMEDY)[0].colour == (0, 0, 0)
    assert background_of([white], False, True, "auto", REMEDY) == (None, "alpha says what is the object")
    assert "1 pictures have none" in background_of([masked, none], True, False, "auto", REMEDY)[1]


def test_another_size_of_the_same_shape():
    lens = Lens(64, 48, 60, 61, 31, 26)
    assert scaled_to(lens, (64, 48)) is lens
    assert scaled_to(lens, (32, 24)) == Lens(32, 24, 30, 30.5, 15.5, 13)
    assert scaled_to(lens, (48, 64)) is None and scaled_to(lens, (64, 40)) is None
