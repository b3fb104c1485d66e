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
Methods are written [LABEL=]METHOD[@CHECKPOINT], with commas between. Figures come as SVG and PNG, tables as
Markdown and CSV, each with its command. Scores are kept in OUT/scores.json: an interrupted study goes on.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from tqdm import tqdm

from ..datagen.sequence import InputError
from . import paper, protocol
from .ablations import RUNS, read_log
from .figures import COLOURS, band, command_line, panels, save, save_picture, smooth, write_table
from .subjects import METRICS, RENDER, Scores, Subject, at_frame, every, methods, reconstruct, subjects


def main(argv: list[str] | None = None) -> int:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = p.add_subparsers(dest="study", required=True, metavar="STUDY")
    for name, (run, arguments, default) in STUDIES.items():
        sub = commands.add_parser(name, help=run.__doc__, description=run.__doc__)
        sub.set_defaults(run=run)
        sub.add_argument("--out", type=Path, default=Path("out/studies"), help="folder (default: out/studies)")
        if default:
            sub.add_argument("folders", nargs="+", type=Path, metavar="SEQUENCES", help="folders of Sequences")
            sub.add_argument("--methods", default=default, help=f"[LABEL=]METHOD[@CHECKPOINT],… (default: {default})")
            sub.add_argument("--size", type=int, default=128, help="pixels, by averaging (default: 128)")
        for words, options in arguments:
            sub.add_argument(words, **options)
    args = p.parse_args(argv)
    try:
        if args.study != "training":
            args.methods = methods(args.methods)
            args.subjects = subjects(args.folders, args.size)
        args.run(args, command_line("timesplat.evaluation.studies", argv))
    except InputError as e:
        print(f"studies: {e}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("studies: stopped; what is scored is kept, and the same command goes on.", file=sys.stderr)
        return 130
    except ModuleNotFoundError as e:
        if e.name != "matplotlib":
            raise
        print("studies: matplotlib is not installed; pip install 'timesplat[figures]'.", file=sys.stderr)
        return 2
    return 0


def numbers(text: str) -> list[int]:
    try:
        return sorted({int(x) for x in text.split(",")})
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}: whole numbers with commas between, please") from None


def scored(args, study: str, conditions: list, choose: Callable, targets: Callable, **how) -> dict:
    """Every method on every object in every condition -> {(condition, label): [scores per object]}.
    choose(subject, condition) and targets(subject, condition) give indices of views, or a list of such lists
    (moments, each reconstructed alone, whose scores are joined) with `still`. how: see `score`."""
    scores = Scores(args.out / "scores.json")
    plan = [(s, c, choose(s, c), targets(s, c)) for s in args.subjects for c in conditions]  # bad input shows at once
    out: dict = {}
    bar = tqdm(total=len(plan) * len(args.methods), desc=study, unit="run", disable=None)
    for s, c, inputs, held_out in plan:
        for m in args.methods:
            bar.set_postfix_str(f"{s.name} {m.label} {c}")
            parts = zip(inputs, held_out, strict=True) if how.get("still") else [(inputs, held_out)]
            rows = [scores.of(study, s, m, i, t, **how) for i, t in parts]
            out.setdefault((c, m.label), []).append({k: [x for r in rows for x in r[k]] for k in METRICS})
            bar.update()
    bar.close()
    return out


def paper_views(s: Subject, _=None) -> list[int]:
    """What the paper scores: the four canonical views and a random one at every frame."""
    return protocol.targets(s.seq)


def novel_views(s: Subject, _=None) -> list[int]:
    """One novel random view at every frame."""
    found = s.seq.select(rig="target")
    if not found:
        raise InputError(f"{s.seq.root}: no held-out views to score; {RENDER}.")
    return found


def per_object(rows: list[dict], metric: str) -> np.ndarray:
    """(objects,) means over the views that have a figure; NaN where none has."""
    values = [[x for x in r[metric] if x is not None] for r in rows]
    return np.array([np.mean(v) if v else np.nan for v in values])


def cells(rows: list[dict]) -> list[str]:
    """Mean over objects ± standard error of each metric; – where there is none."""
    out = []
    for k, (_, decimals) in METRICS.items():
        x = per_object(rows, k)
        error = f" ± {x.std(ddof=1) / len(x) ** 0.5:.{decimals}f}" if len(x) > 1 else ""
        out.append("–" if np.isnan(x).any() else f"{x.mean():.{decimals}f}{error}")
    return out


def printed(psnr: float, lpips: float, similarity: float) -> list[str]:
    """What the paper prints, in the columns of METRICS."""
    known = {"psnr": psnr, "lpips": lpips, "ssim": similarity}
    return [f"{known[k]:.{decimals}f}" if k in known else "" for k, (_, decimals) in METRICS.items()]


def about(args, what: str) -> str:
    names = [s.name for s in args.subjects]
    return (
        f"{what} Mean ± standard error over {len(names)} objects ({', '.join(names)}), {args.size}², over white; fg: "
        "over the pixels that show the object."
    )


TITLES = [title for title, _ in METRICS.values()]
PAPERS = "Rows and columns marked as the paper's are what it prints: its data, its training, 256² unless said."


# ---------------------------------------------------------------- studies


def training(args, command: str) -> None:
    """Scaling of training: PSNR of the training samples against steps and CPU-seconds, of several runs."""
    runs = {}
    for word in args.runs:
        name, _, folders = word.rpartition("=")
        if name:
            runs[name] = [read_log(Path(f)) for f in folders.split("+")]
        else:
            runs |= comparisons(Path(word))
    fig, axes = panels(2, width=4.8, height=3.6)
    seconds = "CPU-seconds"
    for n, (name, logs) in enumerate(runs.items()):
        step, spent, psnr = [], [], []
        for log in logs:  # the stages of a run, one after the other
            s0, c0 = (step[-1], spent[-1]) if step else (0, 0.0)
            step += [s0 + x["step"] for x in log]
            spent += [c0 + x.get("cpu_seconds", x["seconds"]) for x in log]
            psnr += [x["psnr"] for x in log]
            seconds = seconds if "cpu_seconds" in log[-1] else "seconds"
        look = {"color": COLOURS[n % len(COLOURS)], "linestyle": ["-", "--", ":"][n // len(COLOURS) % 3]}
        for ax, x in zip(axes, (step, spent), strict=True):
            ax.plot(x, psnr, linewidth=0.5, alpha=0.25, **look)
            ax.plot(x, smooth(psnr, args.window), linewidth=1.6, label=name, **look)
    axes[0].set(xlabel="training steps", ylabel="PSNR of training targets (dB)")
    axes[1].set(xlabel=seconds, ylabel="PSNR of training targets (dB)")
    axes[1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(fig, args.out / "training", command)


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


def views(args, command: str) -> None:
    """Scaling of inference: random views, spread over the clip; scored on four canonical and a random view a frame."""
    result = scored(args, "views", args.counts, lambda s, n: protocol.inputs(s.seq, f"views-{n}"), paper_views)
    labels = [m.label for m in args.methods]
    known = [k for k in METRICS if not any(np.isnan(per_object(rows, k)).any() for rows in result.values())]
    shown = [k for k in known if k != "psnr_fg"]
    fig, axes = panels(len(shown))
    for ax, metric in zip(axes, shown, strict=True):
        for n, label in enumerate(labels):
            curve = np.stack([per_object(result[c, label], metric) for c in args.counts], 1)
            band(ax, args.counts, curve, label, n)
        ax.set_xscale("log", base=2)
        ax.set_xticks(args.counts, [str(c) for c in args.counts])
        ax.minorticks_off()
        ax.set(xlabel="random input views", ylabel=METRICS[metric][0])
    axes[0].legend()
    save(fig, args.out / "views", command)
    head = ["method", "input views", *TITLES]
    rows = [[label, c, *cells(result[c, label])] for label in labels for c in args.counts]
    note = about(args, "Scored: the four canonical views and one random view at every frame.")
    print(write_table(args.out / "views", "Scaling of inference", head, rows, command, [note]))


def views_per_frame(args, command: str) -> None:
    """One to four random views a frame and the four canonical ones; scored on one novel view a frame."""
    conditions = [("random", n) for n in (1, 2, 3, 4)] + [("canonical", 4)]

    def choose(s: Subject, c) -> list[int]:
        return protocol.inputs(s.seq, f"random-{c[1]}" if c[0] == "random" else "canonical")

    result = scored(args, "views-per-frame", conditions, choose, novel_views)
    head = ["inputs", "views a frame", "model", *TITLES]
    head += ["paper: Objaverse4D PSNR / SSIM", "Consistent4D PSNR / SSIM"]
    rows = []
    for c in conditions:
        rows += [[*c, m.label, *cells(result[c, m.label]), "", ""] for m in args.methods]
        for (*where, model), sets in paper.VIEWS_PER_FRAME.items():
            if tuple(where) == c:
                rows.append([*c, f"paper's {model}", *[""] * len(METRICS), *(f"{p:.2f} / {s:.3f}" for p, _, s in sets)])
    notes = [about(args, "Scored: one novel random view at every frame."), PAPERS]
    print(write_table(args.out / "views-per-frame", "Views per frame", head, rows, command, notes))


def static(args, command: str) -> None:
    """Single moments: four canonical views of a frame with times set to 0, scored on novel views of it."""

    def moments(*rigs: str):
        return lambda s, _: [at_frame(s, f, *rigs) for f in s.frames[:: args.every]]

    result = scored(args, "static", [""], moments("canonical"), moments("random", "target"), still=True)
    head = ["model", "pixels", *TITLES]
    rows = [[m.label, args.size, *cells(result["", m.label])] for m in args.methods]
    rows += [[f"paper: {model}, GSO", size, *printed(*x)] for (size, model), x in paper.STATIC.items()]
    what = f"Every {args.every}th frame alone, from its four canonical views; scored: its five random views."
    notes = [about(args, what), PAPERS]
    print(write_table(args.out / "static", "Single moments, times collapsed to 0", head, rows, command, notes))


def video(args, command: str) -> None:
    """A video from the front with the four canonical views of its first frame; scored on all other views."""

    def choose(s: Subject, _=None) -> list[int]:
        return protocol.inputs(s.seq, "video")

    result = scored(args, "video", [""], choose, lambda s, _: protocol.novel(s.seq, choose(s), protocol.targets(s.seq)))
    rows = [[m.label, *cells(result["", m.label])] for m in args.methods]
    rows += [[f"paper: {model}, Consistent4D", *printed(*x)] for model, x in paper.VIDEO.items()]
    what = "Scored: the canonical views that are no input, and one random view, at every frame."
    note = "The first two of the paper's take the sides of frame 1 from a diffusion model, the last one true ones."
    notes = [about(args, what), PAPERS, note]
    print(write_table(args.out / "video", "Single-view video", ["model", *TITLES], rows, command, notes))


def frame_rate(args, command: str) -> None:
    """Inputs at every 4th frame, one canonical view each; the frames between are scored against the truth."""

    result = scored(args, "frame-rate", [""], lambda s, _: every(s, args.every), novel_views, step=args.every)
    labels = [m.label for m in args.methods]
    rows = []
    for label in labels:
        for seen in (True, False):
            parts = []
            for s, r in zip(args.subjects, result["", label], strict=True):
                first = s.seq.frame_start
                here = [((s.seq.views[i].frame - first) % args.every == 0) == seen for i in novel_views(s)]
                parts.append({k: [x for x, h in zip(r[k], here, strict=True) if h] for k in METRICS})
            rows.append([label, "seen" if seen else "between", *cells(parts)])
    head = ["method", "times", *TITLES]
    lengths = sorted({len(s.frames) for s in args.subjects})
    what = (
        f"Clips of {', '.join(map(str, lengths))} frames, one canonical view at every {args.every}th frame as input; "
    )
    what += "scored: one novel view at every frame."
    title = f"Frame rate × {args.every}"
    print(write_table(args.out / "frame-rate", title, head, rows, command, [about(args, what)]))


def lifetimes(args, command: str) -> None:
    """Where in time the Gaussians are and how long they live, with all frames seen and with every other one."""
    for s in args.subjects:
        for m in args.methods:
            fig, axes = panels(2, width=4.6)
            for n, setup in enumerate(("alternating", "interpolation")):
                chosen = protocol.inputs(s.seq, setup)
                g = reconstruct(s.views(chosen, m), m)
                seen = len({s.seq.views[i].frame for i in chosen})
                label = f"{setup} ({seen} of {len(s.frames)} frames)"
                draw_lifetimes(axes, g, len(s.frames), label, n)
            axes[0].set(xlabel="$\\mu_t$ (frame)", ylabel="share of Gaussians")
            axes[1].set(xlabel="$\\sigma_t$ (frames)", ylabel="share of Gaussians")
            for ax in axes:
                ax.legend(fontsize=7.5, loc="lower left", bbox_to_anchor=(0, 1), title=f"{s.name}, {m.label}")
            save(fig, args.out / f"lifetimes-{s.name.replace('/', '-')}-{m.label}", command)


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


def pictures(args, command: str) -> None:
    """Truth and methods side by side from novel views at some frames, inputs of one of the setups."""
    from .evaluate import draw
    from .pictures import grid

    for s in args.subjects:
        chosen, held_out = protocol.inputs(s.seq, args.setup), novel_views(s)
        shown = [held_out[i] for i in np.linspace(0, len(held_out) - 1, args.columns).round().astype(int)]
        truth = s.truth(chosen, shown)
        rows = {"truth": truth.picture}
        for m in tqdm(args.methods, desc=s.name, unit="method", disable=None):
            rows[m.label] = draw(reconstruct(s.views(chosen, m), m), truth.views)[0]
        frames = [f"frame {s.seq.views[i].frame}" for i in shown]
        save_picture(grid(rows, frames), args.out / f"pictures-{s.name.replace('/', '-')}-{args.setup}", command)


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
STUDIES = {
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
