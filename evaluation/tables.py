# SPDX-License-Identifier: GPL-3.0-or-later
"""Rows of scores to metrics.json, and to tables in the paper's layout with the paper's own figures beside them."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from ..datagen.whole_folders import write_whole
from . import paper, protocol
from .lpips import HINT
from .metrics import ALL, METRICS, NOVEL, summarise
from .metrics import COLUMNS as METRIC_COLUMNS
from .provenance import Provenance, machine, versions

COST = ("seconds", "seconds_scoring", "gaussians", "gaussians_kept")
COLUMNS = [*METRIC_COLUMNS, *COST]
SETUP_NAMES = {
    "": "All views in",
    "alternating": "Alter. Canonical Views",
    "interpolation": "Frame Interpolation",
    "rotating": "Two Rotating Cameras",
    "random": "Random Input Views",
    "video": "Single View Video",
}
PAPERS_METRICS = ("psnr", "lpips", "ssim")  # in the order of the paper's tables
NONE = "–"

# ---------------------------------------------------------------- figures


def collect(objects: dict[str, dict[str, dict]]) -> dict:
    """{object: {method: row of the runner}} -> what metrics.json holds. The mean over all views of all objects; 5th
    percentile and worst over all views; seconds and counts are means over objects."""
    methods, sees = {}, {}
    for m in dict.fromkeys(m for o in objects.values() for m in o):
        rows = [o[m] for o in objects.values() if m in o]
        frames = {k: [x for r in rows for x in r["frames"][k]] for k in rows[0]["frames"]}
        methods[m] = summarise(frames) | {k: float(np.mean([r[k] for r in rows])) for k in COST}
        sees[m] = "depth + motion" if rows[0]["has_depth"] else "RGB only"
    per_object = {name: {m: {k: r[k] for k in COLUMNS} for m, r in rows.items()} for name, rows in objects.items()}
    return {"methods": methods, "objects": per_object, "machine": machine(), "versions": versions(), "sees": sees}


def gather(rows: list[dict], provenance: Provenance) -> dict:
    """Rows of the runner -> `collect` where there is one setup and size, else the same under `setups` by setup and
    size; with how it was made, the sizes' strides, and the runs at a time while timing."""
    parts: dict[tuple[str, int], dict[str, dict[str, dict]]] = {}
    for r in rows:
        parts.setdefault((r["setup"], r["size"]), {}).setdefault(r["object"], {})[r["method"]] = r
    found = {key: collect(objects) for key, objects in parts.items()}
    how = {
        "command": provenance.command,
        "provenance": asdict(provenance),
        "stride": {str(r["size"]): r["stride"] for r in rows},
        "jobs": max(r["jobs"] for r in rows),
        "views": {f"{s or 'all'} {n}": len(_first(objects)["frames"]["novel"]) for (s, n), objects in parts.items()},
    }
    if len(found) == 1:
        return next(iter(found.values())) | how
    out: dict = {"setups": {}, **how, "machine": machine(), "versions": versions(), "sees": {}}
    for (setup, size), metrics in found.items():
        out["setups"].setdefault(setup, {})[str(size)] = {k: metrics[k] for k in ("methods", "objects")}
        out["sees"] |= metrics["sees"]
    return out


def _first(objects: dict[str, dict[str, dict]]) -> dict:
    return next(iter(next(iter(objects.values())).values()))


# ---------------------------------------------------------------- tables


def cell(value: float | None, digits: int) -> str:
    return NONE if value is None else f"{value:.{digits}f}"


def markdown(head: list[str], lines: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(x) + " |" for x in [head, ["---"] * len(head), *lines])


def table(metrics: dict) -> str:
    """metrics.json as Markdown: the methods, one a line, or the layout of the paper for several setups."""
    if "setups" in metrics:
        return ours(metrics)[0]
    shown: list[tuple[str, str, int]] = []  # title, column, decimals
    for m in METRICS.values():
        if not m.novel_only:
            spread = [("p5", f"{m.key}_p5", m.digits), ("worst", f"{m.key}_worst", m.digits)]
            shown += [(m.title, m.key, m.digits), *(spread if ALL in m.spread else [])]
    first = next(iter(METRICS.values()))
    shown += [(f"novel {first.title}", NOVEL + first.key, first.digits)]
    shown += [(m.title, m.key, m.digits) for m in METRICS.values() if m.novel_only]
    shown += [("seconds", "seconds", 2), ("Gaussians", "gaussians", 0), ("kept", "gaussians_kept", 0)]
    lines = [[name, *(cell(m[k], digits) for _, k, digits in shown)] for name, m in metrics["methods"].items()]
    return markdown(["method", *(title for title, _, _ in shown)], lines)


def results(metrics: dict) -> dict[tuple[int, str], dict[str, dict]]:
    """{(size, method): {setup: columns, and how many `objects` they are of}}, small sizes first."""
    found: dict[tuple[int, str], dict[str, dict]] = {}
    for setup, sizes in metrics["setups"].items():
        for size, part in sizes.items():
            for m, columns in part["methods"].items():
                count = sum(m in o for o in part["objects"].values())
                found.setdefault((int(size), m), {})[setup] = columns | {"objects": count}
    order = list(dict.fromkeys(m for _, m in found))
    return dict(sorted(found.items(), key=lambda x: (x[0][0], order.index(x[0][1]))))


def ours(metrics: dict) -> tuple[str, str, str]:
    """The paper's layout; what it does not show (novel views alone, foreground, worst view, FLIP); the cost."""
    found, setups = results(metrics), list(metrics["setups"])
    most = max(c["objects"] for by_setup in found.values() for c in by_setup.values())

    def build(columns: dict[str, tuple[str, int]]) -> str:
        head = ["Res.", "Model", "Sees"]
        for s in setups:
            first, *others = columns
            head += [f"{SETUP_NAMES.get(s, s)}: {first}", *others]
        lines = []
        for (size, method), by_setup in found.items():
            short = min(c["objects"] for c in by_setup.values())
            note = f" ({short} of {most} objects)" if short < most else ""
            line = [str(size), method + note, metrics["sees"][method]]
            for s in setups:
                line += [cell(by_setup.get(s, {}).get(k), digits) for k, digits in columns.values()]
            lines.append(line)
        return markdown(head, lines)

    shown = [METRICS[k] for k in PAPERS_METRICS]
    others = [m for m in METRICS.values() if m.key not in PAPERS_METRICS and not m.novel_only]
    novel = {f"novel {m.title}": (NOVEL + m.key, m.digits) for m in (shown[0], *others)}
    novel |= {"worst novel view": (f"{NOVEL}{shown[0].key}_worst", shown[0].digits)}
    novel |= {m.title: (m.key, m.digits) for m in METRICS.values() if m.novel_only}
    return (
        build({m.title: (m.key, m.digits) for m in shown}),
        build(novel),
        build({"seconds": ("seconds", 2), "Gaussians kept": ("gaussians_kept", 0)}),
    )


def theirs(text: str) -> str:
    """One of the paper's tables as Markdown."""
    head = ["Res.", "Model", "Init."]
    for s in protocol.TABLE:
        first, *others = (METRICS[k].title for k in PAPERS_METRICS)
        head += [f"{SETUP_NAMES[s]}: {first}", *others]
    lines = []
    for size, model, initialised, known in paper.paper_rows(text):
        figures = [cell(known.get(s, {}).get(k), 3) for s in protocol.TABLE for k in PAPERS_METRICS]
        lines.append([str(size), model, initialised.replace("-", NONE), *figures])
    return markdown(head, lines)


def provenance_lines(metrics: dict) -> tuple[str, str]:
    """The command that made the metrics; and the code and the checkpoints."""
    provenance = Provenance(**metrics["provenance"])
    return provenance.command, str(provenance)


def made_by(metrics: dict) -> str:
    """The same as Markdown."""
    command, rest = provenance_lines(metrics)
    return f"`{command}`\n\n{rest}"


def tables_md(metrics: dict) -> str:
    """tables.md: every table is headed by the command that made it, the paper's by where they are from."""
    made = made_by(metrics)
    count = max(len(p["objects"]) for sizes in metrics["setups"].values() for p in sizes.values())
    stride = ", ".join(
        f"{s}²: {'every frame' if n == 1 else f'one frame of {n}'}" for s, n in metrics["stride"].items()
    )
    views = f"{count} objects; four canonical views and a random one, where rendered, at frames ({stride})"
    main, more, cost = ours(metrics)
    timing = f"{metrics['jobs']} runs at a time, one core each" if metrics["jobs"] > 1 else "one run at a time"
    lacking = all(c["lpips"] is None for by_setup in results(metrics).values() for c in by_setup.values())
    parts = [
        (made, f"Layout of the paper's tables 1 and 2. Means over {views}." + f" {HINT}" * lacking, main),
        (made, "The views among them that no input shows, alone. FLIP: less is better.", more),
        (made, f"Seconds of the reconstruction, from views in memory to Gaussians; {timing}.", cost),
    ]
    for name, text in paper.TABLES.items():
        where = f"The paper's own figures, from its table on {name}: other objects than ours, trained on 160 A100."
        parts.append((where, "Not made by the command above; transcribed for comparison.", theirs(text)))
    return "\n\n".join("\n\n".join(p) for p in parts) + "\n"


def tables_csv(metrics: dict) -> str:
    """tables.csv: the command in a comment, then ours and the paper's rows, all figures of a setup side by side."""
    figures = [k for k in COLUMNS if k != "seconds_scoring"]
    setups = list(dict.fromkeys([*metrics["setups"], *protocol.TABLE]))
    out = io.StringIO()
    out.write("".join(f"# {line}\n" for line in provenance_lines(metrics)))
    writer = csv.writer(out, lineterminator="\n")
    head = ["made_by", "objects", "resolution", "model", "sees", "initialised"]
    writer.writerow(head + [f"{s or 'all'}_{k}" for s in setups for k in figures])
    rows = []
    for (size, method), by_setup in results(metrics).items():
        count = min(c["objects"] for c in by_setup.values())
        rows.append((["ours", f"{count} of ours", size, method, metrics["sees"][method], ""], by_setup))
    for name, text in paper.TABLES.items():
        for size, model, initialised, known in paper.paper_rows(text):
            rows.append((["paper", name, size, model, "RGB only", initialised], known))
    for first, by_setup in rows:
        values = (by_setup.get(s, {}).get(k) for s in setups for k in figures)
        writer.writerow(first + ["" if v is None else f"{v:.6g}" for v in values])
    return out.getvalue()


def write_metrics(folder: Path, metrics: dict) -> None:
    """`metrics.json` and the same as `metrics.md`; of several setups also `tables.md` and `tables.csv`. Each
    whole or not at all."""
    made = f"{made_by(metrics)}\n\n" if "provenance" in metrics else ""
    texts = {"metrics.json": json.dumps(metrics, indent=1), "metrics.md": f"{made}{table(metrics)}\n"}
    if "setups" in metrics:
        texts |= {"tables.md": tables_md(metrics), "tables.csv": tables_csv(metrics)}
    for name, text in texts.items():
        write_whole(folder / name, text.encode())
