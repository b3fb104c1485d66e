# SPDX-License-Identifier: GPL-3.0-or-later
"""How long a Job says that it will take: at first as was expected, from its first picture on as it goes."""

import pytest

JOB = """
job_room, rows = part("addon.runtime.job"), part("addon.ui.job_rows")
now = [100.0]
job_room.time = type("Clock", (), {"monotonic": staticmethod(lambda: now[0])})
class Child:
    def __init__(self, folder): self.events = []
    def poll(self, timeout=None):
        found, self.events = self.events, []
        return found
    def kill(self): pass
    def log_text(self): return ""
job = job_room.Job("Test", [Child, Child], lambda event, folder: "done", [40.0, 60.0], None)
def after(seconds, **event):
    now[0] += seconds
    job.child.events.append({"event": "progress", "text": "at work"} | event)
    job.advance()
    return [job.seconds_left, job.fraction]
class Row:
    def progress(self, factor, text): shown.append(text)
    def __getattr__(self, name): return lambda *a, **k: self if name in ("row", "column") else type("O", (), {})()
    def operator(self, *a, **k): return type("O", (), {})()
shown = []
jobs = part("addon.runtime.jobs")
jobs.JOBS.append(job)
told = [[job.seconds_left, job.fraction], after(10, fraction=0.05)]
rows.draw_jobs(Row())
told.append(after(10, fraction=0.1))  # 20 s for a tenth of the first stage, which was to take 40
rows.draw_jobs(Row())
told += [after(160, fraction=0.9), after(20, event="done"), after(6, fraction=0.02), after(54, fraction=0.5)]
job.child.events.append({"event": "done"})
job.advance()
plain = job_room.Job("Plain", [Child, Child], None, None, None)
plain.child.events.append({"event": "progress", "text": "", "fraction": 0.5})
plain.advance()
tell(told=told, end=job.seconds_left, plain=[plain.seconds_left, plain.fraction], shown=shown,
     words=[rows.in_words(x) for x in (1, 14, 87, 100, 400)])
"""


def test_time_left_is_told_anew_when_the_first_picture_was_rendered(blender):
    told = blender(JOB)
    for (left, fraction), (seconds, part) in zip(
        told["told"],
        [(100, 0), (90, 0.02), (240, 0.04), (80, 0.36), (60, 0.4), (54, 0.412), (60, 0.7)],
        strict=True,
    ):
        assert left == pytest.approx(seconds) and fraction == pytest.approx(part)
    assert told["shown"] == ["about 2 min left, at work", "about 4 min left, at work"]
    assert told["end"] is None and told["plain"] == [None, 0.25]
    assert told["words"] == ["about 10 s", "about 10 s", "about 90 s", "about 2 min", "about 7 min"]
