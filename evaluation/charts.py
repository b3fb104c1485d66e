# SPDX-License-Identifier: GPL-3.0-or-later
"""The pictures and the page of `timesplat bench`, from its bench.csv alone: `draw(Path("out/bench/bench.csv"))`.

Beside the CSV: bench.md, bench-seconds, bench-size, bench-budgets and bench-inputs as SVG and PNG (those there are
figures for), and bench-renderer from a bench-renderer.csv. Squares see depth and motion, circles RGB alone; ours are
filled, baselines hollow. Bars are standard errors over objects of the paired differences to the method at the
centre that sees the same (`guided`, `rgb`), which has none itself.
"""

from __future__ import annotations

import csv
import io
import re
from itertools import groupby
from pathlib import Path

import numpy as np

from ..benchmarks.renderer import COLUMNS as RENDERER
from ..benchmarks.renderer import TRUTH
from ..datagen.sequence import InputError
from ..datagen.whole_folders import write_whole
from .bench_summary import FIGURES, Mean, frontier, read_csv, summarise
from .figures import COLOURS, MARKERS, panels, save
from .labels import plain, settle
from .metrics import METRICS

BLUE, ORANGE, GREEN, PINK, YELLOW, SKY, BLACK, GREY = COLOURS
PURPLE = "#7b3294"
FAMILIES = {
    "tracks": BLACK,
    "flow": PURPLE,
    "lift": GREY,
    "guided": BLUE,
    "rgb": ORANGE,
    "sweep": ORANGE,
    "predicted": PINK,
    "gs-lrm-all": YELLOW,
}
FAMILIES |= {"gs-lrm-frame": YELLOW, "hull": GREY, "white": GREY, "4dgs": GREEN, "deform": SKY, "som": SKY}
SEES = {True: "depth + motion", False: "RGB alone"}
NAMES = {"seconds": "seconds of one thread", "gaussians": "Gaussians", "ply_mb": "megabytes of the .ply"}
NAMES |= {"usd_mb": "megabytes of the .usdc"}


def axis_name(key: str) -> str:
    """How an axis calls a figure."""
    if key not in METRICS:
        return NAMES[key]
    m = METRICS[key]
    return f"{m.axis} of novel views" + ("" if m.higher_is_better else " (upside down: up is better)")


def draw(path: Path) -> str:
    """bench.md and the pictures beside a bench.csv -> the table of frontiers. Raises InputError for another file."""
    rows, command, facts = read_csv(path)
    setup, size = facts["centre"]
    means = summarise(rows, (setup, size))
    centre = [m for m in means if (m.setup, m.size) == (setup, size)]
    pictures = []
    for name, costs, worths in (
        ("seconds", ("seconds",) * len(charted(centre)), charted(centre)),
        ("size", ("gaussians", "usd_mb" if any(m.mean["usd_mb"] for m in centre) else "ply_mb"), ("psnr", "psnr")),
    ):
        fig, axes = panels(len(costs), 5.6, 4.8)
        work = [trade(ax, centre, c, w) for ax, c, w in zip(axes, costs, worths, strict=True)]
        key(axes[0], centre)
        settle(fig, work)
        pictures.append(_save(fig, path, name, command))
    losses = budgets(rows, (setup, size))
    if losses:
        pictures.append(_save(draw_budgets(losses), path, "budgets", command))
    if len(means) > len(centre):
        pictures.append(_save(draw_inputs(means, setup, size), path, "inputs", command))
    renderer = path.with_name(f"{path.stem}-renderer.csv")
    if renderer.is_file():
        pictures.append(draw_renderer(renderer))
    write_whole(path.with_suffix(".md"), page(means, centre, rows, command, facts, pictures).encode())
    return frontiers(centre)


def charted(means: list[Mean]) -> tuple[str, ...]:
    """The metrics that get a panel: those meant for charts that every method has."""
    return tuple(k for k, m in METRICS.items() if m.charted and all(x.mean[k] is not None for x in means))


def _save(fig, path: Path, name: str, command: str) -> str:
    stem = path.with_name(f"{path.stem}-{name}")
    save(fig, stem, command)
    return stem.name


# ---------------------------------------------------------------- one method against another


def kind(m: Mean) -> tuple:
    """What a line joins: fits of one method for several seconds, steps or qualities, refinements of one, budgets of
    one."""
    method = m.method
    what = "budget" if method.budget else "dense" if method.dense else ""
    by = next((k for k in ("refine", "quality", "steps") if getattr(method, k)), "")
    value = getattr(method, by) if by else None
    if method.budget:  # of this
        return method.method, method.checkpoint, what, f"+{by}:{value:g}" if by == "refine" else by and f"+{by}:{value}"
    return method.method, method.checkpoint, what, "" if by == "refine" else by


def lines(means: list[Mean]) -> dict[str, list[Mean]]:
    """{label: points that a line joins, in its order}; single points too. A line of budgets starts at what it is a
    budget of."""
    found: dict[tuple, list[Mean]] = {}
    for m in means:
        found.setdefault(kind(m), []).append(m)
    out = {}
    for (_, _, what, by), group in found.items():
        head = re.split(r"[:+]", group[0].method.label)[0]  # with other weights, where it has them
        if what == "budget":
            whole = f"{head}{by}"
            group = [m for m in means if m.method.label == whole] + group
            out[f"{whole}+budget"] = sorted(group, key=lambda m: m["gaussians"])
        elif what == "dense":
            out |= {m.method.label: [m] for m in group}
        elif by:
            out[f"{head}+{by}"] = sorted(group, key=lambda m: m.method.counted)
        else:
            refined = len(group) > 1 and any(m.method.refine for m in group)
            out[f"{head}+refine" if refined else head] = sorted(group, key=lambda m: m.method.fit_seconds)
    return out


def trade(ax, means: list[Mean], cost: str, worth: str) -> tuple:
    """A panel: what ways cost (log) and are worth, with lines and both frontiers; -> what `place` takes. FLIP is drawn
    upside down, so that up is better."""
    means = [m for m in means if m.mean[cost]]
    ax.set(xscale="log", xlabel=NAMES[cost], ylabel=axis_name(worth))
    labels: list[tuple] = []
    hints: list[tuple] = []
    drawn: list[tuple] = []
    for label, group in lines(means).items():
        x, y = [m[cost] for m in group], [m[worth] for m in group]
        colour, budget = FAMILIES[group[0].method.method], "budget" in label
        ax.plot(x, y, color=colour, linewidth=1, zorder=2, linestyle="--" if budget else "-")
        drawn.append((x, y))
        at = 0 if budget else -1
        labels.append((x[at], y[at], label, colour))
        if "refine" in label and not budget:
            labels.append((x[0], y[0], group[0].method.label, colour))
        if cost != "seconds":
            said = {h[:3] for h in hints}
            found = [(a, b, hint(m), colour) for a, b, m in zip(x, y, group, strict=True)]
            hints += [h for h in found if h[2] and h[:3] not in said]
    for m in means:
        at_x, at_y, colour, error = m[cost], m[worth], FAMILIES[m.method.method], m.gain_error.get(worth, 0)
        drawn.append(([at_x, at_x], [at_y - error, at_y + error]))
        ax.errorbar(
            at_x, at_y, yerr=error or None, color=colour, ecolor=colour, elinewidth=0.8, capsize=2, linestyle="none",
            marker="s" if m.method.has_depth else "o", zorder=4,
            markersize=3 if cost == "seconds" and m.method.budget else 5,
            markerfacecolor="white" if m.method.baseline else colour,
        )  # fmt: skip
    for has_depth in (True, False):
        best = on_frontier([m for m in means if m.method.has_depth == has_depth], cost, worth)
        x, y = [m[cost] for m in best], [m[worth] for m in best]
        look = {"color": "#606060", "drawstyle": "steps-post", "zorder": 1}
        ax.plot(x, y, linewidth=5, alpha=0.15, **look)
        ax.plot(x, y, linewidth=0.9, linestyle="-" if has_depth else ":", **look)
        drawn.append((np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]))
    ax.margins(0.12, 0.08)
    if not METRICS[worth].higher_is_better:
        ax.invert_yaxis()
    plain(ax)
    dots = [(m[cost], m[worth]) for m in means]
    return ax, labels, hints, drawn, dots


def hint(m: Mean) -> str:
    """What tells a point from the others of its line, where the x axis does not."""
    if m.method.counted and not m.method.budget:
        return m.method.quality or f"{m.method.counted} steps"
    return m.method.budget or (f"{m.method.fit_seconds:g} s" if m.method.fit_seconds else "")


def on_frontier(means: list[Mean], cost: str, worth: str) -> list[Mean]:
    """Those on the Pareto frontier, cheapest first."""
    means = [m for m in means if m.mean[cost] is not None]
    sign = 1 if METRICS[worth].higher_is_better else -1
    return [means[i] for i in frontier([m[cost] for m in means], [sign * m[worth] for m in means])]


def key(ax, means: list[Mean]) -> None:
    """What the markers and the grey lines mean, above a panel."""
    from matplotlib.lines import Line2D

    made = []
    look: dict = {"color": "#404040", "linestyle": "none", "markersize": 5}
    for has_depth in (True, False):
        if any(m.method.has_depth == has_depth for m in means):
            mark, style = ("s", "-") if has_depth else ("o", ":")
            made.append(Line2D([], [], marker=mark, label=f"sees {SEES[has_depth]}", **look))
            made.append(Line2D([], [], color="#606060", linestyle=style, label="its Pareto frontier"))
    if any(m.method.baseline for m in means):
        made.append(Line2D([], [], marker="o", markerfacecolor="white", label="hollow: baselines", **look))
    legend = ax.legend(handles=made, fontsize=7, loc="lower left", bbox_to_anchor=(0, 1), ncols=5, columnspacing=1)
    legend.set_in_layout(False)
    ax.set_title(" ", fontsize=9)  # room for it


# ---------------------------------------------------------------- budgets, inputs, the renderer


def budgets(rows: list[dict], centre: tuple[str, int]) -> dict[str, dict[str, list[tuple[float, float, bool]]]]:
    """{method without a budget: {object: [(Gaussians, dB won over no budget, whether it is auto)] by size}}."""
    here = {(r["way"], r["object"]): r for r in rows if (r["setup"], r["size"]) == tuple(centre)}
    out: dict = {}
    for (label, name), r in here.items():
        whole, _, amount = label.partition("+budget:")
        if amount and (whole, name) in here:
            full = here[whole, name]
            curve = out.setdefault(whole, {}).setdefault(name, [(full["gaussians"], 0.0, False)])
            curve.append((r["gaussians"], r["psnr"] - full["psnr"], amount == "auto"))
    return {w: {n: sorted(c) for n, c in curves.items()} for w, curves in out.items()}


def draw_budgets(losses: dict):
    """A panel for each method: what an object loses when it has fewer Gaussians; a star is what `auto` chose."""
    fig, axes = panels(len(losses), 5.6, 4.2)
    work: list[tuple] = []
    for ax, (whole, curves) in zip(axes, losses.items(), strict=True):
        labels, drawn = [], []
        for i, (name, curve) in enumerate(curves.items()):
            colour, (n, gain, _) = COLOURS[i % len(COLOURS)], zip(*curve, strict=True)
            ax.plot(n, gain, color=colour, marker=MARKERS[i % 5], markersize=3.5, linewidth=1.1)
            whole_n = [a for a, b, star in curve if b == 0 and not star]
            ax.plot(whole_n[:1], [0], marker="o", markersize=7, color=colour, markerfacecolor="white", zorder=1.9)
            stars = [(a, b) for a, b, star in curve if star]
            ax.plot(*zip(*stars, strict=True), marker="*", markersize=9, color=colour, linestyle="none") if stars else 0
            labels.append((n[0], gain[0], name, colour))
            drawn.append((n, gain))
        ax.set(
            xscale="log", xlabel="Gaussians (star: budget auto; ring: no budget)", ylabel="PSNR against no budget (dB)"
        )
        ax.margins(0.14, 0.1)
        plain(ax)
        ax.set_title(whole, fontsize=9)
        work.append((ax, labels, [], drawn, [(a, b) for xs, ys in drawn for a, b in zip(xs, ys, strict=True)]))
    settle(fig, work)
    return fig


def draw_inputs(means: list[Mean], setup: str, size: int):
    """PSNR and seconds over the number of views, and PSNR against seconds at sizes in pixels."""
    by_views = [m for m in means if m.size == size and (m.setup == setup or m.setup.startswith("views-"))]
    by_size = [m for m in means if m.setup == setup]
    chosen = [w for w in dict.fromkeys(m.method.label for m in means) if any(
        m.method.label == w and (m.setup, m.size) != (setup, size) for m in means)]  # fmt: skip
    plans = [("views", "psnr", by_views), ("views", "seconds", by_views), ("seconds", "psnr", by_size)]
    plans = [p for p in plans if len({(m.setup, m.size) for m in p[2]}) > 1]
    fig, axes = panels(len(plans), 4.6, 4.2)
    work: list[tuple] = []
    for ax, (x_name, y_name, part) in zip(axes, plans, strict=True):
        labels, hints, drawn = [], [], []
        for w in chosen:
            line = sorted((m for m in part if m.method.label == w), key=lambda m: (m.views, m.size))
            x = [m.views if x_name == "views" else m["seconds"] for m in line]
            y, method, colour = [m[y_name] for m in line], line[0].method, FAMILIES[line[0].method.method]
            ax.plot(
                x, y, color=colour, linewidth=1.2, marker="s" if method.has_depth else "o", markersize=4.5,
                linestyle="--" if "refine" in w else "-", markerfacecolor="white" if method.baseline else colour,
            )  # fmt: skip
            labels.append((x[-1], y[-1], w, colour))
            hints += [(a, b, f"{m.size}²", colour) for a, b, m in zip(x, y, line, strict=True) if x_name != "views"]
            drawn.append((x, y))
        label = "input views" if x_name == "views" else "seconds of one thread (truth at the same size)"
        ax.set(xscale="log", xlabel=label, ylabel=axis_name(y_name))
        ax.set_yscale("log" if y_name == "seconds" else "linear")
        ax.margins(0.18, 0.1)
        plain(ax)
        if x_name == "views":
            ticks = sorted({m.views for m in part})
            ax.set_xticks(ticks, [str(t) for t in ticks])
            ax.minorticks_off()
        if y_name == "seconds":
            plain(ax, ax.yaxis)
        work.append((ax, labels, hints, drawn, [(a, b) for xs, ys in drawn for a, b in zip(xs, ys, strict=True)]))
    settle(fig, work)
    return fig


def write_renderer(path: Path, rows: list[dict], command: str) -> None:
    """bench-renderer.csv, after a comment with the command."""
    text = io.StringIO()
    text.write(f"# {command}\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(RENDERER)
    writer.writerows([[f"{r[k]:.5g}" if isinstance(r[k], float) else r[k] for k in RENDERER] for r in rows])
    write_whole(path, text.getvalue().encode())


def draw_renderer(path: Path) -> str:
    """The picture beside a bench-renderer.csv: Cycles samples against seconds an image and PSNR. -> its stem."""
    try:
        head, *rest = path.read_text().splitlines()
        rows = [(r["object"], int(r["samples"]), float(r["seconds"]), float(r["psnr"])) for r in csv.DictReader(rest)]
        if not rows:
            raise ValueError
    except (ValueError, KeyError, TypeError):
        raise InputError(
            f"{path}: not a whole bench-renderer.csv; remove it and run `timesplat bench` again."
        ) from None
    fig, (ax,) = panels(1, 5.6, 4.2)
    labels, hints, drawn = [], [], []
    for i, (name, group) in enumerate(groupby(rows, key=lambda r: r[0])):
        _, n, x, y = zip(*group, strict=True)
        ax.plot(x, y, color=COLOURS[i], marker="os"[i % 2], markersize=4.5, linewidth=1.2)
        labels.append((x[-1], y[-1], name, COLOURS[i]))
        hints += [(a, b, str(k), COLOURS[i]) for a, b, k in zip(x, y, n, strict=True)]
        drawn.append((x, y))
    ax.set(xscale="log", xlabel="seconds an image of one thread; numbers: Cycles samples")
    ax.set_ylabel(f"PSNR to {TRUTH} samples (dB)")
    ax.margins(0.14, 0.1)
    plain(ax)
    settle(fig, [(ax, labels, hints, drawn, [(a, b) for xs, ys in drawn for a, b in zip(xs, ys, strict=True)])])
    save(fig, path.with_suffix(""), head.removeprefix("# "))
    return path.stem


# ---------------------------------------------------------------- the page


def page(means: list[Mean], centre: list[Mean], rows: list[dict], command: str, facts: dict, pictures: list) -> str:
    """bench.md."""
    setup, size = facts["centre"]
    machine, versions = facts["machine"], facts["versions"]
    names = list(dict.fromkeys(r["object"] for r in rows))
    most = max(m.count for m in means)
    short = sorted({r["way"] for r in rows} - {m.method.label for m in means})
    seen = f"the setup `{setup}`" if setup else "all views that are not held out"
    what = [
        f"{most} objects ({', '.join(names)}); centre: {seen}, {size}x{size} pixels; scored on held-out views.",
        f"{machine['cpu']}, {machine['cores']} cores, {machine['system']}; Python {versions['python']}, torch "
        f"{versions['torch']}; {facts['date']}. {facts['jobs']} runs at a time, one core and one thread each; the "
        f"whole took {facts['seconds_total'] / 60:.1f} minutes by the clock.",
        *facts["notes"],
    ]
    if short:
        what.append(f"Left out, for not all objects were reached in the time given: {', '.join(short)}.")
    parts = [
        "# Speed against accuracy",
        f"`{command}`",
        facts.get("made_by", ""),
        *what,
        "## Pareto frontiers",
        frontiers(centre),
    ]
    parts += [f"![{p}]({p}.png)" for p in pictures]
    others = [m for m in means if m not in centre]
    parts += ["## At the centre", table(centre)] + (["## Other inputs and sizes", table(others)] if others else [])
    parts.append(
        "± is the standard error over objects. Gain: PSNR against the method at the centre that sees the same "
        "(`guided`, or `rgb`), object by object, with the standard error of that difference; these are the bars in "
        "the pictures. Seconds: from views in memory to Gaussians, of one thread. FLIP: less is better. Gaussians: "
        "those that the paper's inference filters keep. No megabytes where a scene is no 4D Gaussians. Drawing: "
        "milliseconds a view at this size. Coverage: what share of the object the input views show, by the method's "
        "own Gaussians (`model.coverage`). +dense: tokens of the network everywhere, not only where the object is."
    )
    return "\n\n".join(filter(None, parts)) + "\n"


def frontiers(centre: list[Mean]) -> str:
    """A Markdown table of what is on each frontier, and which of it are baselines."""
    lines = ["| frontier | among ways that see | on it, cheapest first | baselines on it |", "|---|---|---|---|"]
    pairs = [(k, "seconds") for k in charted(centre)] + [("psnr", "gaussians"), ("psnr", "usd_mb")]
    for worth, cost in pairs:
        if not any(m.mean[cost] for m in centre):
            continue
        for sees in (True, False, None):
            group = [m for m in centre if sees is None or m.method.has_depth == sees]
            if not group or (sees is None and len({m.method.has_depth for m in centre}) == 1):
                continue
            best = on_frontier(group, cost, worth)
            base = ", ".join(m.method.label for m in best if m.method.baseline) or "none"
            cells = [f"{METRICS[worth].title} / {NAMES[cost]}", "either" if sees is None else SEES[sees]]
            lines.append("| " + " | ".join([*cells, ", ".join(m.method.label for m in best), base]) + " |")
    return "\n".join(lines)


def table(means: list[Mean]) -> str:
    digits = {k: m.digits for k, m in METRICS.items()}
    digits |= {"seconds": 2, "gaussians": 0, "ply_mb": 2, "usd_mb": 2, "render_ms": 1, "coverage": 2}
    titles = {"seconds": "seconds", "gaussians": "Gaussians", "ply_mb": ".ply MB", "usd_mb": ".usdc MB"}
    titles |= {"render_ms": "drawing ms", "coverage": "coverage"} | {k: m.title for k, m in METRICS.items()}
    known = [k for k in FIGURES if k not in METRICS or any(m.mean[k] is not None for m in means)]
    heads = ["method", "sees", "views", "size"]
    heads += [x for k in known for x in ([titles[k], "gain"] if k == "psnr" else [titles[k]])]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]

    def cell(value: float | None, error: float, n: int, signed: bool = False) -> str:
        if value is None:
            return "–"
        return f"{value:{'+' if signed else ''}.{n}f}" + (f" ± {error:.{n}f}" if error else "")

    for m in means:
        line = [m.method.label, SEES[m.method.has_depth], str(m.views), str(m.size)]
        for k in known:
            line.append(cell(m.mean[k], m.error[k] if k in charted(means) else 0, digits[k]))
            if k == "psnr":
                line.append(cell(m.gain.get(k), m.gain_error.get(k, 0), 2, True))
        lines.append("| " + " | ".join(line) + " |")
    return "\n".join(lines)
