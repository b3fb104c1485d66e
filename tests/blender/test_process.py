# SPDX-License-Identifier: GPL-3.0-or-later
"""Child processes of the add-on: their answers, their logs, their end. The children are scripts of these tests."""

import sys
from pathlib import Path

import pytest

HEAD = """
import time
from pathlib import Path
process = part("addon.process")
folder = Path(sys.argv[1])
def child(code, request=None):
    return process.Child([sys.argv[2], "-c", code], request or {}, folder)
def end(c, seconds=60):
    events, start = [], time.monotonic()
    while time.monotonic() - start < seconds:
        events += c.poll(1.0)
        if events and events[-1]["event"] != "progress":
            return events
    raise SystemExit("it never ended")
def alive(pid):
    try:
        return open(f"/proc/{pid}/stat").read().split(")")[-1].split()[0] not in "ZX"
    except OSError:
        return False
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
last = end(c, 240)[-1]
c.process.wait()
c._logger.join(5)
log = c.log_text()
tell(last=last, grown=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before, file=c.log.stat().st_size,
     log=len(log), tail=log[-8:])""")
    assert told["last"] == {"event": "done"} and told["tail"] == "the end\n"
    assert told["grown"] < 30_000 and told["file"] < 1.2e6 and told["log"] < 1.3e6  # kB, bytes


linux = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes in /proc")


@linux
def test_kill_ends_the_whole_tree_and_polling_never_waits(run):
    told = run("""
code = '''
import json, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(99)"])
print(json.dumps({"event": "progress", "text": str(child.pid)}), flush=True)
time.sleep(99)
'''
c = child(code)
events = c.poll(20)
start = time.monotonic()
nothing = c.poll()
waited = time.monotonic() - start
c.kill(), c.kill()
time.sleep(0.3)
tell(nothing=nothing, waited=waited, left=len(process._running),
     alive=[alive(int(events[0]["text"])), alive(c.process.pid)])
""")
    assert told["nothing"] == [] and told["waited"] < 0.05
    assert told["alive"] == [False, False] and told["left"] == 0


@linux
@pytest.mark.parametrize("how", ["leaves", "is killed"])
def test_nothing_outlives_blender(blender, tmp_path, how):
    """The worker leaves when its standard input closes, however Blender ends."""
    code = """
listens = "import sys\\nfor line in sys.stdin: print(chr(123) + '\\"event\\": \\"progress\\"' + chr(125), flush=True)"
c = child(listens)
c.poll(20)
print("PID", c.process.pid, flush=True)
"""
    code += "tell()" if how == "leaves" else "time.sleep(99)"
    running = blender.start(HEAD + code, tmp_path, sys.executable)
    pid = next(int(line.split()[1]) for line in running.stdout if line.startswith("PID"))
    if how == "is killed":
        running.kill()
    running.communicate(timeout=60)
    import time

    for _ in range(100):
        if not Path(f"/proc/{pid}").exists() or Path(f"/proc/{pid}/stat").read_text().split(")")[-1].split()[0] in "ZX":
            return
        time.sleep(0.1)
    raise AssertionError("it is still there")
