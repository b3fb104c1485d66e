"""Training: a loss that falls, exact resume, and what is not sound left out."""

import json
import os
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch

from timesplat.datagen.sequence import InputError
from timesplat.model.network import PRESETS, Config, Network
from timesplat.model.training.config import TrainConfig
from timesplat.model.training.dataset import ClipDataset
from timesplat.model.training.trainer import Trainer, make_network, network_config, train
from timesplat.model.training.vgg import VGG


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", Config(width=32, depth=1, heads=2, source="given"))


def make_config(folder, out, **options) -> TrainConfig:
    return TrainConfig((folder,), out, **{"cache": out.parent / "cache", "targets": 2, "views": 4} | options)


@pytest.mark.parametrize("source", ["given", "sweep", "predicted"])
def test_loss_falls(sphere_folder, tmp_path, source):
    train(make_config(sphere_folder.parent, tmp_path / "run", source=source, steps=40, rate=3e-3, geometric=0.3))
    lines = [json.loads(x) for x in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert lines[-1]["step"] == 40 and lines[-1]["loss"] < lines[0]["loss"]
    assert lines[-1]["skipped"] == lines[-1]["bad"] == 0
    assert lines[-1]["cpu_seconds"] > 0 and lines[-1]["memory"] > 50
    assert sum(lines[-1]["share"].values()) == pytest.approx(1, abs=0.03)


def test_an_interrupted_run_goes_on_exactly(sphere_folder, tmp_path, monkeypatch):
    """Ten steps, Ctrl-C, and ten more equal twenty, in the weights, their average and the optimisers."""
    folder = sphere_folder.parent
    options = {"steps": 20, "source": "predicted", "optimizer": "muon", "accumulate": 2}
    train(make_config(folder, tmp_path / "whole", **options))
    step = Trainer.train_step

    def interrupted(self):
        if self.state.step == 9:
            os.kill(os.getpid(), signal.SIGINT)
        return step(self)

    with monkeypatch.context() as m, pytest.raises(KeyboardInterrupt):
        m.setattr(Trainer, "train_step", interrupted)
        train(make_config(folder, tmp_path / "parts", **options))
    assert load(tmp_path / "parts")["progress"]["step"] == 10
    train(make_config(folder, tmp_path / "parts", **options))
    parts, whole = load(tmp_path / "parts"), load(tmp_path / "whole")
    for state in (parts, whole):
        state["optimisers"] = [o["state"] for o in state["optimisers"]]
    for kind in ("network", "average", "optimisers"):
        torch.testing.assert_close(parts[kind], whole[kind], rtol=0, atol=0)


@pytest.mark.parametrize("source", ["sweep", "predicted"])
def test_pictures_alone_train_what_needs_no_depth(pictures, tmp_path, source):
    config = make_config(pictures, tmp_path / "run", source=source, steps=2)
    train(config)
    assert load(tmp_path / "run")["progress"]["bad"] == 0
    with pytest.raises(InputError, match=r"pictures: .*--geometric.*render it with passes"):
        train(replace(config, geometric=0.3))


def load(folder) -> dict:
    return torch.load(folder / "state.pt", weights_only=True)


@pytest.mark.parametrize(
    ("options", "head", "source"),
    [
        ({"preset": "large"}, "paper", "predicted"),
        ({"preset": "base"}, "paper", "predicted"),
        ({"preset": "small"}, "kinematic", "given"),
        ({}, "kinematic", "given"),
        ({"preset": "large", "head": "kinematic", "source": "sweep"}, "kinematic", "sweep"),
        ({"source": "predicted", "head": "paper"}, "paper", "predicted"),
    ],
)
def test_a_preset_brings_its_network_and_options_change_it(tmp_path, options, head, source):
    """`large` and `base` alone are the paper's networks."""
    config = network_config(make_config(tmp_path, tmp_path / "run", **options))
    assert (config.head, config.source) == (head, source)
    assert (config.depth_range, config.time, config.free, config.motion) == ("paper", "free", 0, "gaussian")
    more = {"depth_range": "centred", "time": "aligned", "free": 3}
    config = network_config(make_config(tmp_path, tmp_path / "run", **options, **more))
    assert (config.head, config.source) == (head, source)
    assert (config.depth_range, config.time, config.free) == ("centred", "aligned", 3)


@pytest.mark.parametrize("sampling", ["paper", "static"])
def test_every_sampling_trains(sphere_folder, tmp_path, sampling):
    options = {"sampling": sampling, "steps": 2, "head": "paper", "source": "predicted", "views": None, "targets": None}
    train(make_config(sphere_folder.parent, tmp_path / "run", **options))
    assert load(tmp_path / "run")["progress"]["bad"] == 0


def test_training_starts_from_static_weights(sphere_folder, tmp_path):
    """As the paper's does from GS-LRM; a network of another kind is refused in one sentence."""
    folder = sphere_folder.parent
    options = {"source": "predicted", "steps": 1, "rate": 1e-300}  # too little to change a weight
    train(make_config(folder, tmp_path / "still", **options, sampling="static"))
    start = tmp_path / "still" / "network.safetensors"
    train(make_config(folder, tmp_path / "moving", **options, init=start))
    a, b = load(tmp_path / "still")["network"], load(tmp_path / "moving")["network"]
    for k in a:
        torch.testing.assert_close(a[k].half().float(), b[k], rtol=0, atol=0)
    with pytest.raises(InputError, match="head"):
        train(make_config(folder, tmp_path / "other", **options, head="paper", init=start))


@pytest.fixture
def trainer(sphere_folder, tmp_path):
    """trainer(**options) -> a Trainer at the start of a run on the spheres."""

    def make(**options) -> Trainer:
        config = make_config(sphere_folder.parent, tmp_path / "run", source="predicted", **options)
        return Trainer(make_network(config), ClipDataset(config.data, config.cache), config)

    return make


def test_bad_samples_are_left_out_and_counted(trainer, monkeypatch):
    t = trainer(accumulate=2)
    before = {k: v.clone() for k, v in t.network.state_dict().items()}
    forward = Network.forward
    count = iter(range(10))

    def poisoned(self, *inputs):
        g = forward(self, *inputs)
        return g.map(lambda x: x * float("nan")) if next(count) in (0, 2, 3) else g

    monkeypatch.setattr(Network, "forward", poisoned)
    result = t.train_step()  # one of two samples is good
    after = {k: v.clone() for k, v in t.network.state_dict().items()}
    assert np.isfinite(result.loss) and result.learned
    assert t.state.nonfinite_samples == 1 and t.state.skipped_steps == 0
    assert any((before[k] != after[k]).any() for k in after)
    result = t.train_step()  # none is
    assert np.isnan(result.loss) and not result.learned and t.state.nonfinite_samples == 3
    for k, v in t.network.state_dict().items():
        assert torch.equal(v, after[k])


def test_weights_that_run_away_stop_the_run_and_are_not_saved(sphere_folder, tmp_path):
    folder, out = sphere_folder.parent, tmp_path / "run"
    with pytest.raises(InputError, match=r"run: .* at step 1 .*lower --rate than 1e\+09\.$"):
        train(make_config(folder, out, rate=1e9, steps=3))
    assert not list(out.iterdir())
    train(make_config(folder, out, steps=2))
    kept = {f.name: f.read_bytes() for f in out.iterdir()}
    with pytest.raises(InputError, match=r"at step 3 .*lower --rate"):
        train(make_config(folder, out, rate=1e9, steps=9))
    assert {f.name: f.read_bytes() for f in out.iterdir()} == kept
    train(make_config(folder, out, steps=4))  # and goes on from there
    assert load(out)["progress"]["step"] == 4
    state = load(out)
    state["network"]["embed.weight"][0, 0] = float("inf")
    torch.save(state, out / "state.pt")
    with pytest.raises(InputError, match=r"cannot be resumed .*not finite"):
        train(make_config(folder, out, steps=9))


@pytest.mark.parametrize(("steps", "stops"), [(500, 102), (30, 30)])
def test_a_run_that_learns_nothing_any_more_stops(sphere_folder, tmp_path, monkeypatch, steps, stops):
    """Whether its losses are not finite for long, or to its end; a few of them are borne."""
    folder, out = sphere_folder.parent, tmp_path / "run"
    train(make_config(folder, out, steps=2))
    kept = (out / "state.pt").read_bytes()
    monkeypatch.setattr(Trainer, "backward_sample", lambda self, sample, rng: None)
    with pytest.raises(InputError, match=f"at step {stops} .*lower --rate"):
        train(make_config(folder, out, steps=steps))
    assert (out / "state.pt").read_bytes() == kept
    train(make_config(folder, out, steps=9))
    assert load(out)["progress"]["step"] == 9


def test_checkpointing_keeps_less_and_changes_nothing(trainer):
    """The same gradients, from fewer bytes kept for the backward pass."""
    found = []
    for checkpointing in (False, True):
        t = trainer(checkpointing=checkpointing)
        t.network.train()
        rng = np.random.default_rng(0)
        sample = t.clips.sample(rng, 2, 4)
        kept = [0]

        def pack(x, kept=kept):
            kept[0] += x.nbytes
            return x

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
            assert t.backward_sample(sample, rng) is not None
        found.append(({k: p.grad for k, p in t.network.named_parameters()}, kept[0]))
    (plain, more), (checkpointed, less) = found
    torch.testing.assert_close(checkpointed, plain, rtol=1e-5, atol=1e-7)
    assert less < more


def test_perceptual_loss_joins_where_there_are_weights(trainer, tmp_path, monkeypatch):
    without = trainer().train_step()
    torch.save(VGG(19).state_dict(), tmp_path / "vgg19.pth")
    monkeypatch.setenv("TIMESPLAT_WEIGHTS", str(tmp_path))
    joined = trainer().train_step()
    assert joined.loss > without.loss and joined.psnr == without.psnr
    assert trainer(perceptual=0.0).train_step() == without
