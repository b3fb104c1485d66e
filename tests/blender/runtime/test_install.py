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
from pathlib import Path

import pytest

from ..helpers import ROOT
from ..packages import SCRIPT, pip, runtime, wheel

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
    named = project["dependencies"] + [x for k in ("torch", "usd", "video", "fourdgs") for x in extras[k]]
    said = {re.split("[><=]", x)[0]: re.search(r">=([\d.]+)", x)[1] for x in named}
    assert said == {name: version for name, version, _ in runtime.REQUIREMENTS}
