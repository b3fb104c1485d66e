# SPDX-License-Identifier: GPL-3.0-or-later
"""`curation.html`: what a person looks at before hours of training are spent. One file with its pictures inside."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Sequence as List
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..rigs import CANONICAL
from ..sequence import read_sequence
from ..whole_folders import write_whole
from .decisions import OUT, SETS, Bounds, Decision
from .measures import over_white

PAPER_SHARE = 3000 / 32000  # of the animated objects that the paper keeps as HQ4D
SHOWN = 90  # Sequences of a set, or of a fault, that are shown
_MOMENTS = 4
_SIDE = 72  # pixels of a thumbnail's pictures
_BINS = 48
_TITLES = {
    "hq4d": "HQ4D: moves enough, and not too much",
    "4d": "4D: all else that moves",
    "3d": "3D: still",
    OUT: "Thrown out",
}
_STYLE = """
body{font:14px/1.45 system-ui,sans-serif;margin:2em auto;max-width:1240px;padding:0 1em;color:#222;background:#fff}
h1{font-size:1.5em}h2{margin-top:2em;border-top:1px solid #ddd;padding-top:.8em;font-size:1.2em}
h3{font-size:1em;margin:1.4em 0 .4em}table{border-collapse:collapse}td,th{padding:.15em .9em .15em 0;text-align:left}
td.n{text-align:right}.grid{display:flex;flex-wrap:wrap;gap:10px}figure{margin:0;width:292px;border:1px solid #ddd;
border-radius:4px;padding:4px;overflow:hidden}figure img{display:block;width:288px;height:72px;background:#eee}
figcaption{font-size:12px;overflow-wrap:anywhere}.why{color:#a30}.by{color:#777}.hand{color:#06c}
"""


def write_report(path: Path, folder: Path, decisions: List[Decision], bounds: Bounds) -> None:
    """The page of what was decided on the Sequences below `folder`, whole or as it was."""
    groups = {name: [d for d in decisions if d.final == name] for name in (*SETS, OUT)}
    parts = [_summary(folder, groups), _histogram(decisions, bounds), _thrown_out(folder, groups[OUT])]
    for name in SETS:
        parts.append(f"<h2>{_TITLES[name]} ({len(groups[name])})</h2>")
        parts.append(_grid(folder, sorted(groups[name], key=lambda d: (_known(d.motion), d.sequence))))
    text = f"<!doctype html><meta charset=utf-8><title>Curation of {_text(folder.name)}</title><style>{_STYLE}</style>"
    write_whole(path, (text + "\n".join(parts)).encode("utf-8", "backslashreplace"))


def advice(decisions: List[Decision], bounds: Bounds) -> str:
    """How the share of HQ4D compares with the paper's, and which bound would give that."""
    moving = sorted(d.motion for d in decisions if d.final in ("hq4d", "4d") and not math.isnan(d.motion))
    if not moving:
        return "Nothing that moves was kept."
    share = sum(d.final == "hq4d" for d in decisions) / len(moving)
    told = f"HQ4D is {share:.1%} of what moves; the paper's is {PAPER_SHARE:.1%}."
    calm = [m for m in moving if m < bounds.aggressive]
    wanted = round(PAPER_SHARE * len(moving))
    if 0 < wanted < len(calm):
        told += f" --sufficient {calm[-wanted]:.3g} would keep as large a share."
    return told


def _summary(folder: Path, groups: dict[str, list[Decision]]) -> str:
    rows = "".join(
        f"<tr><th>{_TITLES[name]}<td class=n>{len(found)}<td class=n>{sum(bool(d.override) for d in found) or ''}"
        for name, found in groups.items()
    )
    everything = [d for found in groups.values() for d in found]
    licences: dict[str, int] = {}
    for d in everything:
        licences[d.licence or "not stated"] = licences.get(d.licence or "not stated", 0) + 1
    listed = ", ".join(f"{_text(name)} {n}" for name, n in sorted(licences.items(), key=lambda x: -x[1]))
    return (
        f"<h1>Curation of {_text(folder.name)}: {len(everything)} Sequences</h1>"
        f"<table><tr><th><th>Sequences<th>by hand{rows}</table><p>Licences: {listed}.</p>"
        "<p>Each decision can be reversed: write hq4d, 4d, 3d or out into the column <code>override</code> of "
        "<code>curation.csv</code>, and it counts from then on, here and in training.</p>"
    )


def _histogram(decisions: List[Decision], bounds: Bounds) -> str:
    """An SVG of the measure of all that have one and are not thrown out, with the bounds."""
    values = [d.motion for d in decisions if d.final != OUT and not d.still and not math.isnan(d.motion)]
    if not values:
        return ""
    most = max(max(values), bounds.aggressive * 1.1)
    counts, _ = np.histogram(values, _BINS, (0, most))
    wide, tall, step = 960, 200, 960 / _BINS
    bars = "".join(
        f'<rect x="{i * step:.1f}" y="{tall - tall * n / counts.max():.1f}" width="{step - 1:.1f}" '
        f'height="{tall * n / counts.max():.1f}" fill="#7aa6d8"><title>{n}</title></rect>'
        for i, n in enumerate(counts)
    )
    lines = ""
    for name in ("still", "sufficient", "aggressive"):
        x, value = getattr(bounds, name) / most * wide, getattr(bounds, name)
        lines += f'<line x1="{x:.1f}" x2="{x:.1f}" y1="-6" y2="{tall}" stroke="#a30" stroke-dasharray="4 3"/>'
        lines += f'<text x="{x + 3:.1f}" y="6" font-size="12" fill="#a30">--{name} {value:g}</text>'
    ticks = "".join(
        f'<text x="{wide * i / 8:.0f}" y="{tall + 16}" font-size="12" fill="#555">{most * i / 8:.2f}</text>'
        for i in range(9)
    )
    return (
        "<h2>How much they move</h2><p>The greatest L1 distance between two frames of a camera that stands still, per "
        f"channel and per pixel that the object covers. {_text(advice(decisions, bounds))}</p>"
        f'<svg viewBox="0 -12 {wide + 40} {tall + 34}" width="100%" role="img">{bars}{lines}{ticks}</svg>'
    )


def _thrown_out(folder: Path, out: list[Decision]) -> str:
    """By the first fault of each."""
    faults: dict[str, list[Decision]] = {}
    for d in out:
        faults.setdefault(
            "by hand" if d.override else d.reason.split(":")[0].split(" of ")[0].split(" at ")[0], []
        ).append(d)
    parts = [f"<h2>{_TITLES[OUT]} ({len(out)})</h2>"]
    for name, found in sorted(faults.items()):
        parts += [f"<h3>{_text(name)} ({len(found)})</h3>", _grid(folder, sorted(found, key=lambda d: d.sequence))]
    return "".join(parts)


def _grid(folder: Path, decisions: list[Decision]) -> str:
    if len(decisions) > SHOWN:
        chosen = [decisions[i] for i in np.linspace(0, len(decisions) - 1, SHOWN).astype(int)]
        return f"<p>{SHOWN} of {len(decisions)}, evenly.</p>" + _grid(folder, chosen)
    return f"<div class=grid>{''.join(_figure(folder, d) for d in decisions)}</div>"


def _figure(folder: Path, d: Decision) -> str:
    moved = "" if math.isnan(d.motion) else f"moves {d.motion:.3f}"
    why = f"<div class=why>{_text(d.reason)}</div>" if d.reason else ""
    hand = f"<div class=hand>by hand: {d.override} in place of {d.set}</div>" if d.override else ""
    owner = ", ".join(filter(None, (d.licence, d.author)))
    return (
        f'<figure><img loading=lazy alt="" src="{_thumbnail(folder / d.sequence)}"><figcaption>{_text(d.sequence)} '
        f"<b>{moved}</b>{why}{hand}<div class=by>{_text(owner)}</div></figcaption></figure>"
    )


def _thumbnail(folder: Path) -> str:
    """A data URL of four moments of a clip, from the canonical camera that sees most of it at first, or of the four
    sides of what is still; "" where it cannot be read."""
    from PIL import Image

    try:
        seq = read_sequence(folder)
        names = [name for name in CANONICAL if seq.select(camera=name)] or [seq.views[0].camera]
        by_time = [sorted(seq.select(camera=name), key=lambda i: seq.views[i].frame) for name in names]
        indices = max(by_time, key=lambda found: int((seq.load_image(found[0])[..., 3] > 0).sum()))
        shown = [indices[at] for at in np.linspace(0, len(indices) - 1, _MOMENTS).round().astype(int)]
        if len(indices) == 1:
            shown = [found[0] for found in by_time]
        strip = Image.new("RGB", (_MOMENTS * _SIDE, _SIDE), "white")
        for k, index in enumerate(shown):
            rgb = (over_white(seq.load_image(index)) * 255).round().astype(np.uint8)
            strip.paste(Image.fromarray(rgb).resize((_SIDE, _SIDE), Image.Resampling.BOX), (k * _SIDE, 0))
    except InputError:
        return ""
    data = io.BytesIO()
    strip.save(data, "JPEG", quality=82)
    return "data:image/jpeg;base64," + base64.b64encode(data.getvalue()).decode()


def _known(motion: float) -> float:
    return -1.0 if math.isnan(motion) else motion


def _text(text: str) -> str:
    return html.escape(text)
