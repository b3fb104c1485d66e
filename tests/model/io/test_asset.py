# SPDX-License-Identifier: GPL-3.0-or-later
"""The asset: its arrays, what they mean at a time, and what is refused."""

import os

import numpy as np
import pytest

from timesplat.datagen.sequence import InputError
from timesplat.model.io.asset import (
    ARRAYS,
    MAX_CLIP_FRAMES,
    MAX_FRAME_NUMBER,
    Clip,
    check,
    linear_from_srgb,
    near_origin,
    sound_part,
    srgb_from_linear,
    static_asset,
    wxyz_from_xyzw,
    xyzw_from_wxyz,
)
from timesplat.model.io.ply import write_ply

from ...assets import assert_same, make_asset, tracked_asset


def test_at_is_the_kinematic_form():
    a = make_asset(clip=Clip(12.5, 3, 26))
    p, o = a.at(0.25)
    np.testing.assert_allclose(p, a.xyz + a.velocity * (0.25 - a.t)[:, None], atol=1e-6)
    np.testing.assert_allclose(o, a.opacity * np.exp(-0.5 * ((0.25 - a.t) / a.sigma_t) ** 2), atol=1e-6)
    assert p.dtype == o.dtype == np.float32
    assert [a.frame_to_time(f) for f in (3, 26)] == [-1, 1] and abs(a.frame_to_time(14.5)) < 1e-12
    assert Clip(24, 5, 5).frame_to_time(5) == 0
    np.testing.assert_allclose(a.clip.frame_to_time(np.array([3, 26])), [-1, 1])


def test_softened_is_what_a_blurring_rasteriser_shows():
    a = make_asset(clip=Clip(pixel=0.02))
    np.testing.assert_allclose(a.soft_scale() ** 2, a.scale**2 + 0.1 * 0.02**2, rtol=1e-5)
    soft = a.softened()
    np.testing.assert_array_equal(soft.scale, a.soft_scale())
    np.testing.assert_array_equal(soft.scale, soft.soft_scale())
    assert soft.xyz is a.xyz and a.clip.pixel == 0.02
    check(soft)


@pytest.mark.parametrize("name", ARRAYS)
def test_check_names_the_array(name, tmp_path):
    for value, word in ((np.nan, "NaN"), (np.inf, "NaN")):
        a = make_asset(5)
        getattr(a, name).flat[-1] = value
        with pytest.raises(InputError, match=f"{name} holds {word}.*1 of 5"):
            write_ply(tmp_path / "a.ply", a)
    a = make_asset(5)
    setattr(a, name, getattr(a, name).astype(np.float64))
    with pytest.raises(InputError, match=f"{name} is not a float32"):
        check(a)
    a = make_asset(5)
    setattr(a, name, getattr(a, name)[:4])
    with pytest.raises(InputError):
        check(a)
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize(("name", "value"), [("scale", 0), ("sigma_t", -1), ("opacity", 1.1), ("rotation", 3)])
def test_check_knows_the_ranges(name, value):
    a = make_asset(5)
    getattr(a, name).flat[0] = value
    with pytest.raises(InputError, match=name):
        check(a)


@pytest.mark.parametrize(
    ("clip", "words"),
    [
        (Clip(0), "fps and scale must be positive"),
        (Clip(frame_start=3, frame_end=2), "frame range is empty"),
        (Clip(frame_end=MAX_CLIP_FRAMES), "too many or too far"),
        (Clip(frame_start=-MAX_FRAME_NUMBER - 1, frame_end=-MAX_FRAME_NUMBER - 1), "too many or too far"),
    ],
)
def test_check_knows_what_a_clip_can_be(clip, words):
    with pytest.raises(InputError, match=f"^the asset: .*{words}"):
        check(make_asset(5, clip=clip))


def test_a_path_that_leads_beyond_all_bounds_is_refused():
    """Its numbers are finite; places on it would be NaN."""
    asset = tracked_asset(8)
    asset.paths.place[1] = 3e38
    with pytest.raises(InputError, match="beyond all bounds"):
        check(asset)


def test_soft_scales_of_any_size():
    """Squares of numbers that small are 0, of numbers that large infinite."""
    for size in (1e-38, 1e-25, 1e25, 3e38):
        asset = make_asset(2, clip=Clip(pixel=0.0))
        asset.scale[:] = size
        assert np.array_equal(asset.soft_scale(), asset.scale)
    asset = make_asset(2, clip=Clip(pixel=0.01))
    asset.scale[:] = 1e-30
    assert np.allclose(asset.soft_scale(), np.sqrt(0.1) * 0.01)


def test_a_colour_beyond_all_bounds_is_damage():
    asset = make_asset(5)
    asset.rgb[2, 1] = 3e38
    with pytest.raises(InputError, match=r"rgb holds colours beyond all bounds \(1 of 5"):
        check(asset)
    sound, note = sound_part(asset, "a.ply")
    assert len(sound) == 4 and "1 of 5 Gaussians are left out" in note


def test_a_static_asset_is_the_same_at_all_times():
    still = static_asset(
        "it", np.ones((2, 3)), np.ones((2, 3)), [[2, 0, 0, 0], [0, 0, 0, 0]], np.ones((2, 3)), [0.5, 1]
    )
    np.testing.assert_array_equal(still.rotation, [[1, 0, 0, 0]] * 2)
    for a, b in zip(still.at(-1), still.at(1), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_orders_of_quaternions_are_each_others_inverse():
    q = np.array([["w", "x", "y", "z"]])
    assert "".join(xyzw_from_wxyz(q)[0]) == "xyzw" and "".join(wxyz_from_xyzw(xyzw_from_wxyz(q))[0]) == "wxyz"


# ---------------------------------------------------------------- what others wrote


@pytest.mark.parametrize("asset", [make_asset(9), tracked_asset(9)], ids=["lines", "paths"])
def test_what_is_no_number_is_left_out_and_named(asset):
    whole, note = sound_part(asset[np.arange(9)], "a.ply")
    assert note == "" and len(whole) == 9
    damaged = asset[np.arange(9)]
    damaged.xyz[2, 1], damaged.opacity[2], damaged.opacity[5] = np.nan, np.inf, np.nan
    rest, note = sound_part(damaged, "a.ply")
    assert note == "2 of 9 Gaussians are left out: NaN, or beyond all bounds, in position and opacity."
    assert_same(asset[np.delete(np.arange(9), [2, 5])], rest, 0, 0)
    damaged.rgb[:] = np.inf
    with pytest.raises(InputError, match=r"a\.ply: position and colour and opacity of all its 9 Gaussians holds NaN"):
        sound_part(damaged, "a.ply")
    with pytest.raises(InputError, match="it holds no Gaussians"):
        sound_part(asset[np.arange(0)], "a.ply")


def test_opacities_are_clamped_and_more_than_rounding_is_said():
    asset = make_asset(3)
    asset.opacity[:] = 1.0001, -1e-5, 0.5
    part, note = sound_part(asset, "a.ply")
    assert note == "" and part.opacity.tolist() == [1, 0, 0.5]
    asset.opacity[:] = 200, -1, 0.5
    part, note = sound_part(asset, "a.ply")
    assert note == "The opacities of 2 Gaussians are clamped to 0..1." and part.opacity.tolist() == [1, 0, 0.5]


def test_what_is_far_from_the_origin_is_counted_from_its_middle():
    near = np.random.default_rng(0).uniform(-1, 1, (99, 3))
    for middle in ((0, 0, 0), (100, -50, 3)):
        xyz, at = near_origin(near + middle)
        assert at == (0, 0, 0) and (xyz == near + middle).all()
        assert near_origin(near[:1] + middle)[1] == (0, 0, 0)  # of one alone, which has no size
    far = near + np.array([448_262.3, 5_411_932.7, 217.0])
    far[3], far[50] = np.nan, (0, 0, 0)  # neither damage nor strays move the middle
    xyz, at = near_origin(far)
    np.testing.assert_allclose(at, (448_262.3, 5_411_932.7, 217.0), atol=1)
    np.testing.assert_allclose(xyz.astype(np.float32).astype(float) + at, far, atol=1e-6 * 5.5e6 / 5)
    rows = np.delete(np.arange(99), [3, 50])
    np.testing.assert_allclose(xyz[rows].astype(np.float32) + at, far[rows], atol=1e-6)
    assert near_origin(np.full((2, 3), np.nan))[1] == (0, 0, 0)


def test_encodings_undo_one_another():
    x = np.linspace(0, 1, 999, dtype=np.float32)
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(x)), x, atol=1e-6)
    assert srgb_from_linear(np.array([-1, 2])).tolist() == [0, 1]
