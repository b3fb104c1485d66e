# SPDX-License-Identifier: GPL-3.0-or-later
"""Rows of scores to metrics.json, and to tables in the paper's layout with the paper's own figures beside them."""

from __future__ import annotations

import csv
import io
import json
import os
import platform
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from ..model import baselines  # noqa: F401, adds its methods
from ..model.methods import METHODS
from .lpips import HINT
from .protocol import TABLE
from .provenance import Provenance

# Over all views scored (the paper's five a frame); `novel_…` and flip over those alone that no input shows.
COLUMNS = ["psnr", "psnr_p5", "psnr_worst", "psnr_fg", "psnr_fg_p5", "psnr_fg_worst", "ssim", "lpips"]
COLUMNS += ["novel_psnr", "novel_psnr_p5", "novel_psnr_worst", "novel_psnr_fg", "novel_ssim", "novel_lpips", "flip"]
COST = ["seconds", "seconds_scoring", "gaussians", "gaussians_kept"]
COLUMNS += COST
NAMES = {
    "": "All views in",
    "alternating": "Alter. Canonical Views",
    "interpolation": "Frame Interpolation",
    "rotating": "Two Rotating Cameras",
    "random": "Random Input Views",
    "video": "Single View Video",
}
NONE = "–"

# The paper's tables 1 and 2: resolution | model | initialised from GS-LRM | PSNR LPIPS SSIM of each of TABLE.
CONSISTENT4D = """
128|4D-LRM-Base|No|29.233 0.047 0.961 29.194 0.047 0.961 25.014 0.071 0.926 25.788 0.081 0.926
128|4D-LRM-Large|No|30.274 0.038 0.969 30.260 0.038 0.969 25.904 0.061 0.935 26.525 0.070 0.934
128|4D-LRM-Large|Yes|31.023 0.031 0.974 30.917 0.031 0.973 28.703 0.042 0.959 28.789 0.049 0.957
256|SoM|-|25.586 0.055 0.906 - - - 22.756 0.089 0.941 17.637 0.208 0.875
256|GS-LRM (Per Fr.)|-|19.327 0.097 0.902 - - - 20.037 0.094 0.935 16.826 0.212 0.801
256|GS-LRM (All in)|-|21.606 0.086 0.925 21.590 0.086 0.925 20.641 0.100 0.909 19.665 0.132 0.897
256|4D-LRM-Base|No|27.443 0.062 0.952 27.394 0.062 0.953 23.429 0.088 0.918 23.882 0.096 0.916
256|4D-LRM-Large|No|27.860 0.049 0.959 27.822 0.048 0.959 25.095 0.069 0.934 25.776 0.073 0.934
256|4D-LRM-Free|Yes|30.396 0.036 0.973 30.376 0.036 0.973 26.184 0.061 0.943 26.337 0.067 0.939
256|4D-LRM-Large|Yes|32.177 0.028 0.980 32.145 0.028 0.980 27.664 0.050 0.957 27.990 0.057 0.954
"""
OBJAVERSE4D = """
128|4D-LRM-Base|No|27.374 0.068 0.937 27.287 0.068 0.937 25.496 0.075 0.924 24.174 0.112 0.893
128|4D-LRM-Large|No|28.489 0.055 0.949 28.440 0.055 0.949 26.312 0.064 0.934 25.023 0.096 0.905
128|4D-LRM-Large|Yes|29.251 0.042 0.959 29.169 0.043 0.958 28.676 0.043 0.957 27.586 0.064 0.939
256|GS-LRM (Per Frame)|-|18.796 0.164 0.854 - - - 19.729 0.143 0.911 18.300 0.176 0.845
256|GS-LRM (All in)|-|19.388 0.138 0.888 19.412 0.139 0.888 19.428 0.138 0.888 19.379 0.138 0.888
256|4D-LRM-Base|No|25.806 0.085 0.928 25.711 0.085 0.929 23.974 0.085 0.924 22.409 0.125 0.889
256|4D-LRM-Large|No|26.658 0.066 0.942 26.580 0.066 0.942 25.524 0.067 0.937 24.461 0.095 0.913
256|4D-LRM-Free|Yes|28.838 0.050 0.958 28.790 0.051 0.958 26.998 0.056 0.949 25.267 0.082 0.923
256|4D-LRM-Large|Yes|30.094 0.041 0.967 30.028 0.042 0.967 27.810 0.049 0.957 26.694 0.072 0.939
"""
PAPER = {"Consistent4D, re-rendered": CONSISTENT4D, "Objaverse4D (Test)": OBJAVERSE4D}


def paper_rows(text: str) -> list[tuple[int, str, str, dict[str, dict[str, float]]]]:
    """-> (resolution, model, initialised, {setup: {psnr, lpips, ssim}}) of every row; a setup without figures
    is missing."""
    rows = []
    for line in text.strip().splitlines():
        size, model, initialised, figures = line.split("|")
        values = figures.split()
        triples = {s: values[3 * i : 3 * i + 3] for i, s in enumerate(TABLE)}
        known = {
            s: dict(zip(("psnr", "lpips", "ssim"), map(float, v), strict=True))
            for s, v in triples.items()
            if v[0] != "-"
        }
        rows.append((int(size), model, initialised, known))
    return rows


# ---------------------------------------------------------------- figures


def summarise(frames: dict[str, list]) -> dict[str, float | None]:
    """Per-view scores, and `novel` for each view -> mean, and for PSNR 5th percentile and worst; of all views
    and of the novel ones. None where there is nothing to average."""

    def mean(values: list) -> float | None:
        known = [x for x in values if x is not None]
        return float(np.mean(known)) if known else None

    out: dict[str, float | None] = {}
    for prefix, keep in (("", [True] * len(frames["novel"])), ("novel_", frames["novel"])):
        part = {k: [x for x, kept in zip(v, keep, strict=True) if kept] for k, v in frames.items()}
        for k in ("psnr", "psnr_fg", "ssim", "lpips"):
            out[prefix + k] = mean(part[k])
        for k in ("psnr", "psnr_fg"):
            out[f"{prefix}{k}_p5"] = float(np.percentile(part[k], 5)) if part[k] else None
            out[f"{prefix}{k}_worst"] = min(part[k], default=None)
    out["flip"] = mean(frames["flip"])
    return {k: out[k] for k in COLUMNS if k in out}


def collect(objects: dict[str, dict[str, dict]]) -> dict:
    """{object: {method: row of `evaluate_views`}} -> what metrics.json holds. The mean over all views of all
    objects; 5th percentile and worst over all views; seconds and counts are means over objects."""
    methods: dict[str, dict] = {}
    for m in dict.fromkeys(m for o in objects.values() for m in o):
        rows = [o[m] for o in objects.values() if m in o]
        frames = {k: [x for r in rows for x in r["frames"][k]] for k in rows[0]["frames"]}
        methods[m] = summarise(frames) | {k: float(np.mean([r[k] for r in rows])) for k in COST}
    per_object = {name: {m: {k: r[k] for k in COLUMNS} for m, r in rows.items()} for name, rows in objects.items()}
    return {"methods": methods, "objects": per_object, "machine": machine(), "versions": versions()}


def gather(rows: list[dict], provenance: Provenance) -> dict:
    """Rows of `evaluate.evaluate_folders` -> `collect` where there is one setup and size, else the same under
    `setups` by setup and size; with how it was made, the sizes' strides, and the runs at a time while timing."""
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
    out: dict = {"setups": {}, **how}
    for (setup, size), metrics in found.items():
        out["setups"].setdefault(setup, {})[str(size)] = {k: metrics[k] for k in ("methods", "objects")}
    return out | {"machine": machine(), "versions": versions()}


def _first(objects: dict[str, dict[str, dict]]) -> dict:
    return next(iter(next(iter(objects.values())).values()))


def machine() -> dict:
    """What the figures were taken on."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [x.split(":", 1)[1].strip() for x in cpuinfo.read_text().splitlines() if x.startswith("model name")]
        name = names[0] if names else name
    return {"cpu": name, "cores": usable_cores(), "system": f"{platform.system()} {platform.machine()}"}


def usable_cores() -> int:
    """How many processor cores this process may use; of the whole machine where the system does not say (macOS and
    Windows)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions() -> dict:
    """Versions of what has a say in the figures."""
    out = {"python": platform.python_version()}
    for package in ("timesplat", "torch", "numpy", "numba", "bpy", "usd-core"):
        try:
            out[package] = version(package)
        except PackageNotFoundError:
            out[package] = None
    return out


# ---------------------------------------------------------------- tables


def cell(value: float | None, digits: int) -> str:
    return NONE if value is None else f"{value:.{digits}f}"


def markdown(head: list[str], lines: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(x) + " |" for x in [head, ["---"] * len(head), *lines])


def table(metrics: dict) -> str:
    """metrics.json as Markdown: the methods, one a line, or the layout of the paper for several setups."""
    if "setups" in metrics:
        return ours(metrics)[0]
    head = ["method", "PSNR", "p5", "worst", "PSNR fg", "p5", "worst", "SSIM", "LPIPS", "novel PSNR", "FLIP"]
    lines = []
    for name, m in metrics["methods"].items():
        cells = [cell(m[k], 2) for k in COLUMNS[:6]] + [cell(m["ssim"], 3), cell(m["lpips"], 3)]
        cells += [cell(m["novel_psnr"], 2), cell(m["flip"], 3), cell(m["seconds"], 2)]
        lines.append([name, *cells, f"{m['gaussians']:.0f}", f"{m['gaussians_kept']:.0f}"])
    return markdown([*head, "seconds", "Gaussians", "kept"], lines)


def sees(method: str) -> str:
    """What a method is given, for the tables."""
    known = METHODS.get(method.split("+")[0])
    return "depth + motion" if known and known.has_depth else "RGB only"


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
            head += [f"{NAMES.get(s, s)}: {first}", *others]
        lines = []
        for (size, method), by_setup in found.items():
            short = min(c["objects"] for c in by_setup.values())
            note = f" ({short} of {most} objects)" if short < most else ""
            line = [str(size), method + note, sees(method)]
            for s in setups:
                line += [cell(by_setup.get(s, {}).get(k), digits) for k, digits in columns.values()]
            lines.append(line)
        return markdown(head, lines)

    return (
        build({"PSNR": ("psnr", 2), "LPIPS": ("lpips", 3), "SSIM": ("ssim", 3)}),
        build(
            {
                "novel PSNR": ("novel_psnr", 2),
                "novel fg PSNR": ("novel_psnr_fg", 2),
                "worst novel view": ("novel_psnr_worst", 2),
                "FLIP": ("flip", 3),
            }
        ),
        build({"seconds": ("seconds", 2), "Gaussians kept": ("gaussians_kept", 0)}),
    )


def theirs(text: str) -> str:
    """One of the paper's tables as Markdown."""
    head = ["Res.", "Model", "Init."]
    for s in TABLE:
        head += [f"{NAMES[s]}: PSNR", "LPIPS", "SSIM"]
    lines = []
    for size, model, initialised, known in paper_rows(text):
        digits = {"psnr": 3, "lpips": 3, "ssim": 3}
        figures = [cell(known.get(s, {}).get(k), d) for s in TABLE for k, d in digits.items()]
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
    for name, text in PAPER.items():
        where = f"The paper's own figures, from its table on {name}: other objects than ours, trained on 160 A100."
        parts.append((where, "Not made by the command above; transcribed for comparison.", theirs(text)))
    return "\n\n".join("\n\n".join(p) for p in parts) + "\n"


def tables_csv(metrics: dict) -> str:
    """tables.csv: the command in a comment, then ours and the paper's rows, all figures of a setup side by side."""
    figures = [k for k in COLUMNS if k != "seconds_scoring"]
    setups = list(dict.fromkeys([*metrics["setups"], *TABLE]))
    out = io.StringIO()
    out.write("".join(f"# {line}\n" for line in provenance_lines(metrics)))
    writer = csv.writer(out, lineterminator="\n")
    head = ["made_by", "objects", "resolution", "model", "sees", "initialised"]
    writer.writerow(head + [f"{s or 'all'}_{k}" for s in setups for k in figures])
    rows = []
    for (size, method), by_setup in results(metrics).items():
        count = min(c["objects"] for c in by_setup.values())
        rows.append((["ours", f"{count} of ours", size, method, sees(method), ""], by_setup))
    for name, text in PAPER.items():
        for size, model, initialised, known in paper_rows(text):
            rows.append((["paper", name, size, model, "RGB only", initialised], known))
    for first, by_setup in rows:
        values = (by_setup.get(s, {}).get(k) for s in setups for k in figures)
        writer.writerow(first + ["" if v is None else f"{v:.6g}" for v in values])
    return out.getvalue()


def write_metrics(folder: Path, metrics: dict) -> None:
    """`metrics.json` and the same as `metrics.md`; of several setups also `tables.md` and `tables.csv`. Each
    whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    made = f"{made_by(metrics)}\n\n" if "provenance" in metrics else ""
    texts = {"metrics.json": json.dumps(metrics, indent=1), "metrics.md": f"{made}{table(metrics)}\n"}
    if "setups" in metrics:
        texts |= {"tables.md": tables_md(metrics), "tables.csv": tables_csv(metrics)}
    for name, text in texts.items():
        tmp = folder / f".{name}.tmp"
        tmp.write_text(text, encoding="utf-8")
        tmp.replace(folder / name)
