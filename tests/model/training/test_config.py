"""The options of `timesplat train`: defaults written once, words that the code knows, refusals that name the option."""

import argparse
from dataclasses import MISSING, fields
from pathlib import Path

import pytest

from timesplat.datagen.readers.options import ReadOptions
from timesplat.datagen.sequence import InputError
from timesplat.model.training.config import TrainConfig, add_arguments, choices


def parse(words: str = "") -> TrainConfig:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return TrainConfig.from_arguments(parser.parse_args(["a", "b", "--out", "run", *words.split()]))


def test_the_command_line_has_an_option_for_every_field_and_its_default():
    assert parse() == TrainConfig((Path("a"), Path("b")), Path("run"))
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    of_reading = {f.name for f in fields(ReadOptions)}
    named = {f.name for f in fields(TrainConfig)} - {"reading"}
    assert {a.dest for a in parser._actions} - {"help"} - of_reading == named
    assert parse("--axes opencv --fps 5").reading == ReadOptions(axes="opencv", fps=5)
    for field in fields(TrainConfig):
        if field.default is not MISSING:
            assert parser.get_default(field.name) == field.default


def test_options_fill_the_fields():
    config = parse("--depth-range centred --optimiser muon --minutes 1.5 --free 3 --bf16 --rate 1e-3 --static")
    assert (config.depth_range, config.optimizer, config.minutes, config.free) == ("centred", "muon", 1.5, 3)
    assert config.bf16 and not config.checkpointing and config.rate == 1e-3 and config.sampling == "static"


def test_the_words_are_those_that_the_code_knows():
    from timesplat.model.network import PRESETS
    from timesplat.model.training.view_sampling import SAMPLERS

    assert set(choices("preset")) == set(PRESETS) and set(choices("sampling")) == set(SAMPLERS)
    assert choices("rate") == choices("data") == ()


@pytest.mark.parametrize("rate", ["0", "-1e-4", "nan", "inf"])
def test_a_rate_that_is_none_is_refused(rate):
    with pytest.raises(InputError, match=r"^--rate .*: give a number above 0\.$"):
        parse(f"--rate={rate}")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"steps": 0}, "--steps 0: give a whole number above 0."),
        ({"shrink": -1}, "--shrink -1: give a whole number above 0."),
        ({"accumulate": 0}, "--accumulate 0: give a whole number above 0."),
        ({"preset": "tall"}, "--preset tall: choose one of tiny, small, base, large."),
        ({"mix": "2:1"}, "--mix 2:1: not weights of hq4d:4d:3d; write 200:50:1, or uniform."),
        ({"depth_range": "near"}, "--depth-range near: choose one of paper, centred."),
        (
            {"motion": "hexplane", "geometric": 0.5},
            "--geometric compares velocities, and a HexPlane has none; leave it out.",
        ),
    ],
)
def test_what_no_run_can_use_is_refused_by_its_option(options, says):
    with pytest.raises(InputError) as e:
        TrainConfig((Path("data"),), Path("run"), **options)
    assert str(e.value) == says
