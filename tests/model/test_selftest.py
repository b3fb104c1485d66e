# SPDX-License-Identifier: GPL-3.0-or-later
"""The self-test's lines where all is well and where something is broken, and the scene that it is about."""

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from timesplat.datagen.rigs import Shot, spherical
from timesplat.datagen.sequence import opengl_to_opencv
from timesplat.model import selftest
from timesplat.model.checkpoints_io import CHECKPOINTS

NAMES = ["Python", "packages", "device", "memory", "files", "lift", "checkpoints", "network", "refinement", "USD"]


def by_name(report: list[str]) -> dict[str, str]:
    assert all(line.startswith(("ok ", "FAILED: ")) and "\n" not in line for line in report)
    lines = {line.removeprefix("ok ").removeprefix("FAILED: ").split(":")[0]: line for line in report}
    assert list(lines) == NAMES
    return lines


def test_all_is_well(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    told = []
    lines = by_name(selftest.selftest(progress=lambda fraction, text: told.append((fraction, text))))
    assert all(line.startswith("ok ") for line in lines.values()), lines
    assert [text.split(" (")[0] for _, text in told] == NAMES and told[0][0] == 0 and told[-1][0] < 1
    for file in CHECKPOINTS.glob("*.safetensors"):
        assert f"{file.stem} (" in lines["checkpoints"]
    for name in ("lift", "network", "refinement"):  # 28.2, 27.4 and 28.5 dB when this was written
        quality = float(lines[name].split(" dB")[0].split()[-1])
        assert selftest.LEAST + 3 < quality < 40
    assert list(tmp_path.iterdir()) == []


def test_a_broken_checkpoint_is_named_and_the_rest_is_tried(tmp_path):
    whole = (CHECKPOINTS / "guided.safetensors").read_bytes()
    path = tmp_path / "cut.safetensors"
    path.write_bytes(whole[: len(whole) // 2])
    lines = by_name(selftest.selftest(checkpoint=path))
    assert lines["checkpoints"].startswith("FAILED") and str(path) in lines["checkpoints"]
    assert "copy or train it again" in lines["checkpoints"]
    assert lines["network"] == "FAILED: network: not tried; see checkpoints."
    assert [n for n in NAMES if lines[n].startswith("FAILED")] == ["checkpoints", "network"]


def test_the_worker_hands_the_report_over():
    """Of a device that is not there, which ends soon."""
    request = json.dumps({"task": "selftest", "device": "nonsense", "checkpoint": "nowhere.safetensors"})
    command = [sys.executable, "-m", "timesplat.model.worker"]
    run = subprocess.run(command, input=request + "\n", capture_output=True, text=True, timeout=600)
    events = [json.loads(line) for line in run.stdout.splitlines()]
    assert run.returncode == 0 and [e["event"] for e in events] == ["progress"] * len(NAMES) + ["done"]
    lines = by_name(events[-1]["report"])
    assert lines["device"].startswith("FAILED: device: nonsense: torch cannot") and lines["lift"].startswith("ok")


def test_a_checkpoint_of_ones_own_is_told_and_not_judged(tmp_path, monkeypatch):
    monkeypatch.setattr(selftest, "LEAST", 99.0)
    path = shutil.copy(CHECKPOINTS / "predicted.safetensors", tmp_path / "mine.safetensors")
    lines = by_name(selftest.selftest(checkpoint=path))
    assert lines["network"].startswith("ok ") and "mine (" in lines["checkpoints"]
    assert "instead of 99" in lines["lift"] and "install the runtime again" in lines["lift"]
    assert lines["refinement"].endswith("not tried; see lift.") and lines["USD"].endswith("not tried; see lift.")


def test_what_is_missing_is_named_with_the_remedy(monkeypatch):
    monkeypatch.setitem(selftest.PACKAGES, "sparkles", "sparkles_that_nobody_has")
    lines = by_name(selftest.selftest("nonsense"))
    assert lines["packages"].startswith("FAILED: packages: sparkles (No module named")
    assert "install the runtime again" in lines["packages"]
    assert lines["device"] == "FAILED: device: not tried; see packages." and lines["Python"].startswith("ok")


def test_a_device_that_is_not_there(monkeypatch):
    import torch

    if torch.backends.mps.is_available():
        pytest.skip("it is there")
    lines = by_name(selftest.selftest("mps"))
    assert lines["device"].startswith("FAILED: device: mps: torch cannot use this device here")
    assert lines["device"].endswith("choose cpu.") and lines["lift"].startswith("ok")


def test_the_scene_is_what_it_says():
    """Depth, colour and motion of the sphere, from its equation."""
    shot = Shot(3, "a", "a", spherical(70, 10))
    rgba, passes = selftest._picture(shot)
    hit = np.isfinite(passes.depth)
    assert 0.1 < hit.mean() < 0.4 and (rgba[..., 3] == hit).all() and (rgba[~hit] == 0).all()
    c2w, f = opengl_to_opencv(shot.c2w), selftest.SIZE / 2 / np.tan(np.radians(25))

    def world(x, y, z):
        return np.stack([(x - selftest.SIZE / 2) / f * z, (y - selftest.SIZE / 2) / f * z, z], -1) @ c2w[:3, :3].T

    y, x = np.nonzero(hit)
    point = world(x + 0.5, y + 0.5, passes.depth[hit]) + c2w[:3, 3]
    centre = selftest.STEP * (3 - 3.5)
    np.testing.assert_allclose(np.linalg.norm(point - centre, axis=1), selftest.RADIUS, atol=1e-6)
    assert ((point - centre) @ c2w[:3, 2] < 0).all()  # the near side
    for flow, step in ((passes.flow_next, selftest.STEP), (passes.flow_prev, -selftest.STEP)):
        there = flow[hit] + np.stack([x, y], -1) + 0.5
        moved = (point + step - c2w[:3, 3]) @ c2w[:3, :3]
        ray = world(there[:, 0], there[:, 1], moved[:, 2])
        np.testing.assert_allclose(ray, point + step - c2w[:3, 3], atol=1e-5)
