# SPDX-License-Identifier: GPL-3.0-or-later
"""One picture of a folder of pictures and cameras: cameras from above and from the side with the volume, and a contact
sheet over time. What is wrong with cameras is seen at a glance there. matplotlib is in the extra `figures`."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from ..datagen.inspection import up_axis
from ..datagen.sequence import Sequence
from ..datagen.whole_folders import write_whole
from .figures import COLOURS

SHOWN = 24  # pictures of the contact sheet
COLUMNS = 8
SIDE = 160  # pixels of each


def write_picture(path: Path, seq: Sequence, lines: list[str]) -> None:
    """A .png, whole or not at all. lines: what is said above it. Raises InputError for a picture that cannot be read,
    and ModuleNotFoundError without matplotlib."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    chosen = shown(seq)
    rows = -(-len(chosen) // COLUMNS)
    figure = plt.figure(figsize=(12, 5.6 + 1.6 * rows), layout="constrained")
    top, bottom = figure.subfigures(2, 1, height_ratios=(5.2, max(1.6 * rows, 0.1)))
    top.suptitle("\n".join(lines), fontsize=8, ha="left", x=0.01, wrap=True)
    up = up_axis(seq)
    others = [k for k in range(3) if k != up % 3]
    for axes, title, pair in zip(top.subplots(1, 2), ("above", "the side"), (others, [others[0], up % 3]), strict=True):
        draw_cameras(axes, seq, *pair)
        axes.set(title=f"from {title}", xlabel="xyz"[pair[0]], ylabel="xyz"[pair[1]], aspect="equal")
        if up < 0 and title == "the side":
            axes.invert_yaxis()
    cells = np.atleast_1d(bottom.subplots(rows, COLUMNS)).ravel()
    for cell in cells:
        cell.axis("off")
    for cell, i in zip(cells, chosen, strict=False):
        v = seq.views[i]
        cell.imshow(thumbnail(seq, i))
        cell.set_title(f"{v.camera}, frame {v.frame:g}", fontsize=6)
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    plt.close(figure)
    write_whole(path, data.getvalue())


def shown(seq: Sequence) -> list[int]:
    """Views spread over the clip, and over the cameras of each moment."""
    order = sorted(range(len(seq.views)), key=lambda i: seq.views[i].frame)
    if len({seq.views[i].frame for i in order}) == 1:
        return [order[k] for k in np.unique(np.linspace(0, len(order) - 1, SHOWN).round().astype(int))]
    moments = sorted({seq.views[i].frame for i in order})
    picked = [moments[k] for k in np.unique(np.linspace(0, len(moments) - 1, SHOWN).round().astype(int))]
    groups = [[i for i in order if seq.views[i].frame == m] for m in picked]
    return [g[n % len(g)] for n, g in enumerate(groups)]


def thumbnail(seq: Sequence, index: int) -> np.ndarray:
    """(h,w,3) 0..1 of a view over grey, so that white objects are seen, too."""
    from PIL import Image

    rgba = Image.fromarray(seq.load_image(index))
    rgba.thumbnail((SIDE, SIDE))
    picture = np.asarray(rgba, np.float32) / 255
    a = picture[..., 3:]
    return picture[..., :3] * a + 0.85 * (1 - a)


def draw_cameras(axes, seq: Sequence, across: int, up: int) -> None:
    """Where cameras stand and look, in two of three dimensions, with the unit box and the object's."""
    place = np.array([v.c2w[:3, 3] for v in seq.views])
    look = np.array([-v.c2w[:3, 2] for v in seq.views])
    length = 0.25 * float(np.median(np.linalg.norm(place - place.mean(0), axis=1))) or 1.0
    held = np.array([v.held_out for v in seq.views])
    for mask, colour, label in ((~held, COLOURS[0], "cameras"), (held, COLOURS[1], "held out")):
        if mask.any():
            p, d = place[mask][:, [across, up]], length * look[mask][:, [across, up]]
            axes.quiver(*p.T, *d.T, angles="xy", scale_units="xy", scale=1, width=0.003, color=colour, alpha=0.6)
            axes.plot(*p.T, "o", markersize=3, color=colour, label=label)
    for box, style, label in (
        (np.array([[-1.0] * 3, [1.0] * 3]), ":", "unit box"),
        (np.array(seq.aabb), "-", "object"),
    ):
        (x0, x1), (y0, y1) = box[:, across], box[:, up]
        axes.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], style, color="black", linewidth=1, label=label)
    axes.legend(fontsize=7, loc="upper right")
    axes.margins(0.1)
