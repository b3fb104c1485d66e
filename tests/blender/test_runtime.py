# SPDX-License-Identifier: GPL-3.0-or-later
"""The runtime's installation, with pip and virtual environments as they are, and packages of a few bytes."""

import contextlib
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import tomllib
import zipfile
from pathlib import Path

import pytest

from .helpers import ROOT

SCRIPT = ROOT / "addon" / "runtime" / "install.py"


def load():
    spec = importlib.util.spec_from_file_location("runtime", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


runtime = load()


def wheel(folder: Path, name: str, version: str, code: str = "", needs=()) -> None:
    """A package of one module, as pip installs it."""
    module = {n: m for n, _, m in runtime.REQUIREMENTS}.get(name, name.replace("-", "_"))
    info = f"{name.replace('-', '_')}-{version}.dist-info"
    meta = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
    files = {
        f"{module}/__init__.py": code,
        f"{info}/METADATA": meta + "".join(f"Requires-Dist: {x}\n" for x in needs),
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    with zipfile.ZipFile(folder / f"{name.replace('-', '_')}-{version}-py3-none-any.whl", "w") as z:
        for path, text in {**files, f"{info}/RECORD": "".join(f"{f},,\n" for f in [*files, f"{info}/RECORD"])}.items():
            z.writestr(path, text)


@pytest.fixture
def index(tmp_path):
    """A folder of all packages that the runtime needs, each newer than it must be."""
    folder = tmp_path / "wheels"
    folder.mkdir()
    for name, version, _ in runtime.REQUIREMENTS:
        wheel(folder, name, f"{version}.7")
    return folder


def pip(index: Path) -> dict:
    """A pip that knows this folder and nothing else."""
    return {"PIP_CONFIG_FILE": os.devnull, "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(index)}


# As if this Python had no ensurepip: pip, which is slow to be put in place, then works from outside.
QUICK = f"""
import importlib.util, runpy
find = importlib.util.find_spec
importlib.util.find_spec = lambda name: None if name == "ensurepip" else find(name)
runpy.run_path({str(SCRIPT)!r}, run_name="__main__")
"""


class Run:
    """One request to the script, with a folder of its own to work in, which goes as a Job's does."""

    def __init__(self, tmp_path: Path, task: str, env: dict, whole: bool = False, **request) -> None:
        self.folder, work = tmp_path / "user" / "venv", tmp_path / "work"
        work.mkdir(exist_ok=True)
        request = {"task": task, "folder": str(self.folder), "work": str(work), **request}
        clean = {k: v for k, v in os.environ.items() if not k.startswith("PIP_")}
        with subprocess.Popen(
            [sys.executable, "-I", *([str(SCRIPT)] if whole else ["-c", QUICK])],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env={**clean, "TMPDIR": str(work), **env}, start_new_session=True,
        ) as process:  # fmt: skip
            said, self.log = process.communicate(json.dumps(request) + "\n", timeout=300)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        shutil.rmtree(work, ignore_errors=True)
        self.events = [json.loads(line) for line in said.splitlines()]
        self.end, self.code = self.events[-1], process.returncode


def test_installs_again_and_removes(tmp_path, index):
    poison = tmp_path / "poison"
    poison.mkdir()
    for name in ("pip", "torch", "sitecustomize"):
        (poison / f"{name}.py").write_text("raise SystemExit('this should not have been found')")
    astray = {"PYTHONPATH": str(poison), "PIP_USER": "1", "PIP_TARGET": str(tmp_path / "target")}
    first = Run(tmp_path, "install", pip(index) | astray, whole=True, build="cpu")
    assert first.code == 0, first.log
    told = first.end
    assert told["event"] == "done" and told["build"] == "cpu" and not (tmp_path / "target").exists()
    assert told["versions"] == {name: f"{version}.7" for name, version, _ in runtime.REQUIREMENTS}
    steps = [e["fraction"] for e in first.events[:-1]]
    assert steps == sorted(steps) and steps[0] == 0 and steps[-1] < 1 and all(e["text"] for e in first.events[:-1])
    texts = " ".join(e["text"] for e in first.events[:-1])
    for word in ("virtual environment", "fetching", "installing", "importing", "into place"):
        assert word in texts
    python = first.folder / told["python"]
    where = subprocess.run([python, "-c", "import torch, sys; print(torch.__file__)"], capture_output=True, text=True)
    assert where.stdout.startswith(str(first.folder)), where
    note = json.loads((first.folder / "timesplat.json").read_text())
    assert note == {k: told[k] for k in note} and set(note) == {"python", "build", "versions", "bytes"}
    files = [f for f in first.folder.rglob("*") if f.is_file() and not f.is_symlink() and f.name != "timesplat.json"]
    assert told["bytes"] == sum(f.stat().st_size for f in files) > 1e6

    wheel(index, "torch", "9.9")
    again = Run(tmp_path, "install", pip(index), build="cpu")
    assert again.code == 0 and again.end["versions"]["torch"] == "9.9"

    # What fails leaves the one that works.
    wheel(index, "torch", "10", "raise OSError('libc10.so: cannot open shared object file')")
    broken = Run(tmp_path, "install", pip(index), build="cpu")
    assert broken.code == 1 and broken.end["event"] == "error"
    assert broken.end["message"].startswith("torch was installed but does not start here (OSError: libc10.so")
    assert json.loads((first.folder / "timesplat.json").read_text())["versions"]["torch"] == "9.9"
    assert list((tmp_path / "user").iterdir()) == [first.folder]

    taken = runtime.size(first.folder)
    gone = Run(tmp_path, "uninstall", {})
    assert gone.code == 0 and gone.end["bytes"] == taken > 1e4 and list((tmp_path / "user").iterdir()) == []
    assert Run(tmp_path, "uninstall", {}).end == {"event": "done", "bytes": 0}


def test_a_package_that_is_not_there(tmp_path, index):
    for old in index.glob("usd_core*"):
        old.unlink()
    run = Run(tmp_path, "install", pip(index), build="cpu")
    assert run.code == 1 and not run.folder.exists()
    version = f"Python {sys.version_info.major}.{sys.version_info.minor} on "
    assert run.end["message"].startswith(f"The package index has no usd-core for {version}")
    assert "preferences" in run.end["message"] and "\n" not in run.end["message"]


def test_no_network(tmp_path):
    env = {"PIP_CONFIG_FILE": os.devnull, "PIP_INDEX_URL": "http://127.0.0.1:9/simple", "PIP_RETRIES": "1"}
    env |= {"NO_PROXY": "127.0.0.1", "no_proxy": "127.0.0.1"}
    run = Run(tmp_path, "install", env, build="cuda")
    assert run.code == 1 and not run.folder.exists()
    assert run.end["message"].startswith("The package index cannot be reached (")


def test_counts_while_pip_makes_and_removes_its_folders(tmp_path):
    kept = tmp_path / "pip-unpack-1" / "torch.whl"
    kept.parent.mkdir()
    kept.write_bytes(b"x" * 1000)
    rounds, finished, found = 0, threading.Event(), set()

    def churn():
        nonlocal rounds
        while not finished.is_set():
            (tmp_path / "pip-build-tracker-2").mkdir()
            (tmp_path / "pip-build-tracker-2" / "a.whl").touch()
            shutil.rmtree(tmp_path / "pip-build-tracker-2")
            rounds += 1

    thread = threading.Thread(target=churn)
    thread.start()
    try:
        while rounds < 500 and thread.is_alive():
            found.add(runtime._bytes_fetched(tmp_path))
    finally:
        finished.set()
        thread.join()
    assert found == {1000}


def test_the_cpu_build_never_takes_cuda(tmp_path, index):
    wheel(index, "torch", "9.9", needs=["nvidia-cublas"])
    wheel(index, "nvidia-cublas", "13")
    run = Run(tmp_path, "install", pip(index), build="cpu")
    assert run.code == 1 and not run.folder.exists() and "torch only with CUDA" in run.end["message"]
    assert Run(tmp_path, "install", pip(index), build="cuda").end["versions"]["torch"] == "9.9"


def test_torch_comes_from_the_builds_index_unless_pip_has_one(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(runtime, "_make_venv", lambda folder: ["pip"])
    monkeypatch.setattr(
        runtime, "_pip_install", lambda command, *rest: asked.append(command[command.index("--no-input") :])
    )
    monkeypatch.setattr(runtime, "_import_all", lambda python: {})
    for has, build in ((False, "cpu"), (False, "cuda"), (True, "cpu")):
        monkeypatch.setattr(runtime, "_has_index", lambda pip, has=has: has)
        (tmp_path / "w" / "venv").mkdir(parents=True)
        runtime.install(tmp_path / "v", tmp_path / "w", build, lambda *_: None)
        subprocess.run(["rm", "-rf", tmp_path / "w", tmp_path / "v"], check=True)
    assert len(asked) == 5
    for command, url in ((asked[0], "/whl/cpu"), (asked[2], "/whl/cu128")):
        assert command[command.index("--index-url") + 1].endswith(url) and command[-1].startswith("torch>=")
    for command in (asked[1], asked[3], asked[4]):
        assert "--index-url" not in command and "numba>=0.60" in command
    assert "torch>=2.6" in asked[4] and "torch>=2.6" not in asked[1]


def test_whether_pip_has_an_index(monkeypatch):
    for variable, value, expected in (
        ("PIP_INDEX_URL", "https://mirror.example/simple", True),
        ("PIP_NO_INDEX", "1", True),
        ("PIP_EXTRA_INDEX_URL", "https://ours.example/simple", False),
        ("PIP_CERT", "/etc/ssl/cert.pem", False),
    ):
        with monkeypatch.context() as m:
            for key in [k for k in os.environ if k.startswith("PIP_")]:
                m.delenv(key)
            m.setenv("PIP_CONFIG_FILE", os.devnull)
            m.setenv(variable, value)
            assert runtime._has_index([sys.executable, "-m", "pip"]) is expected, variable


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("ERROR: Could not install packages due to an OSError: [Errno 28] No space left on device", "the disk is full"),
        ("WARNING: Retrying after connection broken by 'NameResolutionError(...)'", "cannot be reached"),
        ("ERROR: something else\nmore", "something else (see the log)"),
        ("", "it said nothing"),
    ],
)
def test_what_pip_says_becomes_one_sentence(line, words):
    why = runtime._explain(line.split("\n"), Path("somewhere"))
    assert words in why and "\n" not in why and why.endswith(".")


def test_a_python_without_ensurepip(tmp_path, monkeypatch):
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n: None if n in ("ensurepip", "pip") else real(n))
    with pytest.raises(runtime.InstallError, match=r"python3-venv.*preferences\.$"):
        runtime._make_venv(tmp_path / "v")
    assert not (tmp_path / "v").exists()
    monkeypatch.setattr(importlib.util, "find_spec", lambda n: None if n == "ensurepip" else real(n))
    pip = runtime._make_venv(tmp_path / "v")  # a pip from outside serves as well
    assert pip[-2] == "--python" and runtime._python_in(tmp_path / "v").exists()


@pytest.mark.skipif(not Path("/proc/self/cwd").exists(), reason="looks at processes in /proc")
def test_it_goes_with_blender(tmp_path, index):
    """Standard input ends when Blender is gone; then pip and what it started go too."""
    wheel(index, "torch", "9.9", "import time; time.sleep(999)")
    work = tmp_path / "work"
    work.mkdir()
    request = {"task": "install", "folder": str(tmp_path / "venv"), "work": str(work), "build": "cpu", "watch": True}
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, "-I", "-c", QUICK], stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True, cwd=work,
        env={**os.environ, **pip(index)}, start_new_session=True,
    ) as process:  # fmt: skip
        process.stdin.write(json.dumps(request) + "\n")
        process.stdin.flush()
        assert any("importing" in line for line in process.stdout)
        process.stdin.close()
        assert process.wait(60) != 0

    def here(pid: str) -> bool:
        try:
            return os.readlink(f"/proc/{pid}/cwd").startswith(str(work))
        except OSError:
            return False

    end = time.monotonic() + 60
    while (left := [pid for pid in os.listdir("/proc") if pid.isdigit() and here(pid)]) and time.monotonic() < end:
        time.sleep(0.05)
    assert left == [] and not (tmp_path / "venv").exists()


def test_it_needs_what_the_package_says():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    named = project["dependencies"] + extras["torch"] + extras["usd"]
    said = {re.split("[><=]", x)[0]: re.search(r">=([\d.]+)", x)[1] for x in named}
    assert said == {name: version for name, version, _ in runtime.REQUIREMENTS}


# ---------------------------------------------------------------- in Blender

ABLE = """
able = bool(importlib.util.find_spec("ensurepip") or importlib.util.find_spec("pip"))
options, folders, jobs = (part(f"addon.runtime.{x}") for x in ("worker_options", "folders", "jobs"))
buttons = part("addon.operators.runtime_buttons")
def op(name, **options):
    try:
        return list(getattr(bpy.ops.timesplat, name)(**options))
    except RuntimeError as e:
        return str(e)
def left():
    return sorted(x.name for n in ("runs", "runtime") for x in folders.user_folder(n, create=False).glob("*"))
process, asked = part("addon.runtime.child_process"), []
report = ["ok lift: fine", "ok network: fine"]
def worker(python, request, folder):
    asked.append([python, request])
    code = f"print({json.dumps({'event': 'done', 'report': report})!r})" if report else "raise SystemExit('no AVX')"
    return process.Child([sys.argv[1], "-c", code], request, folder)
process.start_worker = worker
text = lambda: bpy.data.texts["Timesplat self-test"].as_string().splitlines()
"""
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
    told = installed(ABLE + WHOLE, sys.executable, env=pip(index))
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
    told = installed(ABLE + "bpy.context.preferences.system.use_online_access = True\n" + CANCEL, env=pip(index))
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
    told = installed(ABLE + SELF_TEST, sys.executable, path)
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


DRAW = """
from unittest.mock import MagicMock
versions = {"torch": "2", "numpy": "2"}
options._installed = {"python": "bin/python", "build": "cpu", "versions": versions, "bytes": 5e8}
buttons.self_test_report[:] = ["ok lift: fine", "FAILED: network: " + "long " * 40]
buttons.last_job = MagicMock(spec=jobs.Job, state="running", fraction=0.5, text="half", label="Install", number=1)
jobs.JOBS.append(buttons.last_job)
prefs = bpy.context.preferences.addons[name].preferences
def draw():
    layout = MagicMock()
    type(prefs).draw(MagicMock(layout=layout), bpy.context)
    return " ".join(map(str, layout.mock_calls))
draw()
files = []
watching = True
sys.addaudithook(lambda event, args: watching and event in ("open", "os.listdir", "os.scandir", "import") and
                 files.append([event, str(args)]))
drawn = draw()
buttons.last_job.state, buttons.last_job.message = "failed", "No room."
drawn += draw()
watching = False
jobs.JOBS.clear()
tell(files=files, drawn=drawn)
"""


def test_drawing_reads_no_file(installed):
    told = installed(ABLE + DRAW)
    assert told["files"] == []
    for words in ("'checkpoint'", "torch 2 (CPU), 500 MB", "numpy 2", "factor=0.5", "No room."):
        assert words in told["drawn"], words
    for operator in ("install_runtime", "uninstall_runtime", "self_test", "cancel", "log"):
        assert f"timesplat.{operator}" in told["drawn"]
