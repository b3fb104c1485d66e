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


def test_what_goes_by_steps_has_no_seconds_and_prints_of_its_own():
    draft, counted = parse_spec("tracks+quality:draft", seconds=7), parse_spec("mine=guided+steps:40+budget:10%")
    assert (draft.label, draft.quality, draft.seconds, draft.counted) == ("tracks+quality:draft", "draft", None, 300)
    assert (counted.label, counted.steps, counted.refine, counted.counted) == ("mine", 40, None, 40)
    assert draft.fitted and counted.fitted and not parse_spec("guided").fitted and not parse_spec("tracks:3").counted
    texts = ("tracks", "tracks:10", "tracks+quality:draft", "tracks+quality:fine", "tracks+steps:300", "tracks+steps:1")
    assert len({parse_spec(t).fingerprint for t in texts}) == len(texts)
    assert parse_spec("lift").fingerprint == "lift None None None False -"  # as rows have it that were kept before
    assert draft.fit_seconds < parse_spec("tracks+quality:best").fit_seconds


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("magic", "no such method"),
        ("lift+fast", r"lift\+fast: fast is no option"),
        ("lift+budget:x", "write .*budget:N"),
        ("lift+refine:1+refine:2", "given twice"),
        ("lift+budget:0%", "a number of Gaussians"),
        ("lift:3", "take seconds"),
        ("tracks+quality:superb", "write .*quality:NAME"),
        ("tracks:3+quality:draft", "tracks:3.quality:draft: seconds and quality: .*; give one of them"),
        ("guided+quality:draft+steps:3", "quality and steps: .*; give one of them"),
        ("guided+refine:3+steps:3", "steps and refine: .*; give one of them"),
        ("4dgs+steps:0", "0 steps: give 1 or more"),
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
