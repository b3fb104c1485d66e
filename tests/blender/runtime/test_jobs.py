# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs from outside: cancelled, killed, starved, flooded. After each nothing is left, and Blender goes on."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes in /proc")

HEAD = """
import random, shutil, signal, time
from pathlib import Path
jobs, process = part("addon.runtime.jobs"), part("addon.runtime.child_process")
reconstruct = part("addon.operators.reconstruct")
scene, chosen = bpy.context.scene, bpy.context.scene.timesplat
scene.frame_start, scene.frame_end = 1, 6
chosen.method, chosen.budget, chosen.refine, chosen.size, chosen.samples = "lift", "ALL", 0, 32, 2
runs = Path(bpy.utils.extension_path_user(name, path="runs", create=True))
def living():
    "{process: its parent}"
    parents = {}
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            try:
                rest = open(f"/proc/{entry}/stat").read().rsplit(")", 1)[1].split()
            except OSError:
                continue
            if rest[0] not in "ZX":
                parents[int(entry)] = int(rest[1])
    return parents
def family():
    "every process that descends from this one"
    parents = living()
    found, grown = {os.getpid()}, True
    while grown:
        more = {p for p, parent in parents.items() if parent in found} - found
        found, grown = found | more, bool(more)
    return sorted(found - {os.getpid()})
def start():
    return reconstruct.start(chosen, bpy.context)
def go(job, until=lambda job: False):
    while job.state == "running" and not until(job):
        job.advance(0.05)
def state():
    for _ in range(600):  # what was killed may take its time to die
        if not family():
            break
        time.sleep(0.1)
    return dict(processes=family(), left=os.listdir(runs), tmp=os.listdir(os.environ["TMPDIR"]), objects=names())
def names():
    return sorted(o.name for o in bpy.data.objects) + [s.name for s in bpy.data.scenes]
first = names()
session = os.listdir(os.environ["TMPDIR"])  # Blender's own folder of this session
"""


def clean(told: dict) -> None:
    state = told["state"]
    assert state["processes"] == [] and state["left"] == [], state
    assert state["tmp"] == told["session"] and state["objects"] == told["first"], state


def test_cancelled_at_ten_random_moments(installed):
    told = installed(
        HEAD
        + """
random.seed(5)
texts, ended = [], []
for i in range(10):
    job = start()
    go(job, lambda job: job.fraction >= i / 10 and (i < 9 or not job._stages))
    time.sleep(random.random() / 2)  # its processes go on meanwhile
    texts.append([len(job._stages), job.text])
    job.cancel()
    ended.append([job.state, job.message, job.advance()])
tell(texts=texts, ended=ended, kept=len(jobs.JOBS), state=state(), first=first, session=session)
"""
    )
    assert told["ended"] == [["cancelled", "Cancelled.", False]] * 10
    stages = [stage for stage, _ in told["texts"]]  # the first is cancelled at once, the last in its last
    assert stages[0] == 1 and stages[-1] == 0 and told["kept"] <= 8, told["texts"]  # rendering, reconstructing
    clean(told)


@pytest.mark.parametrize("stage", ["rendering", "reconstructing"])
def test_killed_from_outside(installed, stage):
    left = 1 if stage == "rendering" else 0
    told = installed(
        HEAD
        + f"""
job = start()
go(job, lambda job: len(job._stages) == {left} and job.child.process.poll() is None and job.text != "starting")
os.kill(job.child.process.pid, signal.SIGKILL)
go(job)
tell(ended=[job.state, job.message], log=job.log_text()[-300:], state=state(), first=first, session=session)
"""
    )
    assert told["ended"][0] == "failed" and "ended by signal 9" in told["ended"][1], told
    clean(told)


def test_a_checkpoint_cut_short_and_one_that_is_none(installed, tmp_path):
    from timesplat.model.checkpoints_io import CHECKPOINTS

    cut = tmp_path / "cut.safetensors"
    cut.write_bytes((CHECKPOINTS / "guided.safetensors").read_bytes()[:10_000])
    (tmp_path / "text.safetensors").write_text("hello")
    told = installed(
        HEAD
        + """
messages = []
chosen.method = "guided"
for path in sys.argv[1:]:
    bpy.context.preferences.addons[name].preferences.checkpoint = path
    job = start()
    go(job)
    messages.append([job.state, job.message])
tell(messages=messages, state=state(), first=first, session=session)
""",
        cut,
        tmp_path / "text.safetensors",
    )
    for (state, message), name in zip(told["messages"], ("cut", "text"), strict=True):
        assert state == "failed" and f"{name}.safetensors: not a whole Timesplat checkpoint" in message, message
    clean(told)


FLOODS = """
import sys
sys.stdin.readline()
for i in range(20):
    sys.stderr.write("x" * 1_000_000 + chr(10))
    print("y" * 1_000_000)
    print('{"event": "progress", "fraction": ' + str(i / 20) + ', "text": "flood"}', flush=True)
sys.exit("enough")
"""


def test_a_worker_that_floods(installed):
    told = installed(
        HEAD
        + f"""
process.start_worker = lambda python, request, folder: process.Child([python, "-c", {FLOODS!r}], request, folder)
job = start()
go(job)
tell(ended=[job.state, job.message], log=len(job.log_text()), state=state(), first=first, session=session)
"""
    )
    assert told["ended"] == ["failed", "The process ended with code 1: enough"] and told["log"] < 1.3e6
    clean(told)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="mounts a small file system: needs root")
@pytest.mark.parametrize("room", [100, 4000])  # kB: not enough for the copy of the scene, for what is rendered
def test_a_full_disk(installed, tmp_path, room):
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={room}k", "tmpfs", disk], capture_output=True).returncode:
        pytest.skip("a small file system cannot be mounted here")
    try:
        told = installed(
            HEAD
            + """
part("addon.runtime.run_folders").user_folder = jobs.user_folder = lambda kind: runs
runs = Path(sys.argv[1])
chosen.size = 512
try:
    job = start()
    go(job)
    ended = [job.state, job.message]
except Exception as e:
    ended = [type(e).__name__, str(e)]
tell(ended=ended, state=state(), first=first, session=session)
""",
            disk,
        )
    finally:
        subprocess.run(["umount", "-l", disk], check=True)
    assert told["ended"][0] in ("failed", "InputError") and "space" in told["ended"][1].lower(), told["ended"]
    assert "\n" not in told["ended"][1]
    clean(told)


def test_what_a_dead_blender_left_is_swept(installed):
    """A Blender is killed with a Job under way: its processes leave, and the next Job removes its folder."""
    runner = installed
    code = HEAD + "job = start()\ngo(job, lambda job: job.fraction > 0.3)\n"
    running = runner.start(code + "print('READY', *family(), flush=True)\ntime.sleep(999)", env=runner.env)
    pids = next(line.split()[1:] for line in running.stdout if line.startswith("READY"))
    assert pids
    os.kill(running.pid, signal.SIGKILL)
    running.communicate(timeout=240)
    told = runner(
        HEAD
        + """
old = len(os.listdir(runs))
def alive():
    return [p for p in sys.argv[1:] if int(p) in living()]
for _ in range(600):
    if not alive():
        break
    time.sleep(0.1)
jobs.sweep()
tell(old=old, left=os.listdir(runs), alive=alive())
""",
        *pids,
    )
    assert told == {"old": 1, "left": [], "alive": []}


WAITS = """
job = start()
go(job)
before = job.state, len(names())
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1], copy=True)
bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
kept = job in jobs.JOBS and job.state
quiet = jobs._may_come_in(job)
done = bpy.ops.timesplat.bring(number=job.number) if kept == "waiting" else []
tell(before=before, kept=kept, quiet=quiet, done=list(done), message=job.message,
     clouds=sum("timesplat" in o for o in bpy.context.scene.objects), left=os.listdir(runs), processes=family())
"""


def test_another_file_is_opened_while_the_result_waits(installed, tmp_path):
    """It is not brought into a file that it does not come from, but by a click."""
    told = installed(HEAD + WAITS, tmp_path / "other.blend")
    assert told["before"][0] == "waiting" and told["left"] == [] and told["processes"] == [], told
    assert told["kept"] == "waiting" and told["quiet"] is False, told
    assert told["done"] == ["FINISHED"] and told["clouds"] == 1 and "Gaussians" in told["message"]


def test_old_jobs_are_forgotten_running_ones_are_not(installed):
    told = installed(
        HEAD
        + f"""
sleeper = [{sys.executable!r}, "-c", "import time; time.sleep(999)"]
stage = lambda folder: process.Child(sleeper, {{}}, folder)
first_job = jobs.start("first", [stage])
for i in range(20):
    jobs.start(str(i), [stage]).cancel()
labels = [j.label for j in jobs.JOBS]
jobs.cancel_all()
tell(labels=labels, state=state(), first=first, session=session)
"""
    )
    assert told["labels"][0] == "first" and told["labels"][-1] == "19" and len(told["labels"]) == 8
    clean(told)


def test_what_is_written_while_the_folder_goes_is_removed_too(installed):
    """A killed process that waits for the disk may end a moment later than those that waited for it."""
    told = installed(
        HEAD
        + f"""
sleeper = [{sys.executable!r}, "-c", "import time; time.sleep(999)"]
job = jobs.start("x", [lambda folder: process.Child(sleeper, {{}}, folder)])
remove, late = os.rmdir, []
def rmdir(path, **options):
    if os.path.basename(path) == job.folder.name and not late:
        late.append(path)
        (job.folder / "late").touch()
    remove(path, **options)
os.rmdir = rmdir
job.cancel()
tell(late=len(late), state=state(), first=first, session=session)
"""
    )
    assert told["late"] == 1
    clean(told)


def test_what_goes_wrong_on_our_side_ends_the_job_and_not_the_timer(installed):
    told = installed(
        HEAD
        + f"""
quick = [{sys.executable!r}, "-c", "print('{{\\"event\\": \\"done\\"}}')"]
stage = lambda folder: process.Child(quick, {{}}, folder)
def broken(*_):
    raise RuntimeError("a lamp fell")
said = []
for stages, finish in (([stage, broken], None), ([stage], broken)):
    job = jobs.start("x", stages, finish)
    while job.state == "running":
        jobs._poll_jobs()
        time.sleep(0.05)
    jobs._poll_jobs()
    said.append([job.state, job.message, "lamp" in job.log_text()])
tell(said=said, state=state(), first=first, session=session)
"""
    )
    assert told["said"] == [
        ["failed", "The next step cannot be started: RuntimeError: a lamp fell", True],
        ["failed", "The result cannot be brought in: RuntimeError: a lamp fell", True],
    ]
    clean(told)
