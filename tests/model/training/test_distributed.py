"""Several processes: two of them do what one does with twice the samples."""

import os
import subprocess
import sys

import pytest
import torch

pytestmark = pytest.mark.skipif(not torch.distributed.is_available(), reason="this torch has no torch.distributed")

# The command line with a network small enough for a test.
MAIN = """
import sys
from timesplat.cli import main
from timesplat.model.network import PRESETS, Config
PRESETS["tiny"] = Config(width=32, depth=1, heads=2)
sys.exit(main(sys.argv[1:]))
"""


def test_two_processes_equal_one_with_twice_the_samples(sphere_folder, tmp_path):
    script = tmp_path / "main.py"
    script.write_text(MAIN)
    common = ["train", str(sphere_folder), "--source", "predicted", "--steps", "3", "--targets", "2", "--views", "4"]
    common += ["--cache", str(tmp_path / "cache"), "--perceptual", "0"]
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    for name, start, accumulate in (("one", [sys.executable], "4"), ("two", launch, "2")):
        command = [*start, str(script), *common, "--out", str(tmp_path / name), "--accumulate", accumulate]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr
    one, two = (torch.load(tmp_path / n / "state.pt", weights_only=True) for n in ("one", "two"))
    assert one["progress"]["step"] == two["progress"]["step"] == 3
    for k, v in one["average"].items():
        torch.testing.assert_close(two["average"][k], v, rtol=0, atol=1e-6)
