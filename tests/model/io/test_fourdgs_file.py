# SPDX-License-Identifier: GPL-3.0-or-later
"""Files of the package fourdgs: within the error that they state, by its own evaluation as by ours."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from timesplat.datagen.sequence import InputError
from timesplat.model.io import files
from timesplat.model.io.asset import STATIC_SIGMA_T, Clip, linear_from_srgb, rotation_matrices
from timesplat.model.io.files import read_asset, upright, write_asset
from timesplat.model.io.pieces import to_pieces

from ...assets import make_asset, tracked_asset

CLIP = Clip(24.0, 3, 26, 2.0, (1.0, 2.0, 3.0), pixel=0.01)


@pytest.fixture
def fourdgs():
    return pytest.importorskip("fourdgs")


def in_order(found, source):
    """The Gaussians of `found` in the order of `source`, by their places in the world."""
    world = [a.xyz * a.clip.scale + np.array(a.clip.translation) for a in (found, source)]
    nearest = ((world[0][:, None] - world[1][None]) ** 2).sum(2).argmin(0)
    assert len(set(nearest)) == len(source) == len(found)
    return found[nearest]


@pytest.mark.parametrize("make", [make_asset, tracked_asset])
def test_it_comes_back_within_the_error_that_it_states(fourdgs, tmp_path, make):
    asset = make(60, clip=CLIP)
    straight = (asset if asset.paths is None else to_pieces(asset)).softened()
    count = write_asset(tmp_path / "a.4dgs", asset)
    loaded = read_asset(tmp_path / "a.4dgs")
    assert count == len(straight) == len(loaded.asset) and (loaded.up, loaded.note) == ("Z", "")
    clip = loaded.asset.clip
    assert (clip.fps, clip.frames, clip.scale) == (24, CLIP.frames, 1)
    bounds = {k: float(v) for k, v in fourdgs.read(str(tmp_path / "a.4dgs")).quantization.bounds.items()}
    for frame in (3, 9.4, 26):
        time = clip.frame_to_time(frame)
        (xyz, opacity), (there, faint) = loaded.asset.at(time), straight.at(time)
        found, seen = xyz[opacity > 0.02], there[faint > 0.02] * 2 + (1, 2, 3)
        # of each axis: its place, and as much again by its motion and its time
        way = np.abs(seen[:, None] - found[None]).max(2).min(1)
        assert np.percentile(way, 98) < 3 * bounds["pos"] and way.max() < 0.05
    if make is make_asset:
        found = in_order(loaded.asset, straight)
        np.testing.assert_allclose(found.rgb, straight.rgb, atol=bounds["rgb"] + 1e-6)
        np.testing.assert_allclose(found.opacity, straight.opacity, atol=bounds["alpha"] + 1e-6)
        np.testing.assert_allclose(found.scale, straight.scale * 2, rtol=bounds["scale_rel"] + 1e-5)
        np.testing.assert_allclose(found.sigma_t, straight.sigma_t, rtol=bounds["sigma_rel"] + 1e-5)
        np.testing.assert_allclose(rotation_matrices(found.rotation), rotation_matrices(straight.rotation), atol=0.005)
        assert np.abs(found.xyz - straight.xyz * 2 - (1, 2, 3)).max() < bounds["pos"] + 1e-6


def test_the_library_shows_at_a_time_what_we_show(fourdgs, tmp_path):
    asset = make_asset(80, clip=CLIP, sigma=(0.2, 0.9))
    asset.sigma_t[:9] = STATIC_SIGMA_T
    write_asset(tmp_path / "a.4dgs", asset)
    scene = fourdgs.read(str(tmp_path / "a.4dgs"))
    assert scene.duration_sec == 1 and np.isinf(scene.gaussians.sigma_t).sum() == 9
    for frame in (3, 11.25, 26):
        state = scene.state_at((frame - 3) / 24)
        xyz, opacity = asset.at(asset.frame_to_time(frame))
        seen = opacity >= 0.009 * asset.opacity
        world = xyz[seen] * 2 + (1, 2, 3)
        nearest = ((state["centers"][:, None] - world[None]) ** 2).sum(2).argmin(1)
        clearly = (opacity >= 0.011 * asset.opacity).sum()
        assert len(set(nearest)) == len(nearest) >= clearly
        np.testing.assert_allclose(state["centers"], world[nearest], atol=2e-3)
        np.testing.assert_allclose(state["opacity"], opacity[seen][nearest], atol=0.02)


def test_its_own_validator_has_no_complaint(fourdgs, tmp_path):
    from fourdgs.cli import main

    write_asset(tmp_path / "a.4dgs", tracked_asset(40, clip=CLIP))
    assert main(["validate", str(tmp_path / "a.4dgs")]) == 0


def test_files_of_others(fourdgs, tmp_path):
    """Y up, linear colours, centimetres; what a window cuts off fades, and what is left out is said."""
    n, r = 6, np.random.default_rng(0)
    gaussians = fourdgs.GaussianSet(
        positions=r.uniform(-1, 1, (n, 3)).astype("f4"),
        scales=np.full((n, 3), 0.1, "f4"),
        rotations=np.tile(np.float32([0, 0, 0, 1]), (n, 1)),
        colors=np.full((n, 4), 0.5, "f4"),
        motions=np.zeros((n, 3), "f4"),
        mu_t=np.full(n, 1, "f4"),
        sigma_t=np.full(n, np.inf, "f4"),
        win_lo=np.array([0, 0, 0, 0, 0, 1.0]),
        win_hi=np.full(n, 2.0),
        sh=np.full((n, 9), 200, np.uint8),
        sh_degree=1,
    )
    about = {
        "coordinate_system": "y-up-right-handed",
        "color_space": "linear-rec709-display",
        "meters_per_unit": "0.01",
    }
    fourdgs.write(str(tmp_path / "a.4dgs"), gaussians, 2.0, options=fourdgs.WriteOptions(metadata=about))
    loaded = read_asset(tmp_path / "a.4dgs")
    assert loaded.up == "Y" and loaded.asset.clip.frames == range(1, 49) and loaded.asset.clip.scale == 0.01
    assert "1 Gaussians that come or go at once fade" in loaded.note and "spherical harmonics" in loaded.note
    np.testing.assert_allclose(linear_from_srgb(loaded.asset.rgb), 0.5, atol=0.01)
    found = in_order(loaded.asset, replace(loaded.asset, xyz=gaussians.positions))
    assert (found.sigma_t[:5] == STATIC_SIGMA_T).all()
    shown = [found.at(found.frame_to_time(frame))[1][5] for frame in (1, 37, 48)]
    assert shown[0] < 0.01 and shown[1] > 0.45 and shown[2] > 0.05
    standing = upright(loaded)
    placed = in_order(replace(loaded.asset, xyz=loaded.asset.xyz[:, [0, 2, 1]] * np.float32([1, -1, 1])), standing)
    assert len(placed) == n


def test_what_is_damaged_is_a_sentence(fourdgs, tmp_path):
    write_asset(tmp_path / "a.4dgs", make_asset(50, clip=CLIP))
    data = (tmp_path / "a.4dgs").read_bytes()
    for damaged in (b"", data[:9], data[: len(data) // 2], b"ply\n" + data, data[:300] + bytes(300) + data[600:]):
        (tmp_path / "b.4dgs").write_bytes(damaged)
        with pytest.raises(InputError, match=r"b\.4dgs: ") as e:
            read_asset(tmp_path / "b.4dgs")
        assert len(str(e.value).splitlines()) == 1
    rng = np.random.default_rng(0)
    for _ in range(60):  # wherever a byte is another, it is read or refused
        changed = bytearray(data)
        for at in rng.integers(0, len(data), 3):
            changed[at] = rng.integers(256)
        (tmp_path / "b.4dgs").write_bytes(bytes(changed))
        try:
            read_asset(tmp_path / "b.4dgs")
        except InputError as e:
            assert "b.4dgs: " in str(e)


def test_without_the_package_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "fourdgs", None)
    (tmp_path / "a.4dgs").write_bytes(b"")
    for do in (lambda: write_asset(tmp_path / "b.4dgs", make_asset(3)), lambda: read_asset(tmp_path / "a.4dgs")):
        with pytest.raises(InputError, match=r"needs the package fourdgs; pip install 'timesplat\[fourdgs\]'"):
            do()
    assert not (tmp_path / "b.4dgs").exists() and ".4dgs" in files.READABLE
