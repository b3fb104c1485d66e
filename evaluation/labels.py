# SPDX-License-Identifier: GPL-3.0-or-later
"""Labels beside the points of a chart, where they cover nothing; plain numbers on its logarithmic axes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np


def plain(ax, axis=None) -> None:
    """Plain numbers on a logarithmic axis (by default x): 0.3, 1, 3, 10k."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis = axis or ax.xaxis
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(10, subs=(1.0,) if high / low > 3000 else (1.0, 3.0), numticks=20))
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v / 1000:g}k" if v >= 1000 else f"{v:g}"))
    axis.set_minor_formatter(NullFormatter())


def settle(fig, work: list[tuple]) -> None:
    """Lays the figure out as `save` will, then places the labels of its panels [(ax, …) of `place`]."""
    fig.tight_layout(rect=(0, 0.05, 1, 1))
    for job in work:
        place(*job)


def place(ax, labels: list[tuple], hints: list[tuple], drawn: list[tuple], dots: list[tuple]) -> list:
    """Writes labels (x, y, text, colour) beside their points, where they cover neither each other nor, if it can be
    helped, the points `dots` [(x, y)] and the lines `drawn` [(xs, ys)]; far ones get a hair line. Hints are small
    labels that are left out where there is no room. -> the boxes of what is written, in pixels."""
    figure = ax.figure
    figure.canvas.draw()
    pen, dot = figure.canvas.get_renderer(), figure.dpi / 72
    inside, busy = ax.get_window_extent(pen), np.zeros((0, 2))
    boxes: list[tuple] = []
    for xs, ys in drawn:
        at = ax.transData.transform(np.stack([xs, ys], -1)) if len(xs) else np.zeros((0, 2))
        steps = (a + (b - a) * np.linspace(0, 1, 48)[:, None] for a, b in pairwise(at))
        busy = np.concatenate([busy, at, *steps])
    dots = ax.transData.transform(np.array(dots, float))
    look = {"textcoords": "offset points", "zorder": 6, "va": "bottom"}
    for n, (x, y, text, colour) in enumerate([*labels, *hints]):
        extra = n >= len(labels)
        words = ax.annotate(text, (x, y), (0, 0), color=colour, fontsize=5.5 if extra else 7, **look)
        words.set_in_layout(False)
        box = words.get_window_extent(pen)
        half, here = np.array([box.width, box.height]) / 2, ax.transData.transform((x, y))
        best = np.inf, here, here, here, 0
        for reach in (5, 9) if extra else (5, 9, 14, 20, 28, 38, 50, 64, 80):
            for angle in np.arange(0, 2 * np.pi, np.pi / 8):
                middle = here + np.array([np.cos(angle), np.sin(angle)]) * (reach * dot + half)
                low, high = middle - half, middle + half
                cost = reach / 40 + sum(20 for a, b in boxes if (low < b + 1).all() and (a < high + 1).all())
                cost += 4 * ((dots > low - 3 * dot) & (dots < high + 3 * dot)).all(1).sum()
                cost += 0.12 * ((busy > low) & (busy < high)).all(1).sum()
                cost += 50 * ((low < inside.p0).any() or (high > inside.p1).any())
                if cost < best[0]:
                    best = cost, middle, low, high, reach
        cost, middle, low, high, reach = best
        if extra and cost > 3:
            words.remove()
            continue
        boxes.append((low, high))
        words.set_position((middle - here - half) / dot)
        if reach > 14:
            arrow = {"arrowstyle": "-", "color": colour, "linewidth": 0.4, "shrinkB": 3}
            line = ax.annotate("", (x, y), (middle - here) / dot, textcoords="offset points", arrowprops=arrow)
            line.set_in_layout(False)
    return boxes
