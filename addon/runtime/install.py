# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes the model runtime: a virtual environment with all that `model.worker` needs. A script of the standard library
alone, which Blender's own Python runs as a child process (`python -I`, so that it can import nothing of this package);
the protocol is that of `child_process`.

    {"task": "install", "folder": F, "work": W, "build": "cpu" | "cuda"}
        makes F; W: an existing folder on the same disk, which the caller removes afterwards. All is made in W and
        moved to F when it is whole and its packages have been imported: what fails or is killed leaves F as it was.
        done {"python": path within F, "build", "versions": {package: version}, "bytes": n}, also kept in
        F/timesplat.json
    {"task": "uninstall", "folder": F, "work": W}   done {"bytes": freed}

pip's configuration counts (a mirror, a proxy, certificates, constraints). Where it names no index of its own, torch
comes from PyTorch's index for the build (https://pytorch.org/get-started) if pip's default has another build for this
system; all else comes from pip's default.
"""

from __future__ import annotations

import contextlib
import glob
import importlib.util
import json
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import threading
import time
from collections.abc import Iterator
from pathlib import Path

# What the worker needs: package, oldest version, the module that proves it. (numpy may be 2 or newer here: only
# beside bpy 5.0's wheel must it be older.)
REQUIREMENTS = (
    ("torch", "2.6", "torch"),
    ("numba", "0.60", "numba"),
    ("safetensors", "0.5", "safetensors"),
    ("numpy", "1.26", "numpy"),
    ("pillow", "11", "PIL"),
    ("tqdm", "4.66", "tqdm"),
    ("OpenEXR", "3.3", "OpenEXR"),
    ("usd-core", "26.3", "pxr"),
    ("av", "14", "av"),
    ("fourdgs", "0.6", "fourdgs"),
)
ISOLATED = ("-I", "-X", "utf8")  # Python without what the user has set, that speaks UTF-8 on Windows too
TORCH_INDEX = {"cpu": "https://download.pytorch.org/whl/cpu", "cuda": "https://download.pytorch.org/whl/cu128"}
DOWNLOAD_BYTES = {"cpu": 300e6, "cuda": 4e9}  # bytes, roughly, so that the bar moves evenly
OR_ANOTHER_PYTHON = "or name a Python that has timesplat[torch] in Timesplat's preferences"
INSTALL_REDISTRIBUTABLE = "install Microsoft's Visual C++ Redistributable, and then the runtime again"
NETWORK_FAILED = (
    r"NewConnectionError|ConnectTimeout|ReadTimeout|NameResolutionError|getaddrinfo|ProxyError|SSLError|Max retries|"
    r"Network is unreachable|Connection (refused|reset|aborted)|Temporary failure in name resolution"
)
PATH_TOO_LONG = r"Windows Long Path support"
DISK_FULL = r"No space left on device|Disk quota exceeded|not enough space on the disk|WinError 112"
WINDOWS = os.name == "nt"
MOVE_PAUSES = (0.5, 1, 2, 4)  # seconds: on Windows a virus scanner holds for a moment what is new
IMPORT_ALL = """
import importlib, importlib.metadata, json, sys
versions = {}
for name, _, module in json.loads(sys.argv[1]):
    print("importing", name, file=sys.stderr, flush=True)
    importlib.import_module(module)
    versions[name] = importlib.metadata.version(name)
print(json.dumps(versions))
"""


class InstallError(Exception):
    """Why it cannot go on, in one sentence."""


def main() -> int:
    """Answers the one request on standard input; returns the exit code."""

    def say(event: str, **values) -> None:
        print(json.dumps({"event": event, **values}), flush=True)

    def progress(fraction: float, text: str) -> None:
        say("progress", fraction=round(fraction, 4), text=text)

    try:
        request = json.loads(sys.stdin.readline())
        if request.get("watch"):
            threading.Thread(target=_leave_when_stdin_closes, daemon=True).start()
        folder, work = Path(request["folder"]), Path(request["work"])
        if request["task"] == "install":
            say("done", **install(folder, work, request["build"], progress))
        else:
            say("done", bytes=uninstall(folder, work, progress))
    except InstallError as e:
        say("error", message=str(e))
        return 1
    except OSError as e:
        say("error", message=_disk_is_full(work) if e.errno == 28 else f"{e.filename or folder}: {e.strerror or e}.")
        return 1
    return 0


def install(folder: Path, work: Path, build: str, progress) -> dict:
    """See the module. progress(fraction 0..1, text). Raises InstallError, OSError."""
    new = work / "venv"
    progress(0.0, "making a virtual environment")
    pip = _make_venv(new)
    python = _python_in(new)
    wanted = [f"{name}>={version}" for name, version, _ in REQUIREMENTS]
    if _has_index(pip) or (build == "cpu" and sys.platform != "linux"):  # elsewhere pip's default is for the CPU
        steps = [(wanted, [], 0.05, 0.92)]
    else:
        steps = [(wanted[:1], ["--index-url", TORCH_INDEX[build]], 0.05, 0.7), (wanted[1:], [], 0.7, 0.92)]
    for packages, options, first, last in steps:
        command = [*pip, "install", "--no-cache-dir", "--no-compile", "--only-binary", ":all:", "--no-input"]
        command += ["--disable-pip-version-check", "--progress-bar", "off", *options, *packages]
        _pip_install(command, new, work, build, lambda f, text, a=first, b=last: progress(a + (b - a) * f, text))
    progress(0.92, "importing what was installed")
    versions = _import_all(python)
    progress(0.98, "moving it into place")
    info = {"python": str(python.relative_to(new)), "build": build, "versions": versions, "bytes": size(new)}
    (new / "timesplat.json").write_text(json.dumps(info))
    folder.parent.mkdir(parents=True, exist_ok=True)
    old = work / "old"
    if folder.exists():
        _move(folder, old)
    try:
        _move(new, folder)
    except InstallError:
        if old.exists():
            _move(old, folder)
        raise
    return info


def uninstall(folder: Path, work: Path, progress) -> int:
    """Removes the folder, whole or not at all as far as others can see; returns how many bytes it had."""
    if not folder.exists():
        return 0
    progress(0.1, "removing the runtime")
    count = size(folder)
    _move(folder, work / "old")
    shutil.rmtree(work / "old", ignore_errors=True)
    return count


def size(folder: Path) -> int:
    """Bytes of all files below a folder; links count nothing."""
    files = (os.path.join(root, name) for root, _, names in os.walk(folder) for name in names)
    return sum(os.path.getsize(f) for f in files if not os.path.islink(f))


def _make_venv(folder: Path) -> list[str]:
    """Makes a virtual environment; returns the command that is pip for it."""
    has = [name for name in ("venv", "ensurepip", "pip") if importlib.util.find_spec(name)]
    if "venv" not in has or len(has) < 2:
        raise InstallError(
            f"{sys.executable}: this Python comes without venv and ensurepip (Debian and Ubuntu keep them in "
            f"python3-venv); install them, {OR_ANOTHER_PYTHON}."
        )
    if "/AppTranslocation/" in sys.executable:
        raise InstallError(
            f"{sys.executable}: macOS runs this Blender from a place that is gone tomorrow; move it into the folder "
            "Applications, start it there, and install again."
        )
    python = _python_in(folder)
    commands = [[sys.executable, *ISOLATED, "-m", "venv", "--without-pip", str(folder)]]
    if "ensurepip" in has:
        commands.append([str(python), *ISOLATED, "-m", "ensurepip", "--default-pip"])
    for command in commands:
        try:
            done = _run(command)
        except OSError as e:
            done = subprocess.CompletedProcess(command, 1, "", str(e))
        said = done.stdout + done.stderr
        _log(said)
        if done.returncode:
            if re.search(DISK_FULL, said):
                raise InstallError(_disk_is_full(folder))
            last = said.strip().splitlines()[-1][:200] if said.strip() else f"code {done.returncode}"
            raise InstallError(
                f"{sys.executable}: no virtual environment can be made with this Python ({last}); reinstall Blender, "
                f"{OR_ANOTHER_PYTHON}."
            )
    outside = [sys.executable, *ISOLATED, "-m", "pip", "--python", str(python)]
    return [str(python), *ISOLATED, "-m", "pip"] if "ensurepip" in has else outside


def _has_index(pip: list[str]) -> bool:
    """Whether pip is configured for an index of the user's own, or for none."""
    done = _run([*pip, "config", "list"])
    _log(done.stdout + done.stderr)
    return bool(re.search(r"^[\w:]+\.(index-url|no-index)=", done.stdout.replace("_", "-"), re.MULTILINE))


def _pip_install(command: list[str], venv: Path, work: Path, build: str, progress) -> None:
    """Runs pip; its bar is made of the bytes that lie in its temporary folder and of the packages in place."""
    _log(" ".join(command))
    lines: list[str] = []
    loading, count, total = "packages", 0, 0
    site = next(iter(venv.glob("lib/python*/site-packages")), venv / "Lib" / "site-packages")
    before = len(list(site.glob("*.dist-info")))
    with contextlib.closing(_stream(command)) as said:
        for line in said:
            if line:
                _log(line)
                lines.append(line.strip())
            if found := re.match(r"\s*(?:Downloading|Processing) (?:\S*/)?([\w.]+)-\S+\.whl", line):
                loading = found[1]
            if build == "cpu" and re.match(r"\s*(Collecting|Installing collected packages:.*) (nvidia|cuda)-", line):
                raise InstallError(
                    f"The index that pip is configured for has torch only with CUDA; choose CUDA, {OR_ANOTHER_PYTHON}."
                )
            if line.startswith("Installing collected packages:"):
                total = line.count(",") + 1
            if total:
                count = min(len(list(site.glob("*.dist-info"))) - before, total)
                progress(0.7 + 0.3 * count / total, f"installing: {count} of {total} packages")
            else:
                got = _bytes_fetched(work)
                progress(
                    min(0.7 * got / DOWNLOAD_BYTES[build], 0.69), f"fetching {loading} ({got / 1e6:.0f} MB so far)"
                )
    if _child.returncode:
        raise InstallError(_explain(lines, work))


def _bytes_fetched(work: Path) -> int:
    """Bytes of the wheels in pip's temporary folders. pip removes such folders at any moment: what goes while it is
    counted counts nothing (`glob` passes over it, which `Path.glob` does not)."""
    total = 0
    for wheel in glob.iglob(f"{glob.escape(str(work))}/pip-*/*.whl"):
        with contextlib.suppress(OSError):
            total += os.path.getsize(wheel)
    return total


def _run(command: list[str]) -> subprocess.CompletedProcess:
    """Runs a program to its end, and collects what it prints. It must not inherit standard input, which a thread of
    ours reads: on Windows it would hang at its start (cpython #78961)."""
    return subprocess.run(
        command, env=_env(), stdin=subprocess.DEVNULL, capture_output=True, encoding="utf-8", errors="replace"
    )


_child: subprocess.Popen | None = None


def _stream(command: list[str]) -> Iterator[str]:
    """The lines that a program prints as they come, and "" every half second without one. It ends with us."""
    global _child
    _child = subprocess.Popen(
        command, env=_env(), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        encoding="utf-8", errors="replace",
    )  # fmt: skip
    said: queue.SimpleQueue[str | None] = queue.SimpleQueue()

    def read() -> None:
        for line in _child.stdout:
            said.put(line.rstrip("\n"))
        said.put(None)

    threading.Thread(target=read, daemon=True).start()
    try:
        while True:
            try:
                line = said.get(timeout=0.5)
            except queue.Empty:
                yield ""
                continue
            if line is None:
                _child.wait()
                return
            yield line
    finally:
        if _child.poll() is None:
            _child.kill()
        _child.wait()


def _explain(lines: list[str], work: Path) -> str:
    """One sentence out of what pip printed before it failed."""
    text = "\n".join(lines)
    if re.search(DISK_FULL, text):
        return _disk_is_full(work)
    if re.search(PATH_TOO_LONG, text):
        return (
            f"{work}: the names of torch's files are longer than Windows allows below this folder; switch on its long "
            "paths (LongPathsEnabled), and install again."
        )
    if found := re.search(NETWORK_FAILED, text):
        return (
            f"The package index cannot be reached ({found[0]}); check the network, or pip's configuration if there is "
            "a mirror or a proxy, and install again."
        )
    here = f"Python {sys.version_info.major}.{sys.version_info.minor} on {sysconfig.get_platform()}"
    if found := re.findall(r"No matching distribution found for ([\w.-]+)", text):
        return (
            f"The package index has no {found[-1]} for {here}, or does not answer; check pip's configuration, try "
            f"another version of Blender, {OR_ANOTHER_PYTHON}."
        )
    errors = [x for x in lines if x.startswith("ERROR:")] or [x for x in lines if x] or ["it said nothing"]
    return f"pip could not install the packages: {errors[-1].removeprefix('ERROR:').strip()[:300]} (see the log)."


def _disk_is_full(folder: Path) -> str:
    return f"{folder}: the disk is full; make room there and install again."


def _import_all(python: Path) -> dict[str, str]:
    """Imports everything in the new environment; returns the versions."""
    done = _run([str(python), *ISOLATED, "-c", IMPORT_ALL, json.dumps(REQUIREMENTS)])
    _log(done.stderr)
    if done.returncode:
        last = re.findall(r"^importing (\S+)", done.stderr, re.MULTILINE)
        said = done.stderr.strip().splitlines()[-1][:300] if done.stderr.strip() else f"code {done.returncode}"
        todo = INSTALL_REDISTRIBUTABLE if re.search(r"WinError (126|1114)\b", said) else OR_ANOTHER_PYTHON[3:]
        raise InstallError(f"{last[-1] if last else 'Python'} was installed but does not start here ({said}); {todo}.")
    return json.loads(done.stdout.splitlines()[-1])


def _move(source: Path, target: Path) -> None:
    try:
        for pause in MOVE_PAUSES if WINDOWS else ():
            with contextlib.suppress(PermissionError):
                return os.rename(source, target)
            time.sleep(pause)
        os.rename(source, target)
    except OSError as e:
        raise InstallError(
            f"{source}: it cannot be moved ({e.strerror or e}); wait until no reconstruction runs, and try again."
        ) from None


def _python_in(venv: Path) -> Path:
    return venv / ("Scripts/python.exe" if WINDOWS else "bin/python")


def _env() -> dict[str, str]:
    """The environment without what would lead Python or pip out of the virtual environment."""
    out = ("PYTHON", "__PYVENV", "PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PIP_USER", "PIP_PYTHON")
    return {k: v for k, v in os.environ.items() if not k.startswith(out)} | {"PIP_USER": "0"}


def _log(text: str) -> None:
    if text.strip():
        print(text.rstrip(), file=sys.stderr, flush=True)


def _leave_when_stdin_closes() -> None:
    while os.read(0, 1 << 16):
        pass
    if not WINDOWS and os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)  # pip and all that it has started, and this process
    if _child and _child.poll() is None:
        _child.kill()
    os._exit(3)


if __name__ == "__main__":
    sys.exit(main())
