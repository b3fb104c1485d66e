# SPDX-License-Identifier: GPL-3.0-or-later
"""The paper's training comparisons, brief and under equal conditions: `python -m timesplat.evaluation.ablations`.

Every run is the base run with one thing changed: the same data, seed, rate, steps and core. Runs go one after
another, each as `timesplat train` in a process of its own; finished ones are skipped, interrupted ones go on.
Then each is scored on objects that no run saw, and every finished run below --out makes a row of
`comparisons.md` and `comparisons.csv`. Two lists may run at the same time on two cores into the same --out.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import shlex
import signal
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..datagen.readers import open_sequence, sequences_in
from ..datagen.sequence import InputError, Sequence
from ..datagen.whole_folders import write_whole
from ..exit_codes import exit_code
from . import protocol, runner
from .cache import Cache, name_sequences
from .figures import command_line, write_table
from .method_spec import parse_spec
from .metrics import METRICS
from .provenance import Provenance

BASE = {
    "--shrink": 2,
    "--preset": "tiny",
    "--source": "predicted",
    "--head": "paper",
    "--rate": "1e-3",
    "--targets": 4,
    "--views": 12,
    "--seed": 0,
}
DATA = ("train", "zoo")


@dataclass(frozen=True)
class Run:
    """One row: what differs from BASE. With `first`, half of the steps are a first stage with these options,
    and the second half starts from its weights. `steps` overrides --steps."""

    name: str
    change: str
    options: dict = field(default_factory=dict)
    first: dict | None = None
    data: tuple[str, ...] = DATA
    steps: int | None = None


KINEMATIC = {"--head": "kinematic"}
BRIEF = {"--shrink": 4, "--views": 4, "--targets": 2}
STILL = {"--static": None, "--views": 4}  # of one moment there are six views
RUNS = [
    Run("letter", "the paper's letter at this size: the base run"),
    Run("targets", "target views × 2", {"--targets": 8}),
    Run("hexplane", "HexPlane motion", {"--motion": "hexplane"}),
    Run("aligned", "temporal alignment: μ_t is the view's time", {"--time": "aligned"}),
    Run("free", "64 free Gaussians from scratch", {"--free": 64}),
    Run("static", "initialised from a static (3D) network, half the steps each", first=STILL),
    Run("sweep", "depth swept from the other views, kinematic residual", {"--source": "sweep", **KINEMATIC}),
    Run("given", "depth and motion given, kinematic residual", {"--source": "given", **KINEMATIC}),
    Run("kinematic", "kinematic head", KINEMATIC),
    Run("centred", "centred depth range", {"--depth-range": "centred"}),
    Run("warmup", "point-distance warm-up", {"--geometric": 1.0}),
    Run("opacity", "opacity regularisation", {"--opacity": 0.01}),
    Run("muon", "Muon for the matrices", {"--optimiser": "muon"}),
    Run("zoo", "procedural objects alone", data=("zoo",)),
    Run("low-first", "32² for the first half of the steps", first={"--shrink": 4}),
    Run("base", "Base preset, 32², 4 views: runs and learns", {"--preset": "base", **BRIEF}, steps=40),
    Run("large", "Large preset, 32², 4 views: runs and learns", {"--preset": "large", **BRIEF}, steps=20),
]


@dataclass(frozen=True)
class AblationOptions:
    """What the command is asked for; see `main`."""

    out: Path = Path("out/ablations")
    data: Path = Path("data")
    dev: Path | None = None
    only: str | None = None
    steps: int = 400
    core: int | None = None
    objects: int | None = None
    table: bool = False


def main(argv: list[str] | None = None) -> int:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--out", type=Path, default=Path("out/ablations"), help="run folders and the table")
    p.add_argument("--data", type=Path, default=Path("data"), help="folder with train/, zoo/ and dev/ (default: data)")
    p.add_argument("--dev", type=Path, help="held-out Sequences with a rig `target` (default: DATA/dev)")
    p.add_argument("--only", help=f"comma-separated, of: {', '.join(r.name for r in RUNS)}")
    p.add_argument("--steps", type=int, default=400, help="of every run (default: 400, about 2 CPU-minutes)")
    p.add_argument("--core", type=int, help="pin everything to this core")
    p.add_argument("--objects", type=int, help="score on so many held-out objects (default: all)")
    p.add_argument("--table", action="store_true", help="write the table of what is finished, train nothing")
    options = AblationOptions(**vars(p.parse_args(argv)))
    return exit_code("ablations", lambda: run(options, command_line("timesplat.evaluation.ablations", argv)))


def run(options: AblationOptions, command: str) -> int:
    """Trains what is not yet trained, and writes the table of what is; 2 where a run was skipped, else 0."""
    runs = chosen(options.only)
    environment = dict(os.environ, OMP_NUM_THREADS="1", NUMBA_NUM_THREADS="1", MKL_NUM_THREADS="1")
    if options.core is not None:
        if not hasattr(os, "sched_setaffinity"):
            raise InputError(f"--core {options.core}: this system cannot pin a process to a core; leave it out.")
        if options.core not in os.sched_getaffinity(0):
            raise InputError(f"--core {options.core}: there is no such core for this process.")
        os.sched_setaffinity(0, {options.core})  # the scoring below; children inherit it
    skipped = []
    if not options.table:
        for n, r in enumerate(runs):
            reason = unknown_option(r, options)
            if reason:
                print(f"{r.name}: skipped, `timesplat train` says: {reason}", file=sys.stderr)
                skipped.append(r.name)
                continue
            print(f"[{n + 1}/{len(runs)}] {r.name}: {r.change}", flush=True)
            try:
                train(r, options, environment)
            except InputError as e:  # one broken variant must not cost the night of the others
                print(f"ablations: {e}", file=sys.stderr)
                skipped.append(r.name)
    print(tabulate(options, command))
    return 2 if skipped else 0


def chosen(only: str | None) -> list[Run]:
    if not only:
        return RUNS
    names = [x.strip() for x in only.split(",") if x.strip()]
    by_name = {r.name: r for r in RUNS}
    for x in names:
        if x not in by_name:
            raise InputError(f"--only {x}: no such run; choose from {', '.join(by_name)}.")
    return [by_name[x] for x in names]


# ---------------------------------------------------------------- training


def stages(r: Run, options: AblationOptions) -> list[tuple[Path, list[str]]]:
    """(run folder, arguments of `timesplat train`) of each stage; the last one's weights are scored."""
    steps = r.steps or options.steps
    data = [str(options.data / d) for d in r.data]
    if r.first is None:
        return [(options.out / r.name, arguments(data, options.out / r.name, steps, {**BASE, **r.options}))]
    first, last = options.out / r.name / "first", options.out / r.name
    init = {"--init": first / "network.safetensors"}
    return [
        (first, arguments(data, first, steps // 2, {**BASE, **r.options, **r.first})),
        (last, arguments(data, last, steps - steps // 2, {**BASE, **r.options, **init})),
    ]


def arguments(data: list[str], out: Path, steps: int, options: dict) -> list[str]:
    words = [*data, "--out", str(out), "--steps", str(steps)]
    for k, v in options.items():
        words += [k] if v is None else [k, str(v)]
    return words


def unknown_option(r: Run, options: AblationOptions) -> str | None:
    """What `timesplat train` has against a run's options; None where it takes them."""
    from ..model.training.config import add_arguments

    parser = argparse.ArgumentParser(prog="train")
    add_arguments(parser)
    for _, words in stages(r, options):
        said = io.StringIO()
        try:
            with contextlib.redirect_stderr(said):
                parser.parse_args(words)
        except SystemExit:
            return said.getvalue().strip().splitlines()[-1]
    return None


def train(r: Run, options: AblationOptions, environment: dict) -> None:
    for folder, words in stages(r, options):
        if finished(folder, words):
            continue
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / "command.txt", shlex.join(["timesplat", "train", *words]).encode())
        code = run_child([sys.executable, "-m", "timesplat.cli", "train", *words], environment)
        if code in (130, -signal.SIGINT):
            raise KeyboardInterrupt
        if code:
            raise InputError(f"{r.name}: training ended with code {code}; see above, and start it again.")
        # What an exact resume needs is several times the weights (5 GB for Large) and of no use to a finished run.
        (folder / "state.pt").unlink(missing_ok=True)


def run_child(command: list[str], environment: dict) -> int:
    """Exit code of a process. On Ctrl-C, which reaches the child as well, it is given the time to save."""
    before = signal.signal(signal.SIGINT, lambda *_: None)
    try:
        return subprocess.Popen(command, env=environment).wait()
    finally:
        signal.signal(signal.SIGINT, before)


def finished(folder: Path, words: list[str]) -> bool:
    """Whether a run folder is complete. Raises InputError where it was trained with other arguments."""
    command = folder / "command.txt"
    if command.is_file() and shlex.split(command.read_text())[2:] != words:
        raise InputError(f"{folder}: was trained with other options; delete it, or give another --out.")
    return complete(folder)


def complete(folder: Path) -> bool:
    """Whether a run folder holds the weights of the last step that its command asks for."""
    command, weights = folder / "command.txt", folder / "network.safetensors"
    if not command.is_file() or not weights.is_file():
        return False
    from safetensors import safe_open

    words = shlex.split(command.read_text())
    with safe_open(weights, "pt") as f:
        return int(f.metadata().get("steps", 0)) >= int(words[words.index("--steps") + 1])


# ---------------------------------------------------------------- scores


def tabulate(options: AblationOptions, command: str) -> str:
    """Scores what is finished, and writes the table of everything finished."""
    ready = [r for r in RUNS if all(complete(folder) for folder, _ in stages(r, options))]
    if not ready:
        raise InputError(f"{options.out}: no finished run to make a table of.")
    scores = score(ready, options)
    head = ["run", "what changes", "pixels", "parameters", "steps", "CPU-s", "CPU-s/step"]
    head += ["PSNR", "PSNR fg", f"PSNR − {ready[0].name}", "training PSNR, first report", "last"]
    base = scores[ready[0].name]
    rows = [row(r, options, scores[r.name], base) for r in ready]
    notes = [
        f"PSNR in dB over white, mean ± standard error over {len(base.psnr)} held-out objects (24 alternating "
        "canonical inputs, 24 novel views each); fg: over the pixels that show the object; "
        "the difference is taken object by object. The empty picture "
        f"scores {np.mean(base.white):.2f} and {np.mean(base.white_fg):.2f} at {base.pixels}².",
        "Every run: " + " ".join(f"{k} {v}" for k, v in BASE.items()) + f"; on {' and '.join(DATA)}, one core.",
    ]
    made_by = Provenance.of(command, [weights_of(r, options) for r in ready])
    return write_table(options.out / "comparisons", "Training comparisons", head, rows, made_by, notes)


def weights_of(r: Run, options: AblationOptions) -> Path:
    """The averaged weights of a run's last stage."""
    return stages(r, options)[-1][0] / "network.safetensors"


@dataclass(frozen=True)
class Scores:
    """Of one run, a figure per held-out object, and those of the empty picture."""

    pixels: int
    psnr: list[float]
    psnr_fg: list[float]
    white: list[float]
    white_fg: list[float]


def score(ready: list[Run], options: AblationOptions) -> dict[str, Scores]:
    """{run: Scores} on the held-out Sequences, at the size at which a run was trained; kept in rows.jsonl."""
    held_out = objects(options.dev or options.data / "dev", options.objects)
    runs, at = [], []
    for r in ready:
        source = str({**BASE, **r.options}["--source"])
        method = {"given": "guided", "sweep": "sweep", "predicted": "predicted"}[source]
        shrink = int({**BASE, **r.options}["--shrink"])
        for spec in (parse_spec(f"{r.name}={method}@{weights_of(r, options)}"), parse_spec("white")):
            for name, seq in held_out.items():
                views = (tuple(seq.inputs()), tuple(protocol.held_out(seq)))
                runs.append(runner.Run(name, seq.folder, spec, *views, seq.width // shrink))
                at.append((r.name, spec.label))
    conditions = runner.Conditions(left_out=tuple(k for k in METRICS if k not in ("psnr", "psnr_fg")), one_thread=True)
    rows = runner.run_all(runs, Cache(options.out), conditions, "scoring")
    found: dict[tuple, list[dict]] = {}
    for key, x in zip(at, rows, strict=True):
        found.setdefault(key, []).append(x)

    def figures(name: str, label: str) -> tuple[list[float], list[float]]:
        rows = found[name, label]
        return [x["psnr"] for x in rows], [x["psnr_fg"] for x in rows]

    return {
        r.name: Scores(found[r.name, r.name][0]["size"], *figures(r.name, r.name), *figures(r.name, "white"))
        for r in ready
    }


def objects(folder: Path, limit: int | None) -> dict[str, Sequence]:
    """The held-out Sequences below a folder, by name; each has inputs and views of the rig `target`."""
    found = sequences_in(folder)[:limit]
    if not found:
        raise InputError(f"{folder}: no Sequence in it; render some with `timesplat render`.")
    out = {n: open_sequence(f) for n, f in name_sequences(found).items()}
    for seq in out.values():
        protocol.held_out(seq)
    return out


def row(r: Run, options: AblationOptions, scores: Scores, base: Scores) -> list[str]:
    """`base`: the scores of the first run, from which the others' differ object by object."""
    logs = [read_log(folder) for folder, _ in stages(r, options)]
    steps = sum(log[-1]["step"] for log in logs)
    cpu = sum(log[-1].get("cpu_seconds", log[-1]["seconds"]) for log in logs)

    def mean(x):
        return f"{np.mean(x):.2f} ± {np.std(x, ddof=1) / len(x) ** 0.5:.2f}" if len(x) > 1 else f"{np.mean(x):.2f}"

    cells = [r.name, r.change, f"{scores.pixels}²", f"{parameters(weights_of(r, options)) / 1e6:.2f} M", str(steps)]
    cells += [f"{cpu:.0f}", f"{cpu / steps:.3f}", mean(scores.psnr), mean(scores.psnr_fg)]
    alike = scores.white == base.white  # the same objects at the same size
    cells.append(mean(np.subtract(scores.psnr, base.psnr)) if alike else "–")
    return [*cells, f"{logs[0][0]['psnr']:.2f}", f"{logs[-1][-1]['psnr']:.2f}"]


def read_log(folder: Path) -> list[dict]:
    """The reports of a run, in the order of steps; what an interrupted run reported twice, once."""
    path = folder / "log.jsonl"
    try:
        lines = {x["step"]: x for x in map(json.loads, path.read_text().splitlines())}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give a folder that `timesplat train` wrote.") from None
    except (json.JSONDecodeError, KeyError, TypeError) as e:
        raise InputError(f"{path}: it is damaged ({e!r}).") from None
    if not lines:
        raise InputError(f"{path}: it is empty; train for at least 20 steps.")
    return [lines[k] for k in sorted(lines)]


def parameters(weights: Path) -> int:
    """How many a network has."""
    from safetensors import safe_open

    with safe_open(weights, "pt") as f:
        return sum(int(np.prod(f.get_slice(k).get_shape())) for k in f.keys())  # noqa: SIM118


if __name__ == "__main__":
    sys.exit(main())
