# SPDX-License-Identifier: GPL-3.0-or-later
"""One scene scored: its figures are those of the pictures."""

import pytest
import torch

from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.evaluation import protocol, scoring
from timesplat.evaluation.image_quality import psnr
from timesplat.evaluation.loading import load_truth
from timesplat.evaluation.method_spec import parse_spec
from timesplat.evaluation.scoring import COSTS, costs, draw, evaluate_views, psnr_of_finer
from timesplat.model.rasterize.constants import BLUR
from timesplat.model.views import load_views


@pytest.fixture
def seq(sphere_folder):
    return read_sequence(sphere_folder)


@pytest.fixture
def evaluated(seq):
    """evaluated(text) -> row and scene of a method on the spheres' 24 views, scored on the held-out ones."""
    targets = protocol.held_out(seq)

    def run(text):
        spec = parse_spec(text)
        return evaluate_views(load_views(seq, range(24), spec.has_depth), spec, load_truth(seq, targets, targets))

    return run


def test_figures_are_those_of_the_pictures(seq, evaluated):
    row, g = evaluated("lift")
    truth = load_views(seq, protocol.held_out(seq))
    by_hand = psnr(draw(g, truth)[0], truth.over(1.0))
    assert row["psnr"] == pytest.approx(float(by_hand.mean()), abs=1e-5)
    assert row["psnr_worst"] == pytest.approx(float(by_hand.min()), abs=1e-5)
    assert row["gaussians_kept"] == len(g) <= row["gaussians"]


def test_white_scores_what_the_silhouette_says(seq, evaluated):
    row, g = evaluated("white")
    truth = load_views(seq, protocol.held_out(seq))
    assert len(g) == 0
    expected = psnr(torch.ones_like(truth.rgb), truth.over(1.0)).mean()
    assert row["psnr"] == pytest.approx(float(expected), abs=1e-5)


class Frozen:
    """A scene that is not Gaussians4D: the state of another at each time."""

    def __init__(self, g):
        self.g = g

    def __len__(self):
        return len(self.g)

    def __getitem__(self, index):
        return Frozen(self.g[index])

    def to_asset(self, clip):
        raise InputError("its Gaussians are on no paths of ours; evaluate it.")

    def alive(self):
        return self.g.alive()

    def at(self, t):
        return self.g.frozen(t)


def test_other_moving_scenes_are_scored_as_well(evaluated, monkeypatch):
    row, _ = evaluated("lift")
    plain = scoring.reconstruct_views
    monkeypatch.setattr(scoring, "reconstruct_views", lambda *a, **k: Frozen(plain(*a, **k)))
    moving, scene = evaluated("lift")
    assert isinstance(scene, Frozen) and moving["psnr"] == pytest.approx(row["psnr"], abs=0.05)


def test_the_device_reaches_the_method(evaluated, seq, monkeypatch):
    got = []
    plain = scoring.reconstruct_views
    monkeypatch.setattr(scoring, "reconstruct_views", lambda v, m, options: got.append(options.device) or plain(v, m))
    targets = protocol.held_out(seq)
    views, truth = load_views(seq, range(4), True), load_truth(seq, targets, targets)
    evaluate_views(views, parse_spec("lift"), truth, device="cuda:1")
    assert got == ["cuda:1"]


def test_what_a_scene_costs(seq, evaluated):
    targets = protocol.held_out(seq)
    truth = load_truth(seq, targets, targets)
    for text, covered in (("lift", True), ("lift+budget:500", False)):
        spec = parse_spec(text)
        found = costs(evaluated("lift")[1], load_views(seq, range(24), True), truth, spec, seq)
        assert tuple(found) == COSTS and (found["coverage"] is not None) == covered
        assert found["ply_mb"] > 0.01 and found["render_ms"] > 0


def test_what_no_asset_can_hold_has_no_megabytes(seq, evaluated):
    _, scene = evaluated("lift")
    assert scoring.megabytes(Frozen(scene), seq) == (None, None)
    assert scoring.megabytes(scene, seq)[0] > 0.01


def test_sizes_are_compared_in_the_finest_pictures(seq):
    """In its own pictures a scene has its own PSNR; in finer ones, the blur that it was fitted with put back."""
    targets = protocol.held_out(seq)
    fine = load_truth(seq, targets, targets)
    views = load_views(seq, range(24), True, fine.views.size[1] // 2)
    row, scene = evaluate_views(views, parse_spec("lift"), own := load_truth(seq, targets, targets, views.size[1]))
    assert psnr_of_finer(scene, views, own) == pytest.approx(row["psnr"], abs=1e-5)
    put_back = scene.widened((BLUR * 3 / 4) ** 0.5 * views.pixel)
    expected = psnr(draw(put_back, fine.views)[0], fine.picture).mean()
    assert psnr_of_finer(scene, views, fine) == pytest.approx(float(expected), abs=1e-4)
