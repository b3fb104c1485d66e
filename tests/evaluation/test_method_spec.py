# SPDX-License-Identifier: GPL-3.0-or-later
"""Method specs: what they say, what they are refused for, and what tells two of them apart."""

import pytest
import torch

from timesplat.datagen.sequence import InputError
from timesplat.evaluation.method_spec import parse_spec, parse_specs
from timesplat.model.checkpoints_io import save_network
from timesplat.model.fitting.budget import SECONDS
from timesplat.model.network import Config, Network


def test_every_part():
    assert parse_spec(" lift").has_depth and not parse_spec("sweep").has_depth
    both = parse_spec("guided+refine:10+budget:10%+dense")
    assert (both.method, both.refine, both.budget, both.dense) == ("guided", 10.0, "10%", True)
    assert both.label == "guided+refine:10+budget:10%+dense"
    assert parse_spec("guided+dense+budget:10%+refine:10").fingerprint == both.fingerprint  # in any order
    assert parse_spec("lift+budget:auto").budget == "auto" and parse_spec("lift+budget:500").refine is None
    spec = parse_spec("mine=4dgs:10+budget:10%")
    assert (spec.label, spec.method, spec.seconds, spec.baseline) == ("mine", "4dgs", 10, True)
    assert spec.fit_seconds == 10 + SECONDS
    assert parse_spec("guided+budget:5%").fit_seconds == SECONDS
    assert parse_spec("guided+refine:3+budget:5%").fit_seconds == 3
    assert parse_spec("4dgs", seconds=7).seconds == 7 and parse_spec("lift", seconds=7).seconds is None


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("magic", "no such method"),
        ("lift+fast", r"lift\+fast: fast is no option"),
        ("lift+budget:x", "write .*budget:N"),
        ("lift+refine:1+refine:2", "given twice"),
        ("lift+budget:0%", "a number of Gaussians"),
        ("lift:3", "take seconds"),
        ("guided@huge", "no checkpoint huge"),
        ("predicted@nothing.safetensors", "no checkpoint nothing"),
        ("", "write .*METHOD"),
        ("a=b=lift", "write .*METHOD"),
    ],
)
def test_refused_in_one_sentence(text, says):
    with pytest.raises(InputError, match=says):
        parse_spec(text)


def test_lists():
    assert [m.label for m in parse_specs("lift, x=lift,")] == ["lift", "x"]
    for text in ("", "lift,lift"):
        with pytest.raises(InputError, match="each once"):
            parse_specs(text)


def test_another_checkpoint_is_another_spec(tmp_path):
    found = []
    for n in range(2):
        torch.manual_seed(n)
        path = tmp_path / "net.safetensors"
        save_network(path, Network(Config(width=32, depth=1, heads=2)))
        spec = parse_spec(f"mine=predicted@{path}+refine:2")
        assert spec.checkpoint == path == spec.weights and spec.refine == 2
        found.append(spec.fingerprint)
    assert found[0] != found[1]
