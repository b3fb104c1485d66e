# SPDX-License-Identifier: GPL-3.0-or-later
"""How figures and tables look and are written: SVG and PNG, Markdown and CSV, each with its command.

Files appear whole or not at all. matplotlib is imported where it is used; it is in the extra `figures`.
"""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..datagen.whole_folders import write_whole
from .provenance import Provenance

# Okabe and Ito's colours, which colour-blind people tell apart; the markers tell them apart in print.
COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C8C8C"]
MARKERS = "osD^vPX*"


def command_line(module: str, argv: Sequence[str] | None = None) -> str:
    """The command as a person would type it again."""
    import shlex

    return shlex.join(["python", "-m", module, *(sys.argv[1:] if argv is None else argv)])


# ---------------------------------------------------------------- tables


def write_table(
    stem: Path,
    title: str,
    head: Sequence[str],
    rows: Sequence[Sequence],
    made_by: Provenance,
    notes: Sequence[str] = (),
) -> str:
    """`stem`.md (title, command and code, table, notes) and `stem`.csv (command and code in # lines). Cells are strings
    as they shall appear. Returns the Markdown."""
    lines = [
        f"# {title}",
        "",
        f"`{made_by.command}`",
        "",
        str(made_by),
        "",
        "| " + " | ".join(head) + " |",
        "|---" * len(head) + "|",
    ]
    lines += ["| " + " | ".join(map(str, row)) + " |" for row in rows]
    lines += [x for note in notes for x in ("", note)]
    text = "\n".join(lines) + "\n"
    sheet = io.StringIO()
    sheet.write(f"# {made_by.command}\n# {made_by}\n")
    writer = csv.writer(sheet, lineterminator="\n")
    writer.writerow(head)
    writer.writerows([[str(c).strip("*") for c in row] for row in rows])
    write_whole(stem.with_name(stem.name + ".md"), text.encode())
    write_whole(stem.with_name(stem.name + ".csv"), sheet.getvalue().encode())
    return text


# ---------------------------------------------------------------- figures


def panels(count: int, width: float = 4.2, height: float = 3.3):
    """A figure with `count` axes side by side, in this project's looks -> figure, list of axes."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    look = {
        "font.size": 9,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "grid.color": "#E4E4E4",
        "grid.linewidth": 0.6,
        "axes.axisbelow": True,
        "legend.frameon": False,
        "svg.hashsalt": "timesplat",  # the same figure is the same file
    }
    plt.rcParams.update(look)
    fig, axes = plt.subplots(1, count, figsize=(width * count, height), squeeze=False)
    return fig, list(axes[0])


def save(fig, stem: Path, caption: str) -> None:
    """`stem`.svg and `stem`.png with the caption (the command, say) in small print below."""
    import textwrap

    import matplotlib.pyplot as plt

    width, height = fig.get_size_inches()
    lines = textwrap.wrap(caption, int(width * 19), break_long_words=True, break_on_hyphens=False)
    room = (0.14 * len(lines) + 0.06) / height
    fig.tight_layout(rect=(0, room, 1, 1))
    fig.text(0.06 / width, 0.04 / height, "\n".join(lines), fontsize=5.5, color="#707070", family="monospace")
    for kind in ("svg", "png"):
        data = io.BytesIO()
        meta = {"Date": None, "Description": caption} if kind == "svg" else {"Description": caption}
        fig.savefig(data, format=kind, dpi=160, metadata=meta)
        write_whole(stem.with_name(f"{stem.name}.{kind}"), data.getvalue())
    plt.close(fig)


def save_picture(image, stem: Path, caption: str) -> None:
    """A PIL image as PNG with the caption below it, and as SVG that holds the same picture."""
    import base64
    import html
    import textwrap

    from matplotlib import get_data_path
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSansMono.ttf", 9)
    lines = textwrap.wrap(caption, max(image.width // 6, 40), break_long_words=True, break_on_hyphens=False)
    sheet = Image.new("RGB", (image.width, image.height + 12 * len(lines) + 8), "white")
    sheet.paste(image, (0, 0))
    ImageDraw.Draw(sheet).text((4, image.height + 2), "\n".join(lines), fill="#707070", font=font)
    data = io.BytesIO()
    sheet.save(data, "PNG")
    write_whole(stem.with_name(stem.name + ".png"), data.getvalue())
    inside = base64.b64encode(data.getvalue()).decode()
    svg = f'<svg xmlns="http://www.w3.org/2000/svg" width="{sheet.width}" height="{sheet.height}">'
    svg += f"<desc>{html.escape(caption)}</desc>"
    svg += f'<image width="{sheet.width}" height="{sheet.height}" href="data:image/png;base64,{inside}"/></svg>\n'
    write_whole(stem.with_name(stem.name + ".svg"), svg.encode())


def smooth(values: Sequence[float] | np.ndarray, window: int) -> np.ndarray:
    """(n,) running mean over `window` values, centred, over what is there at the ends."""
    values = np.asarray(values, float)
    kernel = np.ones(min(window, len(values)) or 1)
    return np.convolve(values, kernel, "same") / np.convolve(np.ones_like(values), kernel, "same")


def band(ax, x, samples: np.ndarray, label: str, index: int) -> None:
    """samples (objects, x): the mean as a line with markers, its standard error over objects as a band."""
    samples = np.asarray(samples, float)
    mean = samples.mean(0)
    error = samples.std(0, ddof=1) / len(samples) ** 0.5 if len(samples) > 1 else np.zeros_like(mean)
    colour = COLOURS[index % len(COLOURS)]
    ax.fill_between(x, mean - error, mean + error, color=colour, alpha=0.18, linewidth=0)
    ax.plot(x, mean, color=colour, marker=MARKERS[index % len(MARKERS)], markersize=4, linewidth=1.4, label=label)
