# SPDX-License-Identifier: GPL-3.0-or-later
"""Films: where cameras go and when, what a picture shows, and files that are whole or not there."""

import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from timesplat.datagen.rigs import Shot, look_at
from timesplat.datagen.sequence import InputError
from timesplat.model.film import Look, pictures, placed, turntable, write_film
from timesplat.model.io.asset import Clip
from timesplat.model.io.page import bounds

from ..assets import make_asset, tracked_asset

CLIP = Clip(24.0, 3, 8, 2.0, (1.0, 2.0, 3.0), pixel=0.0)


def lone(xyz=(0, 0, 0), rgb=(1, 0, 0), clip=CLIP, size=0.05):
    """One opaque Gaussian that stands still."""
    asset = make_asset(1, clip=clip, speed=0, sigma=(1e4, 2e4))
    f32 = lambda *a: np.array([a], np.float32)  # noqa: E731
    asset = replace(asset, t=np.zeros(1, np.float32), velocity=np.zeros((1, 3), np.float32))
    return replace(asset, xyz=f32(*xyz), rgb=f32(*rgb), scale=f32(size, size, size), opacity=np.float32([0.99]))


def centre(picture: np.ndarray) -> np.ndarray:
    """x, y of what is not white, in pixels."""
    weight = 255.0 - picture[..., :3].min(2)
    y, x = np.mgrid[: len(picture), : picture.shape[1]] + 0.5
    return np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()


def test_a_turntable_plays_while_it_turns():
    asset = tracked_asset(60, clip=CLIP)
    shots = turntable(asset, 24.0)
    assert len(shots) == 96 and [s.frame for s in shots[:7]] == [3, 4, 5, 6, 7, 8, 3], "six frames, for four seconds"
    target, radius = bounds(asset)
    at = np.stack([s.c2w[:3, 3] for s in shots]) - target
    np.testing.assert_allclose(np.linalg.norm(at, axis=1), 1.08 * radius / math.sin(math.radians(25)), rtol=1e-6)
    turned = np.unwrap(np.arctan2(-at[:, 0], -at[:, 1]))
    np.testing.assert_allclose(turned, np.arange(96) / 96 * 2 * np.pi, atol=1e-6)
    assert len(turntable(asset, 24.0, plays=2)) == 12
    between = turntable(asset, 48.0, plays=1)
    assert len(between) == 12 and between[1].frame == 3.5 and between[-1].frame == 8, "held at the end"
    still = make_asset(9, clip=Clip(24, 5, 5))
    assert len(turntable(still, 24.0)) == 96 and {s.frame for s in turntable(still, 24.0)} == {5}


@pytest.mark.parametrize("pixel", [0.0, 0.001, 0.03])
@pytest.mark.parametrize(("width", "height"), [(64, 64), (96, 48), (48, 96)])
def test_a_camera_in_the_world_sees_a_point_where_it_is(width, height, pixel):
    """By the pinhole: at every shape of picture, however much finer or coarser it is than those of the fit."""
    asset = lone((0.2, -0.1, 0.3), clip=replace(CLIP, pixel=pixel))
    world = np.array([0.2, -0.1, 0.3]) * 2 + (1, 2, 3)
    c2w = look_at((2.0, -6.0, 5.0), (1.0, 2.0, 3.0))
    shot = Shot(5, "film", "film", c2w, 40.0, (0.1, -0.05))
    (picture,) = pictures(asset, placed([shot], asset), Look(width, height))
    x, y, z = np.linalg.inv(c2w)[:3] @ [*world, 1]
    side = max(width, height)
    focal = 0.5 * side / math.tan(math.radians(20))
    expected = width / 2 - 0.1 * side + focal * x / -z, height / 2 - 0.05 * side - focal * y / -z
    np.testing.assert_allclose(centre(picture), expected, atol=0.35)
    assert picture.shape == (height, width, 4) and (picture[..., 3] == 255).all()


def test_times_between_frames_are_drawn_and_beyond_them_is_held():
    asset = lone()
    asset = replace(asset, velocity=np.float32([[0.4, 0, 0]]))
    c2w = look_at((0, -3.0, 0), (0, 0, 0))
    shots = [Shot(f, "film", "film", c2w, 50.0) for f in (3, 5.5, 8, 99)]
    x = [centre(p)[0] for p in pictures(asset, shots, Look(128, 128))]
    focal = 64 / math.tan(math.radians(25))
    np.testing.assert_allclose(x, 64 + focal / 3 * 0.4 * np.array([-1, 0, 1, 1]), atol=0.3)


def test_a_background_and_none():
    c2w = look_at((0, -3.0, 0), (0, 0, 0))
    shots = [Shot(3, "film", "film", c2w, 50.0)]
    (over,) = pictures(lone(size=0.2), shots, Look(64, 64, background=(0, 0, 1)))
    assert over[0, 0].tolist() == [0, 0, 255, 255] and over[32, 32, 0] > 240 and over[32, 32, 2] < 10
    (clear,) = pictures(lone(size=0.2), shots, Look(64, 64, background=None))
    soft = (clear[..., 3] > 20) & (clear[..., 3] < 235)
    assert clear[0, 0, 3] == 0 and clear[32, 32, 3] > 240 and soft.any()
    assert (clear[soft][:, 0] > 250).all() and (clear[soft][:, 1:3] < 5).all(), "straight alpha"


def test_small_films_are_averaged_from_what_the_fit_saw():
    """At a fourth of the fit's pixels thin Gaussians are no thicker than those: what is covered agrees."""
    asset = make_asset(60, clip=replace(CLIP, pixel=3 * 2 * math.tan(math.radians(25)) / 256), speed=0, sigma=(9, 10))
    asset = replace(asset, scale=np.full_like(asset.scale, 1e-3))
    shots = [Shot(3, "film", "film", look_at((0, -3.0, 0), (0, 0, 0)), 50.0)]
    covered = [next(pictures(asset, shots, Look(n, n, background=None)))[..., 3].mean() for n in (256, 64)]
    assert covered[1] == pytest.approx(covered[0], rel=0.1)


def test_files_hold_the_pictures(tmp_path):
    asset = make_asset(20, clip=CLIP, sigma=(9, 10))
    shots = turntable(asset, 12.0, plays=1)
    said = []
    assert write_film(tmp_path / "a", asset, shots, Look(33, 20, 12, None), lambda f, text: said.append((f, text))) == 3
    assert said[-1] == (1.0, "picture 3 of 3")
    names = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert names == ["a_0001.png", "a_0002.png", "a_0003.png"]
    drawn = list(pictures(asset, shots, Look(33, 20, 12, None)))
    for name, picture in zip(names, drawn, strict=True):
        np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a" / name)), picture)
    write_film(tmp_path / "a.webp", asset, shots, Look(33, 20, 12))
    with Image.open(tmp_path / "a.webp") as film:
        assert film.n_frames == 3 and film.size == (33, 20)
        film.seek(1)
        film.load()
        assert film.info["duration"] in (83, 84)
    av = pytest.importorskip("av")
    write_film(tmp_path / "a.mp4", asset, shots, Look(33, 20, 12))
    with av.open(str(tmp_path / "a.mp4")) as film:
        stream = film.streams.video[0]
        frames = [f.to_ndarray(format="rgb24") for f in film.decode(stream)]
        assert (len(frames), float(stream.average_rate), stream.codec_context.name) == (3, 12, "h264")
    over = list(pictures(asset, shots, Look(33, 20, 12)))
    assert frames[0].shape == (20, 34, 3), "an even width"
    assert np.abs(frames[1][:, :33].astype(int) - over[1][..., :3]).mean() < 6


@pytest.mark.parametrize("name", ["a.mp4", "a.webp", "a"])
def test_what_is_stopped_leaves_nothing(tmp_path, name):
    pytest.importorskip("av")

    def stop(fraction, text):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_film(tmp_path / name, lone(), turntable(lone(), 24.0, 1), Look(32, 32), stop)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "look", "says"),
    [
        ("a.gif", Look(), "a.gif: films are .mp4 or .webp, or a folder"),
        ("a.mp4", Look(background=None), "an .mp4 cannot be transparent"),
        ("a.mp4", Look(9, 99), "9 x 99 pixels: give sizes from 16 to 8192"),
        ("a.mp4", Look(fps=0), "0 frames a second"),
        ("there", Look(), "there: it exists already and is not an empty folder"),
        ("file/a.webp", Look(32, 32), "file/a.webp: it cannot be written"),
    ],
)
def test_what_cannot_be_made_is_a_sentence(tmp_path, name, look, says):
    (tmp_path / "there").mkdir()
    (tmp_path / "there/x").write_text("x")
    (tmp_path / "file").write_text("x")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match=says):
        write_film(tmp_path / name, lone(), turntable(lone(), 24.0, 1), look)
    assert sorted(tmp_path.rglob("*")) == before
