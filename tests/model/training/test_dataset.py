"""Training data: what comes back is what was rendered, and samples are what they are said to be."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from timesplat.datagen.curation.curate import curate
from timesplat.datagen.curation.decisions import read_decisions, write_decisions
from timesplat.datagen.curation.measures import motion_of
from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.model.training.dataset import ClipDataset, canonical_pictures
from timesplat.model.views import load_views


def test_packed_views_are_the_rendered_ones(sphere_folder, tmp_path):
    seq = read_sequence(sphere_folder)
    clips = ClipDataset([sphere_folder.parent], tmp_path)
    sample = clips.sample(np.random.default_rng(0), targets=2)
    whole = load_views(seq, range(len(seq.views)), has_depth=True)
    for part in (sample.inputs, sample.targets):
        for i in range(len(part)):
            n = next(
                k for k in range(len(whole)) if torch.equal(whole.c2w[k], part.c2w[i]) and whole.time[k] == part.time[i]
            )
            assert torch.equal(whole.rgb[n], part.rgb[i]) and torch.equal(whole.alpha[n], part.alpha[i])
            if part is sample.targets:
                assert part.depth is None and part.flow is None
                continue
            on = whole.alpha[n] > 0
            torch.testing.assert_close(part.depth[i][on], whole.depth[n][on], rtol=1e-3, atol=0)
            torch.testing.assert_close(part.flow[i][on], whole.flow[n][on], rtol=1e-3, atol=1e-3)
    assert len(list(tmp_path.glob("*.safetensors"))) == 1
    with pytest.raises(InputError, match="no Sequence"):
        ClipDataset([tmp_path / "nothing"], tmp_path)


def test_pictures_alone_are_packed_where_there_are_no_passes(sphere_folder, pictures, tmp_path):
    with pytest.raises(InputError, match=r"pictures: .*depth.*render it with passes, or .*--source sweep or predicted"):
        ClipDataset([pictures], tmp_path)
    assert not list(tmp_path.glob("*.safetensors"))
    clips = ClipDataset([pictures, sphere_folder], tmp_path, has_depth=False)
    inputs = [clips.sample(np.random.default_rng(seed), 2).inputs for seed in range(9)]
    assert all(x.depth is None and x.flow is None and x.alpha.any() for x in inputs)
    whole = ClipDataset([sphere_folder], tmp_path / "whole", has_depth=True)
    assert whole.paths[0].name == clips.paths[1].name  # what has passes is packed with them in any case
    with pytest.raises(InputError, match="pictures: "):  # also once it is packed without
        ClipDataset([pictures], tmp_path)
    assert ClipDataset([pictures], tmp_path, has_depth=False).paths == clips.paths[:1]


def test_static_samples_are_at_time_zero(sphere_folder, tmp_path):
    clips = ClipDataset([sphere_folder], tmp_path, sampling="static")
    sample = clips.sample(np.random.default_rng(0), targets=2, inputs=2)
    for part in (sample.inputs, sample.targets):
        assert len(part) == 2 and not part.time.any()
    assert not sample.inputs.flow.any()


def clip(distance: float) -> dict:
    """A packed clip of a white pixel on black that gets `distance` darker over four frames; 100 empty pixels."""
    rgba = torch.zeros(4, 1, 101, 5, dtype=torch.uint8)
    rgba[:, 0, 0, 3] = 255
    rgba[:, 0, 0, :3] = (255 * (1 - distance * torch.linspace(0, 1, 4)))[:, None].round().to(torch.uint8)
    return {"rgba": rgba, "camera": torch.zeros(4, dtype=torch.long)}


def test_motion_is_the_greatest_distance_between_frames():
    assert motion_of(canonical_pictures(clip(0.0), ["front"])) == 0
    assert motion_of(canonical_pictures(clip(0.4), ["front"])) == pytest.approx(0.4, abs=0.01)
    assert np.isnan(motion_of(canonical_pictures(clip(0.4), ["orbit"])))


def test_the_sets_of_a_curation_are_the_groups(sphere_folder, tmp_path):
    folder = tmp_path / "data"
    for name in ("a", "b"):
        shutil.copytree(sphere_folder, folder / name)
    curate(folder, report=print)
    table = folder / "curation.csv"
    rows = read_decisions(table)
    assert [(d.sequence, d.set) for d in rows] == [("a", "4d"), ("b", "4d")]  # no camera of it stands still
    write_decisions(table, [replace(rows[0], override="hq4d"), replace(rows[1], override="out")])
    clips = ClipDataset([folder], tmp_path / "cache")
    assert {g: len(paths) for g, paths in clips.groups.items()} == {"hq4d": 1, "4d": 0, "3d": 0}
    write_decisions(table, [replace(d, override="out") for d in rows])
    with pytest.raises(InputError, match=r"curation\.csv throws out all of its Sequences"):
        ClipDataset([folder / "a", folder / "b"], tmp_path / "cache")


def test_groups_are_drawn_by_their_weights(sphere_folder, tmp_path):
    clips = ClipDataset([sphere_folder], tmp_path, mix="200:50:1")
    assert clips.probabilities.tolist() == [0, 1, 0]  # only what exists
    (path,) = clips.paths
    clips.groups, clips.probabilities = {"hq4d": [path], "4d": [], "3d": [path]}, np.array([0.75, 0, 0.25])
    assert clips.sample(np.random.default_rng(0), 2).name == "spheres"
    with pytest.raises(InputError, match="none of the clips"):
        ClipDataset([sphere_folder], tmp_path, mix="1:0:0")
