# SPDX-License-Identifier: GPL-3.0-or-later
"""The list of Jobs: a row each, with its progress or its end and its buttons."""

from __future__ import annotations

import textwrap

from ..runtime import jobs

LONGEST = 40  # characters of a line
STATE_ICONS = {"waiting": "IMPORT", "done": "CHECKMARK", "failed": "ERROR", "cancelled": "CANCEL"}


def in_words(seconds: float) -> str:
    """Roughly how long, as people say it."""
    return f"about {max(round(seconds, -1), 10):.0f} s" if seconds < 90 else f"about {seconds / 60:.0f} min"


def draw_jobs(layout) -> None:
    """One row a Job, the newest first."""
    for job in reversed(jobs.JOBS):
        box = layout.column(align=True)
        row = box.row(align=True)
        if job.state == "running":
            left = job.seconds_left  # before the text, whose end a narrow sidebar cuts off
            row.progress(factor=job.fraction, text=job.text if left is None else f"{in_words(left)} left, {job.text}")
        else:
            long = len(job.message) > LONGEST
            text = job.message if job.state == "done" and not long else f"{job.label}: {job.message or job.text}"
            row.label(text=text, icon=STATE_ICONS[job.state])
        if job.state == "waiting":
            row.operator("timesplat.bring", text="", icon="IMPORT").number = job.number
        row.operator("timesplat.log", text="", icon="TEXT").number = job.number
        if job.active:
            row.operator("timesplat.cancel", text="", icon="X").number = job.number
        elif len(job.message) > LONGEST:
            for line in textwrap.wrap(job.message, LONGEST):
                box.label(text=line)
