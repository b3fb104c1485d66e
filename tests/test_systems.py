# SPDX-License-Identifier: GPL-3.0-or-later
"""What Windows and macOS do otherwise than Linux, as far as it can be played here: files that are open cannot be moved,
programs speak the code page of the country, capitals count for nothing, functions of POSIX are not there."""

import ast
import json
import os
import subprocess
import sys
import types
from pathlib import Path

import pytest

from timesplat.addon import package
from timesplat.addon.runtime import child_process as process
from timesplat.addon.runtime import install as runtime
from timesplat.datagen import render_asset, whole_folders
from timesplat.datagen.farm import render_assets
from timesplat.datagen.render_job import RenderSettings
from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.datagen.whole_folders import move
from timesplat.model.io import atomic, usd_apart
from timesplat.model.io.ply import write_ply

from .assets import make_asset
from .datagen.test_sequence import make as make_sequence


@pytest.fixture
def windows(monkeypatch):
    """The modules believe that they run on Windows; a pause takes no time."""
    for module in (whole_folders, atomic, process):
        monkeypatch.setattr(module, "WINDOWS", True)
    monkeypatch.setattr(whole_folders.time, "sleep", lambda seconds: None)


@pytest.fixture
def held(monkeypatch):
    """held(path, times): so often somebody has it open when it shall be moved, from or to there."""
    left, real = {}, os.replace

    def replace(source, target):
        for path in map(str, (source, target)):
            if left.get(path, 0) > 0:
                left[path] -= 1
                raise PermissionError(13, "Access is denied", path)
        real(source, target)

    monkeypatch.setattr(os, "replace", replace)
    return lambda path, times: left.update({str(path): times})


# ---------------------------------------------------------------- files that are open


def test_a_scanner_holds_a_new_file_for_a_moment(tmp_path, windows, held):
    (tmp_path / "a").write_text("new")
    held(tmp_path / "a", 2)
    move(tmp_path / "a", tmp_path / "b")
    assert [p.name for p in tmp_path.iterdir()] == ["b"]


def test_elsewhere_nobody_is_waited_for(tmp_path, held, monkeypatch):
    monkeypatch.setattr(whole_folders, "WINDOWS", False)
    held(tmp_path / "b", 1)
    with pytest.raises(PermissionError):
        move(tmp_path / "a", tmp_path / "b")


def test_a_file_that_stays_open_is_named_with_the_remedy(tmp_path, windows, held):
    path = tmp_path / "a.ply"
    write_ply(path, make_asset(3))
    before = path.read_bytes()
    held(path, 99)
    with pytest.raises(InputError, match=r"a\.ply: it cannot be written \(Access is denied\); close the program that"):
        write_ply(path, make_asset(4))
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["a.ply"]


def test_a_sequence_that_is_in_use_stays_whole(tmp_path, windows, held):
    folder = tmp_path / "a"
    make_sequence(folder)
    held(folder, 99)
    with pytest.raises(PermissionError):
        make_sequence(folder, frames=2)
    assert len(read_sequence(folder).views) == 3 and os.listdir(tmp_path) == ["a"]


def test_a_sequence_that_cannot_be_put_in_place_leaves_the_old(tmp_path, monkeypatch):
    folder, real = tmp_path / "a", os.replace
    make_sequence(folder)

    def replace(source, target):
        if str(target) == str(folder) and not str(source).endswith(".old"):
            raise PermissionError(13, "Access is denied")
        real(source, target)

    monkeypatch.setattr(os, "replace", replace)
    monkeypatch.setattr(whole_folders, "WINDOWS", False)
    with pytest.raises(PermissionError):
        make_sequence(folder, frames=2)
    assert len(read_sequence(folder).views) == 3 and os.listdir(tmp_path) == ["a"]


def test_a_sequence_is_open_to_those_to_whom_new_folders_are(tmp_path):
    before = os.umask(0o027)
    try:
        make_sequence(tmp_path / "a")
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o750


def test_no_temporary_folder_fails_because_a_scanner_holds_a_file_in_it():
    calls, root = [], Path(whole_folders.__file__).parent.parent
    for file in [root / "cli.py", *(f for d in ("addon", "datagen", "model") for f in (root / d).rglob("*.py"))]:
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "tempfile.TemporaryDirectory":
                calls.append((file.name, {k.arg for k in node.keywords}))
    assert len(calls) > 5
    assert [c for c in calls if "ignore_cleanup_errors" not in c[1] and "dir" not in c[1]] == []


# ---------------------------------------------------------------- letters

OLD = {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LC_ALL": "C", "PYTHONIOENCODING": "cp1252"}


def foreign(code: str, *args) -> subprocess.CompletedProcess:
    """Python where files are ASCII and pipes cp1252, as they are on Windows at most places."""
    command = [sys.executable, "-c", code, *map(str, args)]
    return subprocess.run(command, env=os.environ | OLD, capture_output=True, timeout=120)


def test_names_of_any_alphabet_in_a_sequence(tmp_path):
    folder = tmp_path / "a"
    make_sequence(folder)
    text = json.loads((folder / "transforms.json").read_text())
    text["frames"][0]["camera"] = "Füße 足"
    (folder / "transforms.json").write_text(json.dumps(text, ensure_ascii=False), encoding="utf-8")
    code = "import sys\nfrom timesplat.datagen.sequence import read_sequence\n"
    done = foreign(code + "print(ascii(read_sequence(sys.argv[1]).views[0].camera))", folder)
    assert done.stdout.decode().strip() == ascii("Füße 足"), done.stderr.decode()


def test_the_command_line_says_what_the_console_cannot(tmp_path):
    write_ply(tmp_path / "足.ply", make_asset(3))
    code = "import sys\nfrom timesplat.cli import main\nsys.exit(main(sys.argv[1:]))"
    done = foreign(code, "export", tmp_path / "足.ply", tmp_path / "手.ply")
    assert done.returncode == 0 and b"3 Gaussians" in done.stdout, done.stderr.decode()


def test_the_worker_understands_any_name_on_any_console(tmp_path):
    """Requests and answers are ASCII; what it logs is UTF-8."""
    write_ply(tmp_path / "足.ply", make_asset(3))
    request = {"task": "export", "asset": str(tmp_path / "足.ply"), "out": "手"}
    done = subprocess.run(
        [sys.executable, "-X", "utf8", "-c", process.launch("model.worker")],
        input=json.dumps(request).encode() + b"\n", capture_output=True, env=os.environ | OLD, timeout=120,
    )  # fmt: skip
    events = [json.loads(line.decode("ascii")) for line in done.stdout.splitlines()]
    assert events[-1]["event"] == "error" and events[-1]["message"].startswith("手: cannot write that; choose")


# ---------------------------------------------------------------- names


def test_clips_and_assets_that_differ_in_capitals_alone_get_folders_of_their_own(tmp_path):
    clips = [types.SimpleNamespace(name=name) for name in ("Run", "run", "RUN!", "walk")]
    assert list(render_asset._folder_names(clips)) == ["Run", "run-2", "RUN-3", "walk"]
    both = [str(tmp_path / folder / name) for folder, name in (("x", "Fox.glb"), ("y", "fox.glb"))]
    said = []
    render_assets(both, tmp_path / "out", RenderSettings(), report=said.append)
    assert any(s.startswith(f"{both[1]}: it would be written over that of {both[0]}") for s in said)


def test_blenders_builder_is_found_in_an_app_bundle(tmp_path, monkeypatch):
    tool = tmp_path / "Blender.app/Contents/Resources/5.2" / package.BUILDER
    program = tmp_path / "Blender.app/Contents/MacOS/Blender"
    for file in (tool, program):
        file.parent.mkdir(parents=True)
        file.touch()
    monkeypatch.setattr(package.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(package.shutil, "which", lambda name: str(program))
    assert package._builder() == tool.resolve()


# ---------------------------------------------------------------- processes


@pytest.fixture
def tasks(windows, monkeypatch):
    """The commands that were run to the end, and how each child was started; without anything of POSIX."""
    started, ran, real = [], [], subprocess.Popen

    def popen(command, creationflags=0, **more):
        assert "start_new_session" not in more
        started.append(creationflags)
        return real(command, **more)

    def run(command, **more):
        ran.append((command, more))
        raise FileNotFoundError(2, "No such file or directory", command[0])

    monkeypatch.setattr(process.subprocess, "Popen", popen)
    monkeypatch.setattr(process.subprocess, "run", run)
    monkeypatch.delattr(os, "killpg")
    return types.SimpleNamespace(started=started, ran=ran)


def test_a_child_without_a_window_ends_with_all_that_it_started(tmp_path, tasks):
    c = process.Child([sys.executable, "-c", "import time; time.sleep(99)"], {}, tmp_path)
    c.kill(), c.kill()
    assert tasks.started == [0x08000200]  # CREATE_NO_WINDOW, CREATE_NEW_PROCESS_GROUP
    ((command, more),) = tasks.ran
    assert command == ["taskkill", "/F", "/T", "/PID", str(c.process.pid)] and more["creationflags"] == 0x08000000
    assert c.process.poll() is not None  # although there was no taskkill


def test_the_log_is_closed_when_a_child_is_gone(tmp_path, tasks):
    """Else its folder could not be removed."""
    code = 'import time; print(\'{"event": "done"}\', flush=True); time.sleep(99)'
    c = process.Child([sys.executable, "-c", code], {}, tmp_path)
    assert c.poll(60) == [{"event": "done"}]
    c.kill()
    assert not c._logger.is_alive()


def test_codes_of_windows_are_said_as_one_looks_them_up(tmp_path):
    c = process.Child([sys.executable, "-c", ""], {}, tmp_path)
    assert c.poll(60)[0]["message"] == "The process ended with code 0: it said nothing"
    c.process.returncode = 0xC0000005
    assert c._why_it_ended() == "The process ended with code 0xc0000005: it said nothing"


def test_what_the_worker_starts_does_not_wait_for_its_input():
    """On Windows a program hangs at its start while the pipe that it inherits is read; so it inherits nothing."""
    code = """
import subprocess, sys
from timesplat.model import worker
def task(request, progress):
    said = subprocess.run([sys.executable, "-c", "print(len(input() or 'x'))"], capture_output=True, text=True).stderr
    return {"report": [said.strip().splitlines()[-1]]}
worker._selftest = task
sys.exit(worker.main([]))
"""
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", code], stdin=pipe, stdout=pipe) as p:
        p.stdin.write(b'{"task": "selftest", "watch": true}\nhello\n')
        p.stdin.flush()
        assert json.loads(p.stdout.readline())["report"] == ["EOFError: EOF when reading a line"]
        p.stdin.close()


def test_the_installer_gives_its_input_to_nobody(tmp_path, monkeypatch):
    given = []
    monkeypatch.setattr(
        runtime.subprocess,
        "run",
        lambda command, **more: given.append(more) or subprocess.CompletedProcess(command, 0, "{}", ""),
    )
    runtime._make_venv(tmp_path / "venv"), runtime._has_index(["pip"]), runtime._import_all(tmp_path / "python")
    assert len(given) >= 3
    assert all((m["stdin"], m["encoding"], m["errors"]) == (subprocess.DEVNULL, "utf-8", "replace") for m in given)


def test_only_linux_limits_the_address_space(monkeypatch):
    """On macOS it is larger than the memory from the start."""
    resource = pytest.importorskip("resource")
    asked = []
    monkeypatch.setattr(resource, "setrlimit", lambda *limits: asked.append(limits))
    for platform in ("darwin", "win32", "linux"):
        monkeypatch.setattr(sys, "platform", platform)
        usd_apart.limit_memory()
    assert len(asked) == 1


# ---------------------------------------------------------------- the runtime


@pytest.mark.parametrize(
    ("platform", "build", "indices"),
    [
        ("linux", "cpu", ["cpu", None]),
        ("win32", "cpu", [None]),
        ("darwin", "cpu", [None]),
        ("win32", "cuda", ["cu128", None]),
    ],
)
def test_where_torch_comes_from(tmp_path, monkeypatch, platform, build, indices):
    asked = []
    monkeypatch.setattr(runtime, "_make_venv", lambda folder: folder.mkdir() or ["pip"])
    monkeypatch.setattr(runtime, "_pip_install", lambda command, *rest: asked.append(command))
    monkeypatch.setattr(runtime, "_import_all", lambda python: {})
    monkeypatch.setattr(runtime, "_has_index", lambda pip: False)
    monkeypatch.setattr(sys, "platform", platform)
    (tmp_path / "w").mkdir()
    runtime.install(tmp_path / "venv", tmp_path / "w", build, lambda *_: None)
    named = [c[c.index("--index-url") + 1].rpartition("/")[2] if "--index-url" in c else None for c in asked]
    assert named == indices


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("ERROR: Could not install packages due to an OSError: [Errno 2] No such file or directory: 'C:\\\\U\\\\x.h'\n"
         "HINT: This error might have occurred since this system does not have Windows Long Path support enabled.",
         "LongPathsEnabled"),
        ("ERROR: [WinError 112] There is not enough space on the disk", "the disk is full"),
    ],
)  # fmt: skip
def test_what_pip_says_on_windows(tmp_path, line, words):
    why = runtime._explain(line.split("\n"), tmp_path)
    assert words in why and "\n" not in why


def test_torch_lacks_a_library_of_microsofts(monkeypatch, tmp_path):
    said = 'importing torch\nOSError: [WinError 126] The specified module could not be found. Error loading "c10.dll"'
    monkeypatch.setattr(runtime, "_run", lambda command: subprocess.CompletedProcess(command, 1, "", said))
    with pytest.raises(
        runtime.InstallError, match=r"^torch was installed but does not start.*Visual C\+\+ Redistributable"
    ):
        runtime._import_all(tmp_path / "python")


def test_a_blender_that_macos_runs_from_elsewhere_gets_no_runtime(monkeypatch, tmp_path):
    """It would be gone with that place."""
    place = "/private/var/folders/zz/T/AppTranslocation/0A/d/Blender.app/Contents/Resources/5.2/python/bin/python3.13"
    monkeypatch.setattr(sys, "executable", place)
    with pytest.raises(runtime.InstallError, match="move it into the folder Applications"):
        runtime._make_venv(tmp_path / "venv")


def test_a_new_runtime_is_moved_although_a_scanner_looks_at_it(tmp_path, monkeypatch):
    tries, real = [], os.rename

    def rename(source, target):
        tries.append(source)
        if len(tries) < 3:
            raise PermissionError(13, "Access is denied")
        real(source, target)

    (tmp_path / "a").mkdir()
    monkeypatch.setattr(runtime, "WINDOWS", True)
    monkeypatch.setattr(runtime.time, "sleep", lambda seconds: None)
    monkeypatch.setattr(os, "rename", rename)
    runtime._move(tmp_path / "a", tmp_path / "b")
    assert len(tries) == 3 and (tmp_path / "b").is_dir()
