# SPDX-License-Identifier: GPL-3.0-or-later
"""What the stress suite found, from its figures alone: stress.md, stress.png and .svg (a chart for each sweep), and
stress.html, one file with charts, tables and pictures."""

from __future__ import annotations

import base64
import html
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...datagen.whole_folders import write_whole
from ..figures import COLOURS, MARKERS, panels, save
from ..provenance import Provenance
from .cells import Figures, number
from .measures import MEASURES, lost
from .sweeps import Sweep

LOSS = 3.0  # dB
# Of a sweep's chart: what is shown of it, solid.
PANELS = {
    "psnr": "PSNR, mean (dB)",
    "psnr_worst": "PSNR, worst frame (dB)",
    "between": "PSNR between inputs' times (dB)",
    "ghost": "ghosts (% of the object)",
    "flicker": "flicker (255ths)",
}
STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:1180px;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;font-size:13px;margin:.6em 0}td,th{padding:.15em .7em;border-bottom:1px solid #ddd}
td{text-align:right}td:first-child,th:first-child{text-align:left}img{max-width:100%;image-rendering:auto}
.worst td{text-align:center;font-size:11px;color:#666}.worst img{width:192px;image-rendering:pixelated}
h2{margin-top:2em}.note{color:#666;font-size:13px}"""


@dataclass(frozen=True)
class Result:
    """A sweep with the rows of each method, {label: {level: row}}, failures among them."""

    sweep: Sweep
    rows: dict[str, dict[float, dict]]

    @property
    def levels(self) -> list[float]:
        return list(next(iter(self.rows.values())))

    def values(self, method: str, key: str) -> list[float]:
        """A figure at each level; NaN where the method failed."""
        return [number(row, key) for row in self.rows[method].values()]

    def lost_at(self, method: str, key: str = "psnr") -> float | None:
        """The place on the axis (0: the first level) at which LOSS dB are lost; None where they never are. Where a
        method fails all is lost."""
        values = [v if math.isfinite(v) else 0.0 for v in self.values(method, key)]
        return lost(list(range(len(values))), values, LOSS)

    def level_at(self, place: float) -> float:
        return float(np.interp(place, range(len(self.levels)), self.levels))


def write(out: Path, results: list[Result], made_by: Provenance, about: str) -> str:
    """Writes the report; -> the Markdown's tables."""
    text = markdown(results)
    charted = [r for r in results if not r.sweep.repeats]
    if charted:
        save(overview(charted), out / "stress", made_by.caption)
    head = f"# Stability\n\n`{made_by.command}`\n\n{made_by}\n\n{about}\n\n"
    write_whole(out / "stress.md", (head + text).encode())
    write_whole(out / "stress.html", page(out, results, made_by, about).encode())
    return text


# ---------------------------------------------------------------- tables


def cell(value: float | None, digits: int) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


TABLE = ("PSNR", "lost 3 dB at", "PSNR", "5 %", "worst", "FLIP", "ghost %", "flicker", "between", "note")


def table(result: Result) -> list[list[str]]:
    """A row for each method: at the easiest level, where it lost 3 dB, and at the hardest."""
    found = []
    for method, rows in result.rows.items():
        hardest = list(rows.values())[-1]
        at = result.lost_at(method)
        hard = [cell(number(hardest, k), MEASURES[k].digits) for k in ("psnr", "psnr_p5", "psnr_worst", "flip", "ghost",
                                                                      "flicker")]  # fmt: skip
        between = number(hardest, "between") - number(hardest, "at_whole")
        failed = [f"{level:g}: {r['failed']}" for level, r in rows.items() if r.get("failed")]
        found.append([
            method, cell(result.values(method, "psnr")[0], 2),
            "never" if at is None else f"{result.level_at(at):.3g}", *hard,
            "–" if not math.isfinite(between) else f"{between:+.2f}", "; ".join(failed),
        ])  # fmt: skip
    return found


def repeat_table(result: Result) -> list[list[str]]:
    """A row for each method: mean, standard deviation and range over the repeats."""
    found = []
    for method in result.rows:
        row = [method]
        for key in ("psnr", "psnr_worst", "between"):
            v = np.array(result.values(method, key))
            spread = v.std(ddof=1) if len(v) > 1 else 0.0
            row += [cell(float(v.mean()), 2), cell(float(spread), 3), cell(float(np.ptp(v)), 3)]
        found.append(row)
    return found


REPEATED = [f"{name}{what}" for name in ("PSNR", "worst", "between") for what in ("", " σ", " range")]


def title(result: Result) -> str:
    levels = ", ".join(f"{x:g}" for x in result.levels)
    return f"{result.sweep.name}: {result.sweep.about} ({levels} {result.sweep.unit})"


def tabled(result: Result) -> tuple[list[str], list[list[str]]]:
    """Head and rows."""
    if result.sweep.repeats:
        return ["method", *REPEATED], repeat_table(result)
    easy, hard = (f"{x:g}" for x in (result.levels[0], result.levels[-1]))
    head = [f"{TABLE[0]} at {easy}", TABLE[1], f"PSNR at {hard}", *TABLE[3:]]
    return ["method", *head], table(result)


def markdown(results: list[Result]) -> str:
    parts = []
    for result in results:
        head, rows = tabled(result)
        lines = [f"## {title(result)}", "", f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
        lines += [f"| {' | '.join(row)} |" for row in rows]
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


# ---------------------------------------------------------------- charts


def draw(ax, result: Result, key: str) -> None:
    """A panel: a figure against difficulty, levels evenly apart; where 3 dB are lost a cross and the level."""
    places = range(len(result.levels))
    for n, method in enumerate(result.rows):
        colour, values = COLOURS[n % len(COLOURS)], result.values(method, key)
        ax.plot(places, values, color=colour, marker=MARKERS[n % len(MARKERS)], markersize=3.5, linewidth=1.2,
                label=method)  # fmt: skip
        at = result.lost_at(method, key) if key == "psnr" else None
        if at is not None:
            y = values[0] - LOSS
            ax.plot([at], [y], color=colour, marker="x", markersize=9, markeredgewidth=2, linestyle="none")
            ax.annotate(f"{result.level_at(at):.2g}", (at, y), (4, 5), textcoords="offset points", fontsize=6.5,
                        color=colour)  # fmt: skip
    ax.set_xticks(list(places), [f"{x:g}" for x in result.levels])
    ax.set_xlabel(result.sweep.unit, fontsize=7.5)
    ax.tick_params(labelsize=7.5)
    ax.margins(0.06, 0.1)


def overview(results: list[Result]):
    """One figure: PSNR against difficulty, a panel for each sweep."""
    columns = min(4, len(results))
    lines = -(-len(results) // columns)
    fig, axes = panels(columns, 3.1, 2.7 * lines)
    grid = [fig.add_subplot(lines, columns, i + 1) for i in range(len(results))]
    for ax in axes:
        ax.remove()
    for ax, result in zip(grid, results, strict=True):
        draw(ax, result, "psnr")
        ax.set_title(result.sweep.about, fontsize=8.5, loc="left")
        ax.set_ylabel("PSNR (dB)", fontsize=7.5)
    grid[0].legend(fontsize=6.5, loc="lower left")
    return fig


def chart(result: Result) -> bytes:
    """A sweep's row of panels as PNG."""
    import matplotlib.pyplot as plt

    fig, axes = panels(len(PANELS), 2.9, 2.7)
    for ax, (key, name) in zip(axes, PANELS.items(), strict=True):
        draw(ax, result, key)
        ax.set_title(name, fontsize=8, loc="left")
    axes[0].legend(fontsize=6.5, loc="lower left")
    fig.tight_layout()
    data = io.BytesIO()
    fig.savefig(data, format="png", dpi=110)
    plt.close(fig)
    return data.getvalue()


# ---------------------------------------------------------------- the page


def _image(data: bytes) -> str:
    return f'<img src="data:image/png;base64,{base64.b64encode(data).decode()}">'


def _html_table(head: list[str], rows: list[list[str]], kind: str = "", raw: bool = False) -> str:
    def line(cells: list[str], tag: str) -> str:
        said = cells if raw and tag == "td" else [html.escape(c) for c in cells]
        return "<tr>" + "".join(f"<{tag}>{c}</{tag}>" for c in said) + "</tr>"

    body = "".join(line(r, "td") for r in rows)
    return f'<table class="{kind}">{line(head, "th")}{body}</table>'


def worst_pictures(out: Path, result: Result) -> str:
    """Truth beside what was made of it, of the worst view of each method at each level."""
    rows = []
    for method, by_level in result.rows.items():
        cells = [html.escape(method)]
        for row in by_level.values():
            file = Figures(out).picture(row["key"])
            said = html.escape(row.get("failed") or f"{cell(number(row, 'psnr_worst'), 1)} dB")
            cells.append((_image(file.read_bytes()) + "<br>" if file.exists() else "") + said)
        rows.append(cells)
    return _html_table(["worst view", *(f"{x:g}" for x in result.levels)], rows, "worst", raw=True)


def page(out: Path, results: list[Result], made_by: Provenance, about: str) -> str:
    """The report as one file of HTML."""
    parts = [
        f"<!doctype html><meta charset=utf-8><title>Stability</title><style>{STYLE}</style><h1>Stability</h1>",
        f"<p><code>{html.escape(made_by.command)}</code><br><span class=note>{html.escape(str(made_by))}</span></p>",
        f"<p>{html.escape(about)}</p>",
    ]
    for result in results:
        parts.append(f"<h2>{html.escape(title(result))}</h2>")
        if not result.sweep.repeats:
            parts.append(_image(chart(result)))
        parts.append(_html_table(*tabled(result)))
        parts.append(worst_pictures(out, result))
    return "\n".join(parts) + "\n"
