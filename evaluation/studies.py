# SPDX-License-Identifier: GPL-3.0-or-later
"""The paper's figures and secondary tables, one command each: `python -m timesplat.evaluation.studies STUDY …`.

  training       scaling of training: PSNR against steps and against CPU-seconds, of run folders
  views          scaling of inference: PSNR, SSIM, FLIP against the number of input views
  views-per-frame  1 to 4 random views a frame and the 4 canonical ones (paper, table 3)
  static         single moments, times collapsed to 0 (paper, appendix B)
  video          the front's video with all sides of its first frame (paper, table 4)
  frame-rate     inputs at every 4th frame, the frames between against the truth
  lifetimes      where in time the Gaussians are, with and without missing frames (paper, figure 5)
  pictures       rows of methods, columns of frames

Objects are Sequences below the folders given, rendered with `timesplat render --rig evaluation --targets 1`.
Methods are written as method_spec.py says, with commas between. Figures come as SVG and PNG, tables as
Markdown and CSV, each with its command. Scores are kept in OUT/rows.jsonl: an interrupted study goes on.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
from tqdm import tqdm

from ..datagen.sequence import InputError, Sequence
from ..exit_codes import exit_code
from . import paper, protocol
from .ablations import RUNS, read_log
from .figures import COLOURS, band, command_line, panels, save, save_picture, smooth, write_table
from .loading import load_truth
from .method_spec import FORM, parse_specs
from .metrics import METRICS
from .pictures import grid
from .provenance import Provenance
from .scoring import draw
from .study_scores import (
    PAPERS,
    TITLES,
    StudyOptions,
    about,
    cells,
    novel_views,
    paper_views,
    per_object,
    printed,
    scene_of,
    scored,
    scored_parts,
    subjects,
)


def main(argv: list[str] | None = None) -> int:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = p.add_subparsers(dest="study", required=True, metavar="STUDY")
    for name, (run, arguments, default) in STUDIES.items():
        sub = commands.add_parser(name, help=run.__doc__, description=run.__doc__)
        sub.set_defaults(run=run)
        sub.add_argument("--out", type=Path, default=Path("out/studies"), help="folder (default: out/studies)")
        if default:
            sub.add_argument("folders", nargs="+", type=Path, metavar="SEQUENCES", help="folders of Sequences")
            about = f"comma-separated {FORM} (default: {default})".replace("%", "%%")
            sub.add_argument("--methods", default=default, help=about)
            sub.add_argument("--size", type=int, default=128, help="pixels, by averaging (default: 128)")
            sub.add_argument("--jobs", type=int, default=1, help="processes, one core each (default: 1)")
            sub.add_argument("--device", default="cpu", help="where methods run: cpu or cuda (default: cpu)")
        for words, how in arguments:
            sub.add_argument(words, **how)
    return exit_code("studies", lambda: study(p.parse_args(argv), argv))


def study(args: argparse.Namespace, argv: list[str] | None) -> None:
    """The study that was asked for, with its part of the options."""
    run, default = args.run, STUDIES[args.study][2]
    methods = parse_specs(args.methods, seconds=10.0) if default else []
    options = StudyOptions(
        out=args.out,
        made_by=Provenance.of(command_line("timesplat.evaluation.studies", argv), [m.weights for m in methods]),
        subjects=subjects(args.folders, args.size) if default else {},
        methods=methods,
    )
    for f in fields(options):  # each study has its own arguments
        if f.name not in ("made_by", "subjects", "methods") and hasattr(args, f.name):
            setattr(options, f.name, getattr(args, f.name))
    run(options)


def numbers(text: str) -> list[int]:
    try:
        return sorted({int(x) for x in text.split(",")})
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}: whole numbers with commas between, please") from None


# ---------------------------------------------------------------- studies


def training(options: StudyOptions) -> None:
    """Scaling of training: PSNR of the training samples against steps and CPU-seconds, of several runs."""
    runs = {}
    for word in options.runs:
        name, _, folders = word.rpartition("=")
        if name:
            runs[name] = [read_log(Path(f)) for f in folders.split("+")]
        else:
            runs |= comparisons(Path(word))
    fig, axes = panels(2, width=4.8, height=3.6)
    seconds = "CPU-seconds"
    for n, (name, logs) in enumerate(runs.items()):
        step: list[int] = []
        spent: list[float] = []
        psnr: list[float] = []
        for log in logs:  # the stages of a run, one after the other
            s0, c0 = (step[-1], spent[-1]) if step else (0, 0.0)
            step += [s0 + x["step"] for x in log]
            spent += [c0 + x.get("cpu_seconds", x["seconds"]) for x in log]
            psnr += [x["psnr"] for x in log]
            seconds = seconds if "cpu_seconds" in log[-1] else "seconds"
        look = {"color": COLOURS[n % len(COLOURS)], "linestyle": ["-", "--", ":"][n // len(COLOURS) % 3]}
        for ax, x in zip(axes, (step, spent), strict=True):
            ax.plot(x, psnr, linewidth=0.5, alpha=0.25, **look)
            ax.plot(x, smooth(psnr, options.window), linewidth=1.6, label=name, **look)
    axes[0].set(xlabel="training steps", ylabel="PSNR of training targets (dB)")
    axes[1].set(xlabel=seconds, ylabel="PSNR of training targets (dB)")
    axes[1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(fig, options.out / "training", options.made_by.caption)


def comparisons(folder: Path) -> dict[str, list]:
    """{run: logs of its stages} below a folder that `evaluation.ablations` filled."""
    order = [r.name for r in RUNS]
    logs = sorted(
        (p for p in folder.glob("*/log.jsonl") if p.parent.name in order), key=lambda p: order.index(p.parent.name)
    )
    if not logs:
        raise InputError(f"{folder}: there is no run in it; give NAME=RUN for a single one.")
    stages = [[x for x in (p.parent / "first", p.parent) if (x / "log.jsonl").is_file()] for p in logs]
    return {p.parent.name: [read_log(f) for f in s] for p, s in zip(logs, stages, strict=True)}


def views(options: StudyOptions) -> None:
    """Scaling of inference: random views, spread over the clip; scored on four canonical and a random view a frame."""
    result = scored(options, "views", options.counts, lambda seq, n: protocol.inputs(seq, f"views-{n}"), paper_views)
    labels = [m.label for m in options.methods]
    known = [k for k in METRICS if not any(np.isnan(per_object(rows, k)).any() for rows in result.values())]
    shown = [k for k in known if METRICS[k].charted]
    fig, axes = panels(len(shown))
    for ax, metric in zip(axes, shown, strict=True):
        for n, label in enumerate(labels):
            curve = np.stack([per_object(result[c, label], metric) for c in options.counts], 1)
            band(ax, options.counts, curve, label, n)
        ax.set_xscale("log", base=2)
        ax.set_xticks(options.counts, [str(c) for c in options.counts])
        ax.minorticks_off()
        ax.set(xlabel="random input views", ylabel=METRICS[metric].axis)
    axes[0].legend()
    save(fig, options.out / "views", options.made_by.caption)
    head = ["method", "input views", *TITLES]
    rows = [[label, c, *cells(result[c, label])] for label in labels for c in options.counts]
    note = about(options, "Scored: the four canonical views and one random view at every frame.")
    print(write_table(options.out / "views", "Scaling of inference", head, rows, options.made_by, [note]))


def views_per_frame(options: StudyOptions) -> None:
    """One to four random views a frame and the four canonical ones; scored on one novel view a frame."""
    conditions = [("random", n) for n in (1, 2, 3, 4)] + [("canonical", 4)]

    def choose(seq: Sequence, c) -> list[int]:
        return protocol.inputs(seq, f"random-{c[1]}" if c[0] == "random" else "canonical")

    result = scored(options, "views-per-frame", conditions, choose, novel_views)
    head = ["inputs", "views a frame", "model", *TITLES]
    head += ["paper: Objaverse4D PSNR / SSIM", "Consistent4D PSNR / SSIM"]
    rows = []
    for c in conditions:
        rows += [[*c, m.label, *cells(result[c, m.label]), "", ""] for m in options.methods]
        for (*where, model), sets in paper.VIEWS_PER_FRAME.items():
            if tuple(where) == c:
                rows.append([*c, f"paper's {model}", *[""] * len(METRICS), *(f"{p:.2f} / {s:.3f}" for p, _, s in sets)])
    notes = [about(options, "Scored: one novel random view at every frame."), PAPERS]
    print(write_table(options.out / "views-per-frame", "Views per frame", head, rows, options.made_by, notes))


def static(options: StudyOptions) -> None:
    """Single moments: four canonical views of a frame with times set to 0, scored on novel views of it."""

    def moments(seq: Sequence, _) -> list[tuple]:
        frames = range(seq.frame_start, seq.frame_end + 1, options.every)
        rigs = ("canonical",), ("random", "target")
        return [tuple(protocol.at_frame(seq, f, *r) for r in rigs) for f in frames]

    result = scored_parts(options, "static", [""], moments, still=True)
    head = ["model", "pixels", *TITLES]
    rows = [[m.label, options.size, *cells(result["", m.label])] for m in options.methods]
    rows += [[f"paper: {model}, GSO", size, *printed(*x)] for (size, model), x in paper.STATIC.items()]
    what = f"Every {options.every}th frame alone, from its four canonical views; scored: its five random views."
    notes = [about(options, what), PAPERS]
    print(
        write_table(options.out / "static", "Single moments, times collapsed to 0", head, rows, options.made_by, notes)
    )


def video(options: StudyOptions) -> None:
    """A video from the front with the four canonical views of its first frame; scored on all other views."""

    def choose(seq: Sequence, _=None) -> list[int]:
        return protocol.inputs(seq, "video")

    def others(seq: Sequence, _) -> list[int]:
        return protocol.novel(seq, choose(seq), protocol.targets(seq))

    result = scored(options, "video", [""], choose, others)
    rows = [[m.label, *cells(result["", m.label])] for m in options.methods]
    rows += [[f"paper: {model}, Consistent4D", *printed(*x)] for model, x in paper.VIDEO.items()]
    what = "Scored: the canonical views that are no input, and one random view, at every frame."
    note = "The first two of the paper's take the sides of frame 1 from a diffusion model, the last one true ones."
    notes = [about(options, what), PAPERS, note]
    print(write_table(options.out / "video", "Single-view video", ["model", *TITLES], rows, options.made_by, notes))


def frame_rate(options: StudyOptions) -> None:
    """Inputs at every 4th frame, one canonical view each; the frames between are scored against the truth."""

    result = scored(
        options, "frame-rate", [""], lambda seq, _: protocol.every_nth(seq, options.every), novel_views, options.every
    )
    labels = [m.label for m in options.methods]
    rows = []
    for label in labels:
        for seen in (True, False):
            parts = []
            for seq, r in zip(options.subjects.values(), result["", label], strict=True):
                first = seq.frame_start
                here = [((seq.views[i].frame - first) % options.every == 0) == seen for i in novel_views(seq)]
                parts.append({k: [x for x, h in zip(r[k], here, strict=True) if h] for k in METRICS})
            rows.append([label, "seen" if seen else "between", *cells(parts)])
    head = ["method", "times", *TITLES]
    lengths = sorted({s.frame_end - s.frame_start + 1 for s in options.subjects.values()})
    what = f"Clips of {', '.join(map(str, lengths))} frames, one canonical view at every {options.every}th frame as "
    what += "input; scored: one novel view at every frame."
    title = f"Frame rate × {options.every}"
    print(write_table(options.out / "frame-rate", title, head, rows, options.made_by, [about(options, what)]))


def lifetimes(options: StudyOptions) -> None:
    """Where in time the Gaussians are and how long they live, with all frames seen and with every other one."""
    for name, seq in options.subjects.items():
        frames = seq.frame_end - seq.frame_start + 1
        for m in options.methods:
            fig, axes = panels(2, width=4.6)
            for n, setup in enumerate(("alternating", "interpolation")):
                chosen = protocol.inputs(seq, setup)
                g = scene_of(options, seq, chosen, m)
                seen = len({seq.views[i].frame for i in chosen})
                draw_lifetimes(axes, g, frames, f"{setup} ({seen} of {frames} frames)", n)
            axes[0].set(xlabel="$\\mu_t$ (frame)", ylabel="share of Gaussians")
            axes[1].set(xlabel="$\\sigma_t$ (frames)", ylabel="share of Gaussians")
            for ax in axes:
                ax.legend(fontsize=7.5, loc="lower left", bbox_to_anchor=(0, 1), title=f"{name}, {m.label}")
            save(fig, options.out / f"lifetimes-{name.replace('/', '-')}-{m.label}", options.made_by.caption)


def draw_lifetimes(axes, g, frames: int, label: str, n: int) -> None:
    step = 2 / max(frames - 1, 1)
    middle, sigma = ((g.t + 1) / step).numpy(), (g.sigma_t / step).numpy()
    weight = np.full(len(middle), 1 / max(len(middle), 1))
    look = {"color": COLOURS[n], "histtype": "stepfilled", "linewidth": 1.2, "alpha": 0.35}
    edge = look | {"histtype": "step", "alpha": 1.0}
    odd = ((np.round(middle).astype(int) % 2) == 1).mean() if len(middle) else 0.0
    bins, spread = np.arange(-0.5, frames + 0.5), np.arange(0, 8.01, 0.2)
    typical = f"{label}: median {np.median(sigma):.2f}" if len(sigma) else label
    for ax, x, edges, text in (
        (axes[0], middle, bins, f"{label}: {odd:.0%} at odd frames"),
        (axes[1], sigma, spread, typical),
    ):
        x = np.clip(x, edges[0], edges[-1])  # what lies beyond is in the outermost bins
        ax.hist(x, edges, weights=weight, **look)
        ax.hist(x, edges, weights=weight, label=text, **edge)


def pictures(options: StudyOptions) -> None:
    """Truth and methods side by side from novel views at some frames, inputs of one of the setups."""
    for name, seq in options.subjects.items():
        chosen, held_out = protocol.inputs(seq, options.setup), novel_views(seq)
        shown = [held_out[i] for i in np.linspace(0, len(held_out) - 1, options.columns).round().astype(int)]
        truth = load_truth(seq, shown, protocol.novel(seq, chosen, shown), options.size)
        rows = {"truth": truth.picture}
        for m in tqdm(options.methods, desc=name, unit="method", disable=None):
            rows[m.label] = draw(scene_of(options, seq, chosen, m), truth.views)[0]
        frames = [f"frame {seq.views[i].frame:g}" for i in shown]
        stem = options.out / f"pictures-{name.replace('/', '-')}-{options.setup}"
        save_picture(grid(rows, frames), stem, options.made_by.caption)


METHODS = "sweep,predicted"
COUNTS = {"type": numbers, "default": [4, 8, 12, 16, 24, 48, 96], "help": "input views (default: 4,8,…,48,96)"}
EVERY = {"type": int, "default": 4, "metavar": "N", "help": "every N-th frame (default: 4)"}
RUN = {
    "nargs": "+",
    "metavar": "NAME=RUN",
    "help": "run folders of `timesplat train`, NAME=A+B for stages; or a folder that evaluation.ablations filled",
}
WINDOW = {"type": int, "default": 5, "help": "reports that the curves are averaged over (default: 5)"}
SETUP = {"default": "alternating", "help": f"input views: {protocol.FORMS} (default: alternating)"}
COLUMNS = {"type": int, "default": 6, "help": "frames to show (default: 6)"}

# study -> function, its own arguments, its methods by default (None: it takes no Sequences)
STUDIES: dict[str, tuple[Callable, list[tuple[str, dict]], str | None]] = {
    "training": (training, [("runs", RUN), ("--window", WINDOW)], None),
    "views": (views, [("--counts", COUNTS)], METHODS),
    "views-per-frame": (views_per_frame, [], "gs-lrm-frame,sweep,predicted"),
    "static": (static, [("--every", EVERY)], METHODS),
    "video": (video, [], "lift,guided,rgb"),
    "frame-rate": (frame_rate, [("--every", EVERY)], METHODS),
    "lifetimes": (lifetimes, [], "predicted"),
    "pictures": (pictures, [("--setup", SETUP), ("--columns", COLUMNS)], METHODS),
}

if __name__ == "__main__":
    sys.exit(main())
