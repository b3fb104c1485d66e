"""The state of a run on disk: all of it comes back, and what is not one is refused."""

import pytest
import torch

from timesplat.datagen.sequence import InputError
from timesplat.model.network import Config, Network
from timesplat.model.training.optimizers import clip_and_step
from timesplat.model.training.run_state import RunState


def begin(seed: int) -> RunState:
    torch.manual_seed(seed)
    return RunState.begin(Network(Config(width=32, depth=1, heads=2)), "adamw")


def take_a_step(state: RunState) -> None:
    for p in state.network.parameters():
        p.grad = torch.full_like(p, 0.01)
    assert clip_and_step(state.optimizers, 1e-3, warmed_up=False)
    state.step += 1
    state.update_average()


def test_all_of_it_comes_back(tmp_path):
    one, other = begin(0), begin(1)
    take_a_step(one)
    one.seconds, one.cpu_seconds, one.skipped_steps, one.nonfinite_samples = 1.5, 2.5, 3, 4
    one.save(tmp_path / "state.pt")
    other.load(tmp_path / "state.pt", "cpu")
    assert (other.step, other.seconds, other.cpu_seconds) == (1, 1.5, 2.5)
    assert (other.skipped_steps, other.nonfinite_samples) == (3, 4)
    for state in (one, other):
        take_a_step(state)
    for k, v in one.network.state_dict().items():
        assert torch.equal(other.network.state_dict()[k], v) and torch.equal(other.average[k], one.average[k])
    assert [f.name for f in tmp_path.iterdir()] == ["state.pt"]


def test_the_average_follows_the_weights():
    state = begin(0)
    before = {k: v.clone() for k, v in state.average.items()}
    take_a_step(state)  # of the first step 10 of 11 parts count
    now = state.network.state_dict()
    for k, v in state.averaged_network().state_dict().items():
        torch.testing.assert_close(v, before[k] / 11 + now[k] * 10 / 11)


def test_what_is_no_state_is_refused(tmp_path):
    path = tmp_path / "state.pt"
    path.write_bytes(b"not a run")
    with pytest.raises(InputError, match=r"state\.pt: this run cannot be resumed"):
        begin(0).load(path, "cpu")
    state = begin(0)
    state.network.embed.weight.data[0, 0] = float("inf")
    state.save(path)
    with pytest.raises(InputError, match=r"cannot be resumed .*not finite"):
        begin(0).load(path, "cpu")
