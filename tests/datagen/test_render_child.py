# SPDX-License-Identifier: GPL-3.0-or-later
"""The child is a script in place of Blender: what it does to time, memory and its messages is known."""

import os
import sys
import time

import pytest

from timesplat.datagen.render_child import Limits, held, render_job, run_child
from timesplat.datagen.sequence import InputError

pytestmark = pytest.mark.skipif(os.name != "posix", reason="scripts in place of the interpreter, and signals")


@pytest.fixture
def child(tmp_path, monkeypatch):
    """child(text of a Python program, limits) -> its messages; what it finds at argv 4 is the log."""

    def run(program, limits=None):
        script = tmp_path / "python"
        script.write_text(f"#!{sys.executable}\n{program}")
        script.chmod(0o755)
        messages = []
        job = {"asset": {"path": "a.glb", "name": "a"}, "out": str(tmp_path / "out")}
        with monkeypatch.context() as m:
            m.setattr(sys, "executable", str(script))
            run.spent = run_child(job, messages.append, set(), limits)
        return messages

    return run


def test_messages_come_through_and_a_good_end_says_nothing(child):
    assert child('print(\'{"image": 1}\')\nprint(\'{"written": "x"}\')') == [{"image": 1}, {"written": "x"}]


def test_a_death_is_a_sentence_with_the_last_words(child):
    (message,) = child("import sys, os\nopen(sys.argv[4], 'w').write('last words')\nos.abort()")
    assert message["status"] == "crashed" and "signal 6" in message["error"] and "last words" in message["error"]
    assert child('print(\'{"error": "told"}\')\nraise SystemExit(2)') == [{"error": "told"}]
    (message,) = child("print('{\"error\": \"to', end='', flush=True)\nimport os\nos.abort()")  # cut in the middle
    assert message["status"] == "crashed" and "signal 6" in message["error"]


def test_one_that_hangs_is_ended_in_time(child):
    start = time.monotonic()
    messages = child("print('{\"image\": 1}', flush=True)\nimport time\ntime.sleep(60)", Limits(seconds=0.5))
    assert 0.4 < time.monotonic() - start < 20
    assert messages[0] == {"image": 1} and messages[1]["status"] == "time"
    assert messages[1]["error"] == "a.glb: it takes longer than --limit-seconds 0.5; allow more, or leave it out."


@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
def test_one_that_eats_memory_is_ended_before_it_has_much_more(child):
    program = "import time\nx = []\nfor _ in range(400):\n    x.append(bytearray(2**24))\n    time.sleep(0.01)"
    (message,) = child(program, Limits(seconds=120, memory=0.5))
    assert message["status"] == "memory" and "--limit-memory 0.5 (GB); allow more" in message["error"]
    assert child("x = bytearray(2**26)", Limits(memory=0.5)) == []
    assert 2**22 < held(os.getpid()) < 2**35 and held(2**30) == 0


@pytest.mark.skipif(not hasattr(os, "wait4"), reason="this system does not tell what a child took")
def test_processor_seconds_are_those_of_the_child_and_of_its_own(child):
    burn = "import time\nwhile time.process_time() < 0.4: pass\n"
    child(burn)
    assert 0.4 <= child.spent < 3
    child(f"import subprocess, sys\nsubprocess.run([sys.executable, '-c', {burn!r}])\n{burn}")
    assert 0.8 <= child.spent < 5
    child("import time\ntime.sleep(1)")
    assert child.spent < 0.9


def test_what_became_of_a_job(tmp_path, monkeypatch):
    job, told = {"asset": {"path": "a.glb", "name": "a"}, "out": str(tmp_path)}, []
    monkeypatch.setattr(sys, "executable", str(tmp_path / "no such program"))
    became = render_job(job, told.append, set())
    assert became["error"]["status"] == "crashed" and "a.glb: it could not be started" in became["error"]["error"]
    script = tmp_path / "python"
    lines = ('{"warning": "w"}', '{"written": "x"}', '{"error": "first", "status": "refused"}', '{"error": "second"}')
    script.write_text("#!/bin/sh\n" + "".join(f"echo '{line}'\n" for line in lines))
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    became = render_job(job, told.append, set())
    assert told == [{"warning": "w"}] and became["written"] == ["x"] and became["error"]["error"] == "first"
    assert 0 < became["seconds"] < 20


def test_what_it_left_half_written_goes(child, tmp_path):
    (tmp_path / "out" / ".Run.1" / "images").mkdir(parents=True)
    (tmp_path / "out" / "Walk").mkdir()
    child("")
    assert [f.name for f in (tmp_path / "out").iterdir()] == ["Walk"]


@pytest.mark.parametrize("wrong", [{"seconds": 0}, {"memory": -1}, {"seconds": float("nan")}])
def test_limits_that_nothing_could_keep_to(wrong):
    with pytest.raises(InputError, match=r"^--limit-\w+ .*; give a number above 0\.$"):
        Limits(**wrong)
