"""What a run tells of itself."""

import math
import time

import pytest
import torch

from timesplat.model.network import Config, Network
from timesplat.model.training.reporting import STAGES, StageTimer, StepResult, peak_memory, report_line
from timesplat.model.training.run_state import RunState


def test_time_is_told_by_stage():
    timer = StageTimer("cpu")
    assert timer.total == 0 and set(timer.fractions.values()) == {0}
    for name, seconds in (("data", 0.01), ("network", 0.01), ("network", 0.02)):
        with timer.stage(name):
            time.sleep(seconds)
    assert tuple(timer.seconds) == STAGES and timer.seconds["raster"] == 0
    assert timer.seconds["data"] >= 0.01 and timer.seconds["network"] >= 0.03
    assert sum(timer.fractions.values()) == pytest.approx(1)
    timer.reset()
    assert timer.total == 0


def test_a_line_is_the_mean_of_what_was_finite():
    torch.manual_seed(0)
    state = RunState.begin(Network(Config(width=32, depth=1, heads=2)), "adamw")
    state.step, state.skipped_steps, state.nonfinite_samples = 3, 1, 2
    timer = StageTimer("cpu")
    timer.seconds["data"], timer.seconds["raster"] = 1.0, 3.0
    results = [StepResult(0.1, 20.0, True), StepResult(math.nan, math.nan, False), StepResult(0.3, 22.0, True)]
    line = report_line(state, results, 6, timer)
    assert line["memory"] == pytest.approx(peak_memory(), abs=50)
    del line["memory"]
    assert line == {
        "step": 3,
        "seconds": 0.0,
        "cpu_seconds": 0.0,
        "loss": 0.2,
        "psnr": 21.0,
        "samples_per_s": 1.5,
        "skipped": 1,
        "bad": 2,
        "share": {"data": 0.25, "geometry": 0.0, "network": 0.0, "raster": 0.75},
    }
    assert math.isnan(report_line(state, results[1:2], 1, timer)["loss"])
