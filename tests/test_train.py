"""Training: data that comes back as rendered, exact resume, and a loss that falls."""

import argparse
import json
import os
import signal

import numpy as np
import pytest
import torch

from timesplat.cli import train_arguments
from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.model.data import Clips, shrink
from timesplat.model.losses import geometric, photometric
from timesplat.model.network import PRESETS, Config
from timesplat.model.sampling import choose_inputs
from timesplat.model.train import Trainer, run
from timesplat.model.views import load_views


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", Config(width=32, depth=1, heads=2))


def arguments(folder, out, *more) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    train_arguments(parser)
    cache = out.parent / "cache"
    words = [str(folder), "--out", str(out), "--cache", str(cache), "--targets", "2", "--views", "4", *more]
    return parser.parse_args(words)


def test_packed_views_are_the_rendered_ones(sphere_folder, tmp_path):
    seq = read_sequence(sphere_folder)
    clips = Clips([sphere_folder.parent], tmp_path)
    sample = clips.sample(np.random.default_rng(0), targets=2)
    whole = load_views(seq, range(len(seq.views)), passes=True)
    for part in (sample.inputs, sample.targets):
        for i in range(len(part)):
            n = next(
                k for k in range(len(whole)) if torch.equal(whole.c2w[k], part.c2w[i]) and whole.time[k] == part.time[i]
            )
            assert torch.equal(whole.rgb[n], part.rgb[i]) and torch.equal(whole.alpha[n], part.alpha[i])
            on = whole.alpha[n] > 0
            torch.testing.assert_close(part.depth[i][on], whole.depth[n][on], rtol=1e-3, atol=0)
            torch.testing.assert_close(part.flow[i][on], whole.flow[n][on], rtol=1e-3, atol=1e-3)
    assert len(list(tmp_path.glob("*.safetensors"))) == 1
    with pytest.raises(InputError, match="no Sequence"):
        Clips([tmp_path / "nothing"], tmp_path)


@pytest.mark.parametrize("seed", range(20))
def test_inputs_are_one_view_a_frame_or_two_at_even_ones(seed):
    frame, camera = np.repeat(np.arange(24), 6), np.tile(np.arange(6), 24)
    names = ["back", "elevated", "front", "left", "orbit", "right"]
    chosen = choose_inputs(np.random.default_rng(seed), frame, camera, names, 24)
    counts = np.bincount(frame[chosen], minlength=24)
    assert len(set(chosen.tolist())) == 24
    assert (counts == 1).all() or ((counts[::2] == 2).all() and (counts[1::2] == 0).all())
    few = choose_inputs(np.random.default_rng(seed), frame, camera, names, 7)
    assert len(few) == 7 and (np.diff(frame[few]) >= 0).all()


def test_shrinking_averages_light_and_keeps_the_nearest_surface(spheres):
    views = spheres([0, 5], size=32)
    half = shrink(views, 2)
    assert half.size == (16, 16)
    blocks = views.over(0.0).reshape(2, 16, 2, 16, 2, 3).mean((2, 4))
    torch.testing.assert_close(half.over(0.0), blocks, atol=1e-6, rtol=0)
    exact = spheres([0, 5], size=16)
    both = torch.isfinite(exact.depth) & torch.isfinite(half.depth)
    assert (half.depth - exact.depth)[both].abs().median() < 0.02
    assert (half.flow - exact.flow)[both].abs().median() < 0.02
    torch.testing.assert_close(half.intrinsics, exact.intrinsics)


@pytest.mark.parametrize("source", ["given", "sweep", "predicted"])
def test_loss_falls(sphere_folder, tmp_path, source):
    args = arguments(sphere_folder.parent, tmp_path / "run", "--source", source, "--steps", "40", "--rate", "3e-3")
    args.geometric = 0.3
    assert run(args) == 0
    lines = [json.loads(x) for x in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert lines[-1]["step"] == 40 and lines[-1]["loss"] < lines[0]["loss"]
    assert lines[-1]["skipped"] == 0


def test_an_interrupted_run_goes_on_exactly(sphere_folder, tmp_path, monkeypatch):
    """Ten steps, Ctrl-C, and ten more equal twenty."""
    folder = sphere_folder.parent
    assert run(arguments(folder, tmp_path / "whole", "--steps", "20")) == 0
    step = Trainer.train_step

    def interrupted(self, shares):
        if self.step == 9:
            os.kill(os.getpid(), signal.SIGINT)
        return step(self, shares)

    with monkeypatch.context() as m, pytest.raises(KeyboardInterrupt):
        m.setattr(Trainer, "train_step", interrupted)
        run(arguments(folder, tmp_path / "parts", "--steps", "20"))
    states = {}
    for name in ("parts", "whole"):
        if name == "parts":
            assert torch.load(tmp_path / name / "state.pt", weights_only=True)["progress"]["step"] == 10
            run(arguments(folder, tmp_path / name, "--steps", "20"))
        states[name] = torch.load(tmp_path / name / "state.pt", weights_only=True)
    for kind in ("network", "average"):
        for k, v in states["whole"][kind].items():
            torch.testing.assert_close(states["parts"][kind][k], v, rtol=0, atol=0)


def test_damaged_run_is_refused(sphere_folder, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "state.pt").write_bytes(b"not a run")
    with pytest.raises(InputError, match="cannot be resumed"):
        run(arguments(sphere_folder.parent, tmp_path / "run", "--steps", "1"))


def test_photometric_loss_by_hand(spheres):
    targets = spheres([0], size=16)
    white = torch.ones(3)
    assert float(photometric(targets.over(1.0), targets.alpha, targets, white)) == 0
    off = photometric(targets.over(1.0) + 0.1, targets.alpha, targets, white)
    assert float(off) == pytest.approx(0.01, rel=1e-4)
    assert float(photometric(targets.over(1.0), targets.alpha * 0, targets, white)) == pytest.approx(
        0.3 * float(targets.alpha.mean()), rel=1e-5
    )


def test_geometric_loss_vanishes_at_the_truth(spheres):
    from timesplat.model.lift import lift

    g = lift(spheres([0, 1], size=16))
    t, known = torch.zeros(len(g)), torch.ones(len(g), dtype=torch.bool)
    assert float(geometric(g, t, g, known)) == 0
    assert float(geometric(g, t, g, ~known)) == 0
    away = g.map(lambda x: x.clone())
    away.xyz += 1
    assert float(geometric(away, t, g, known)) > 0.5
