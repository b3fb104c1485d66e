# SPDX-License-Identifier: GPL-3.0-or-later
"""The buttons that install, remove and test the runtime, in a Blender, with packages of a few bytes."""

import sys
from pathlib import Path

import pytest

from ..packages import BUTTONS, pip, wheel

WHOLE = r"""
result = dict(offline=op("install_runtime"), refused=left())
bpy.context.preferences.system.use_online_access = True
result |= dict(online=bpy.app.online_access, able=able, installed=op("install_runtime"), left=left())
if able:
    told = options.installed_runtime()
    result |= dict(versions=told["versions"], bytes=told["bytes"], python=options.worker_python(),
                   folder=str(folders.runtime_folder()), message=jobs.JOBS[-1].message, text=text(),
                   asked=asked[:])
    done = [sys.argv[1], "-c", "print('{\"event\": \"done\"}')"]
    stage = buttons._install_stage
    buttons._install_stage = lambda request: lambda folder: process.Child(done, request, folder)
    report[:] = ["ok lift: fine", "FAILED: network: no weights; copy them again."]
    result |= dict(ill=op("install_runtime"), one=text(), stays=options.installed_runtime() == told)
    report.clear()
    result |= dict(dead=op("install_runtime"), still=left())
    os.unlink(options.worker_python())
    try:
        options.worker_python()
    except Exception as e:
        result["dangling"] = str(e)
    buttons._install_stage = stage
    result |= dict(removed=op("uninstall_runtime"), after=left(), state=options.installed_runtime())
    result["other"] = options.worker_python()
tell(**result)
"""


def test_installed_from_the_preferences(installed, index):
    told = installed(BUTTONS + WHOLE, sys.executable, env=pip(index))
    assert "Preferences > System > Network > Allow Online Access" in told["offline"] and told["refused"] == []
    assert told["online"] is True
    if not told["able"]:  # Debian's Blender
        assert "python3-venv" in told["installed"] and told["left"] == []
        return
    assert told["installed"] == ["FINISHED"] and told["left"] == ["venv"]
    assert told["versions"]["torch"] == "2.6.7" and told["python"].startswith(told["folder"])
    size = f"{told['bytes'] / 1e6:.0f} MB on disk"
    assert told["message"] == f"Runtime installed: torch 2.6.7, {size}. Self-test: all 2 passed."
    assert told["text"] == ["ok lift: fine", "ok network: fine"]
    assert told["asked"] == [[told["python"], {"task": "selftest", "device": "cpu", "checkpoint": None}]]
    assert "The runtime is installed. Self-test: 1 of 2 failed; the text 'Timesplat self-test' says" in told["ill"]
    assert told["one"][1].startswith("FAILED: network") and told["stays"]
    assert "The runtime is installed. The process ended with code 1: no AVX" in told["dead"]
    assert told["still"] == ["venv"]
    assert "no such file; the Blender that the runtime was made with is gone" in told["dangling"]
    assert told["removed"] == ["FINISHED"] and told["after"] == [] and told["state"] is None
    assert told["other"] == sys.executable  # TIMESPLAT_PYTHON


CANCEL = """
import time
if not able:
    tell(able=False)
    raise SystemExit
def alive():
    here = str(folders.user_folder("runs"))
    return [p for p in os.listdir("/proc") if p.isdigit() and cwd(p).startswith(here)]
def cwd(p):
    try:
        return os.readlink(f"/proc/{p}/cwd")
    except OSError:
        return ""
seen = []
for until in ("virtual", "importing"):
    stage = buttons._install_stage({"task": "install", "build": "cpu"})
    job = jobs.start("Install runtime", [stage], buttons._finish_install)
    while until not in job.text and job.state == "running":
        job.advance(0.1)
    busy = op("install_runtime") if until == "importing" else ""
    before = len(alive())
    job.cancel()
    for _ in range(600):  # what was killed may take its time to die
        if not alive():
            break
        time.sleep(0.1)
    seen.append([job.state, before > 0, alive(), left(), job.message])
tell(able=True, seen=seen, busy=busy, log=job.log_text())
"""


@pytest.mark.skipif(not Path("/proc/self/cwd").exists(), reason="looks at processes in /proc")
def test_cancelled_in_the_middle_nothing_is_left(installed, index):
    wheel(index, "torch", "9.9", "import time; time.sleep(999)")
    told = installed(BUTTONS + "bpy.context.preferences.system.use_online_access = True\n" + CANCEL, env=pip(index))
    if not told["able"]:
        pytest.skip("this Blender's Python has no ensurepip")
    for state, ran, alive, left, message in told["seen"]:
        assert state == "cancelled" and ran and alive == [] and left == [] and message == "Cancelled."
    assert "Install runtime runs; wait for its end, or cancel it." in told["busy"]
    assert "Successfully installed" in told["log"]


SELF_TEST = """
prefs = bpy.context.preferences.addons[name].preferences
result = dict(well=op("self_test"), message=jobs.JOBS[-1].message, two=text())
open(sys.argv[2], "w").write("weights")
prefs.checkpoint, prefs.device = sys.argv[2], "mps"
report = ["ok lift: fine", "FAILED: network: no weights; copy them again."]
result |= dict(ill=op("self_test"), one=text())
prefs.checkpoint += ".not"
result["missing"] = op("self_test")
prefs.checkpoint, prefs.python = "", "/nowhere/python"
result["python"] = op("self_test")
tell(**result, asked=asked, torch="torch" in sys.modules)
"""


def test_self_test(installed, tmp_path):
    path = tmp_path / "mine.safetensors"
    told = installed(BUTTONS + SELF_TEST, sys.executable, path)
    assert told["well"] == ["FINISHED"] and told["message"] == "Self-test: all 2 passed."
    assert told["two"] == ["ok lift: fine", "ok network: fine"] and not told["torch"]
    assert "Self-test: 1 of 2 failed; the text 'Timesplat self-test' says what to do." in told["ill"]
    assert told["one"][1] == "FAILED: network: no weights; copy them again."
    request = {"task": "selftest", "device": "cpu", "checkpoint": None}
    assert told["asked"] == [
        [sys.executable, request],
        [sys.executable, {**request, "device": "mps", "checkpoint": str(path)}],
    ]
    assert "mine.safetensors.not: no such checkpoint; correct it in Timesplat's preferences" in told["missing"]
    assert "/nowhere/python: no such file; correct Python in Timesplat's preferences." in told["python"]
