# SPDX-License-Identifier: GPL-3.0-or-later
"""Child processes of the add-on: their answers, their logs, their end. The children are scripts of these tests."""

import sys
import time
from pathlib import Path

import pytest

HEAD = """
import time
from pathlib import Path
process = part("addon.runtime.child_process")
folder = Path(sys.argv[1])
def child(code, request=None):
    return process.Child([sys.argv[2], "-c", code], request or {}, folder)
def end(c):
    events, start = [], time.monotonic()
    while time.monotonic() - start < 240:
        events += c.poll(1.0)
        if events and events[-1]["event"] != "progress":
            return events
    raise SystemExit("it never ended")
"""


@pytest.fixture
def run(blender, tmp_path):
    """run(code) -> what it tells; `child(code)` starts Python on a script, `end(child)` gives all its events."""
    return lambda code: blender(HEAD + code, tmp_path, sys.executable)


def test_progress_end_and_request(run):
    told = run("""
code = '''
import json, sys
asked = json.loads(sys.stdin.readline())
print("noise"), print("{broken"), print('{"event": "strange"}'), print("[1]")
print(json.dumps({"event": "progress", "fraction": 7, "text": 5}))
print('{"event": "progress", "fraction": NaN}')
print(json.dumps({"event": "done", "asked": asked}))
print(json.dumps({"event": "error", "message": "too late"}))
'''
events = end(child(code, {"a": 1}))
tell(events=events)""")
    *progress, last = told["events"]
    assert last == {"event": "done", "asked": {"a": 1, "watch": True}}
    assert all(0 <= p["fraction"] <= 1 and isinstance(p["text"], str) for p in progress)


ENDS = {
    "import sys; sys.exit('out of memory')": "The process ended with code 1: out of memory",
    "": "The process ended with code 0: it said nothing",
    "import os, signal; os.kill(os.getpid(), signal.SIGKILL)": "The process was ended by signal 9: it said nothing",
    'print(\'{"event": "error", "message": "no light"}\')': "no light",
    'print(\'{"event": "error"}\')': "it does not say why",
}


def test_every_end_has_a_sentence(run):
    told = run(f"tell(messages=[end(child(code))[-1] for code in {list(ENDS)!r}])")
    assert told["messages"] == [{"event": "error", "message": m} for m in ENDS.values()]


def test_the_last_words_are_heard_though_the_disk_is_slow_and_a_grandchild_lives(run):
    told = run("""
import builtins
def slow(*args, **options):
    time.sleep(3)
    return builtins.open(*args, **options)
process.open = slow
code = '''
import subprocess, sys
subprocess.Popen([sys.executable, "-c", "import time; time.sleep(999)"], stdout=subprocess.DEVNULL)
sys.exit("out of memory")
'''
tell(said=end(child(code))[-1]["message"])""")
    assert told["said"] == "The process ended with code 1: out of memory"


def test_who_dies_without_listening_takes_nobody_along(run):
    """More than a pipe holds is asked, of a child that is gone. Blender 4.3 leaves SIGPIPE as the system has it."""
    told = run("""
import signal
if hasattr(signal, "SIGPIPE"):
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
tell(events=end(child("raise SystemExit(5)", {"a": "x" * 1_000_000})))""")
    assert [e["event"] for e in told["events"]] == ["error"] and "code 5" in told["events"][0]["message"]


def test_a_program_that_cannot_be_started(run):
    told = run("""
try:
    process.Child(["/nowhere/python"], {}, folder)
except Exception as e:
    tell(kind=type(e).__name__, said=str(e))""")
    assert told["kind"] == "InputError" and told["said"].startswith("/nowhere/python: it cannot be started")


def test_a_flood_is_kept_small(run):
    """60 MB on both pipes, half of it one endless line: little is kept, the end is heard, the log stays short."""
    told = run(r"""
code = r'''
import sys, threading
def flood(f, piece):
    for _ in range(300):
        f.write(piece)
    f.write("\n")
a = threading.Thread(target=flood, args=(sys.stderr, ("e" * 99 + "\n") * 1000))
b = threading.Thread(target=flood, args=(sys.stdout, "o" * 100_000))
a.start(), b.start(), a.join(), b.join()
for i in range(20_000):
    print('{"event": "progress", "fraction": %f, "text": "%s"}' % (i / 20_000, "t" * 500))
sys.stderr.write("the end\n")
print('{"event": "done"}')
'''
import resource
c = child(code)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
last = end(c)[-1]
c.process.wait()
c._logger.join(60)
log = c.log_text()
tell(last=last, grown=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before, file=c.log.stat().st_size,
     log=len(log), tail=log[-8:])""")
    assert told["last"] == {"event": "done"} and told["tail"] == "the end\n"
    assert told["grown"] < 30_000 and told["file"] < 1.2e6 and told["log"] < 1.3e6  # kB, bytes


linux = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes in /proc")


def gone(*pids: int) -> bool:
    """Whether all these processes end; they are waited for."""
    for _ in range(600):
        if not any(map(alive, pids)):
            return True
        time.sleep(0.1)
    return False


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


@linux
def test_kill_ends_the_whole_tree_and_polling_never_waits(run):
    told = run("""
code = '''
import json, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(999)"])
print(json.dumps({"event": "progress", "text": str(child.pid)}), flush=True)
time.sleep(999)
'''
c = child(code)
events = c.poll(240)
waits = []
c._news.wait_for = c._news.wait = lambda *a: waits.append(a)
nothing = c.poll()
c.kill(), c.kill()
tell(nothing=nothing, waits=waits, left=len(process._running), pids=[int(events[0]["text"]), c.process.pid])
""")
    assert told["nothing"] == told["waits"] == [] and told["left"] == 0
    assert gone(*told["pids"])


@linux
@pytest.mark.parametrize("how", ["leaves", "is killed"])
def test_nothing_outlives_blender(blender, tmp_path, how):
    """The worker leaves when its standard input closes, however Blender ends."""
    code = """
listens = "import sys\\nfor line in sys.stdin: print(chr(123) + '\\"event\\": \\"progress\\"' + chr(125), flush=True)"
c = child(listens)
c.poll(240)
print("PID", c.process.pid, flush=True)
"""
    code += "tell()" if how == "leaves" else "time.sleep(999)"
    running = blender.start(HEAD + code, tmp_path, sys.executable)
    pid = next(int(line.split()[1]) for line in running.stdout if line.startswith("PID"))
    if how == "is killed":
        running.kill()
    running.communicate(timeout=240)
    assert gone(pid)
