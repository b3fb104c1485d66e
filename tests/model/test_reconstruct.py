# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes from Sequences by every kind of method, and what was on disk when it went wrong."""

import json
from dataclasses import replace

import pytest
import torch

from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.model import baselines  # noqa: F401, adds its methods
from timesplat.model.methods import METHODS, ReconstructOptions
from timesplat.model.network import Config
from timesplat.model.reconstruct import chosen_method, reconstruct, untracked_note

TINY = Config(width=32, depth=1, heads=2, source="given")


@pytest.mark.parametrize("method", ["white", "hull", "lift"])
def test_methods_without_a_network(sphere_folder, method):
    seq = read_sequence(sphere_folder)
    g = reconstruct(seq, method, range(24))
    assert (len(g) > 500) == (method != "white")
    assert g.alive().all()


def test_untrained_guided_network_is_the_lift(sphere_folder, checkpoint):
    seq = read_sequence(sphere_folder)
    a = reconstruct(seq, "lift", range(24))
    b = reconstruct(seq, "guided", range(24), ReconstructOptions(checkpoint=checkpoint))
    torch.testing.assert_close(a.xyz, b.xyz, atol=1e-6, rtol=0)
    torch.testing.assert_close(a.opacity, b.opacity, atol=1e-4, rtol=0)


def test_the_method_that_suits_what_was_rendered(sphere_folder, tmp_path):
    seq = read_sequence(sphere_folder)
    assert chosen_method(seq, None) == "flow" and chosen_method(seq, "tracks") == "tracks"
    followed, nothing = replace(seq, tracks="tracks.npz"), replace(seq, untracked=["Smoke"])
    assert chosen_method(followed, None) == chosen_method(followed, "tracks") == "tracks"
    assert chosen_method(nothing, None) == chosen_method(nothing, "tracks") == "guided"
    assert chosen_method(followed, "lift") == chosen_method(nothing, "lift") == "lift"
    several = replace(nothing, views=[replace(v, frame=v.frame // 4) for v in seq.views])
    assert chosen_method(several, None) == chosen_method(several, "tracks") == "flow"
    bare = replace(seq, views=[replace(v, passes=None) for v in seq.views])
    assert chosen_method(bare, None) == "deform"
    assert untracked_note(seq) == "" and "Smoke, Fire: " in untracked_note(replace(seq, untracked=["Smoke", "Fire"]))


@pytest.mark.parametrize("method", ["guided", "sweep", "predicted", "rgb"])
def test_shipped_checkpoints_reconstruct(sphere_folder, method):
    g = reconstruct(read_sequence(sphere_folder), method, range(24))
    assert len(g) > 50  # `predicted` makes most of its Gaussians transparent, and the filters drop these
    assert all(torch.isfinite(getattr(g, k)).all() for k in ("xyz", "velocity", "sigma_t", "scale", "rotation", "rgb"))


def test_rgb_methods_read_no_passes(sphere_folder, tmp_path):
    import shutil

    folder = tmp_path / "bare"
    shutil.copytree(sphere_folder, folder)
    shutil.rmtree(folder / "passes")
    text = json.loads((folder / "transforms.json").read_text())
    for f in text["frames"]:
        del f["exr_path"]
    (folder / "transforms.json").write_text(json.dumps(text))
    seq = read_sequence(folder)
    assert len(reconstruct(seq, "rgb", range(24))) > 500
    with pytest.raises(InputError, match="has no depth pass"):
        reconstruct(seq, "lift", range(24))


def test_a_gaussian_a_pixel_is_made_of_smaller_pictures_where_pixels_are_too_many(sphere_folder, monkeypatch):
    seq, told = read_sequence(sphere_folder), []
    whole = reconstruct(seq, "rgb", range(24))
    monkeypatch.setitem(METHODS, "rgb", replace(METHODS["rgb"], most_pixels=len(whole) // 3))
    bounded = reconstruct(seq, "rgb", range(24), progress=lambda fraction, text: told.append(text))
    assert len(bounded) < len(whole) / 2 and any("at 1/2 of their size" in text for text in told)


def test_unknown_method_and_empty_views(sphere_folder, spheres, write_views, tmp_path):
    with pytest.raises(InputError, match="no such method"):
        reconstruct(read_sequence(sphere_folder), "magic")
    views = spheres([0], size=16)
    views.alpha = torch.zeros_like(views.alpha)
    with pytest.raises(InputError, match="no view shows the object"):
        reconstruct(write_views(views, tmp_path / "empty"), "lift")


@pytest.mark.parametrize("method", ["gs-lrm-frame", "gs-lrm-all"])
def test_without_its_checkpoint_a_baseline_says_so(sphere_folder, tmp_path, monkeypatch, method):
    monkeypatch.setattr("timesplat.model.reconstruct.CHECKPOINTS", tmp_path)
    with pytest.raises(InputError, match=r"static\.safetensors: no such checkpoint"):
        reconstruct(read_sequence(sphere_folder), method)


def test_methods_that_fit_take_their_seconds_and_tell(sphere_folder):
    told = []
    seq, options = read_sequence(sphere_folder), ReconstructOptions(seconds=0.2)
    g = reconstruct(seq, "4dgs", options=options, progress=lambda f, text: told.append((f, text)))
    assert g.alive().all() and told[-1][0] == pytest.approx(1) and told[-1][1].startswith("4dgs, step ")


@pytest.mark.parametrize(("method", "options"), [("lift", {"refine": 0.1}), ("4dgs", {"seconds": 0.1})])
def test_scenes_are_fitted_on_the_processor_where_the_device_has_(sphere_folder, method, options):
    """As Apple's has none; torch's "meta" stands for it here."""
    seq = read_sequence(sphere_folder)
    scene = reconstruct(seq, method, seq.select(rig="input"), ReconstructOptions(device="meta", **options))
    assert len(scene) > 50 and scene.xyz.device.type == "cpu"
