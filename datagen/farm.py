# SPDX-License-Identifier: GPL-3.0-or-later
"""Many assets to Sequences: `timesplat render`.

Each asset is opened and rendered in a child process of its own (`render_asset`, run with a job file), so that one
that crashes Blender or eats the memory never takes the others with it. The child writes its messages as JSON
lines; what Blender prints goes to a log of which the last line is shown if it dies.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue

from . import ASSET_SUFFIXES
from .rigs import RIGS
from .sequence import InputError, Sequence, read_sequence

FIRST, MOST, ALL = "first", "most-moving", "all"


@dataclass(frozen=True)
class Settings:
    """What decides the pictures; recorded in the Sequence, and compared when a run resumes."""

    rig: str = "default"  # a name in rigs.RIGS
    targets: int = 0  # held-out random views a frame
    clip: str = MOST  # "most-moving", "first", "all" or a clip's name
    frames: int = 24
    size: int = 128
    samples: int = 16
    passes: bool = True
    linear: bool = False
    displace: bool = False  # take a still object and move it a little, see `displace`
    seed: int = 0
    device: str = "CPU"

    def __post_init__(self):
        if self.rig not in RIGS:
            raise InputError(f"--rig {self.rig}: there is no such rig; choose one of {', '.join(RIGS)}.")
        for name, low in (("frames", 1), ("size", 8), ("samples", 1), ("targets", 0), ("seed", 0)):
            if getattr(self, name) < low:
                raise InputError(f"--{name} {getattr(self, name)}: too small; give {low} or more.")


def render_assets(
    assets: list[str],
    out: Path,
    settings: Settings | None = None,
    *,
    jobs: int = 1,
    report: Callable[[str], None] = print,
    progress: Callable[[int, int, int], None] = lambda done, total, images: None,
) -> tuple[list[Path], list[str]]:
    """Renders every asset (a file, a folder of files, or "zoo:SEED") to `out/<stem>/<clip>`.

    Returns the folders of all Sequences, those found finished included, and one sentence for each asset that
    failed. `report` gets warnings and failures as they happen, `progress` assets done, in all, and images.
    """
    settings, out = settings or Settings(), Path(out)
    folders, failures, images = [], [], 0
    names = expand(assets)
    todo, seen = [], {}
    for asset in names:
        other = seen.setdefault(stem(asset).lower(), asset)  # one folder for both on Windows and macOS
        if other != asset:
            failures.append(f"{asset}: it would be written over that of {other}; rename one of the two.")
        elif finished := _finished(asset, out / stem(asset), settings):
            folders += finished
        else:
            todo.append(asset)
    for sentence in failures:
        report(sentence)
    done = len(names) - len(todo)
    progress(done, len(names), images)

    jobs = max(1, min(jobs, len(todo)))
    free: SimpleQueue[list[int]] = SimpleQueue()
    for i in range(jobs):  # one core each: twice as efficient as threads that wait for each other
        free.put([cores()[i % len(cores())]] if jobs > 1 else [])
    events: SimpleQueue[tuple[str, dict | None]] = SimpleQueue()
    running: set[subprocess.Popen] = set()

    def work(asset: str) -> None:
        core = free.get()
        job = {"asset": asset, "out": str(out / stem(asset)), "settings": asdict(settings), "cores": core}
        try:
            _child(job, lambda message: events.put((asset, message)), running)
        finally:
            free.put(core)
            events.put((asset, None))

    with ThreadPoolExecutor(jobs) as pool:
        try:
            for asset in todo:
                pool.submit(work, asset)
            left = len(todo)
            while left:
                asset, message = events.get()
                if message is None:
                    left, done = left - 1, done + 1
                elif "written" in message:
                    folders.append(Path(message["written"]))
                elif "image" in message:
                    images += message["image"]
                elif "warning" in message:
                    report(message["warning"])
                else:
                    failures.append(message["error"])
                    report(message["error"])
                progress(done, len(names), images)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in list(running):
                process.kill()
            raise
    return folders, failures


def render_shots(
    asset: str,
    folder: Path,
    setup: str,
    settings: Settings | None = None,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Sequence:
    """One clip of one asset (a file or "zoo:SEED") into exactly `folder`, in a child process: the views of
    the setup or rig `setup`, and `settings.targets` held-out views a frame (rig "target"). Returns the
    Sequence; raises InputError with the sentence that says what went wrong."""
    settings = Settings(**{**asdict(settings or Settings(targets=1)), "rig": setup})
    if settings.clip == ALL:
        raise InputError("--clip all: one clip is wanted here; give its name, first or most-moving.")
    errors, images = [], 0

    def on(message: dict) -> None:
        nonlocal images
        if "error" in message:
            errors.append(message["error"])
        elif "image" in message:
            images += message["image"]
            progress(images, message["of"])

    job = {"asset": str(asset), "folder": str(folder), "settings": asdict(settings), "cores": []}
    _child(job, on, set())
    if errors:
        raise InputError(errors[0])
    return read_sequence(Path(folder))


def expand(assets: list[str]) -> list[str]:
    """Folders -> the assets in them, sorted; files and "zoo:SEED" stay. InputError for an empty folder."""
    found = []
    for asset in map(str, assets):
        path = Path(asset)
        if path.is_dir():
            files = [Path(root, name) for root, _, names in os.walk(path) for name in names]
            inside = sorted(str(f) for f in files if f.suffix.lower() in ASSET_SUFFIXES)
            if not inside:
                raise InputError(f"{path}: there is no asset in this folder; {', '.join(ASSET_SUFFIXES)} are read.")
            found += inside
        else:
            found.append(asset)
    return list(dict.fromkeys(found))


def cores() -> list[int]:
    """The processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def stem(asset: str) -> str:
    """The name of an asset's folder."""
    if seed := zoo_seed(asset):
        return f"zoo-{int(seed):06d}"
    return Path(asset).stem


def zoo_seed(asset: str) -> str | None:
    """The digits of "zoo:SEED", None for a file."""
    match = re.fullmatch(r"zoo:(\d+)", asset)
    return match[1] if match else None


def is_made(folder: Path, asset: str, settings: Settings) -> int:
    """How many clips the run had that made this Sequence, if it is whole and shows this very asset with
    these settings; else 0."""
    try:
        made = read_sequence(folder).provenance
        same = made["settings"] == asdict(settings) and made["asset"] == Path(asset).name
        if same and not zoo_seed(asset):
            same = made["sha256"] == hashlib.sha256(Path(asset).read_bytes()).hexdigest()
        return made["clips"] if same else 0
    except (InputError, KeyError, OSError):
        return 0


def _finished(asset: str, folder: Path, settings: Settings) -> list[Path]:
    """The Sequences of this asset with these settings, if all its clips are there and whole; else none."""
    folders = [file.parent for file in sorted(folder.glob("*/transforms.json"))]
    found = {f: clips for f in folders if (clips := is_made(f, asset, settings))}
    return list(found) if found and len(found) == max(found.values()) else []


def _sweep(job: dict) -> None:
    """Removes what a killed child left half-written: `write_sequence` works in a hidden folder."""
    if "folder" in job:
        folder = Path(job["folder"])
        left = folder.parent.glob(f".{folder.name}.*")
    else:
        left = Path(job["out"]).glob(".*")
    for half in left:
        shutil.rmtree(half, ignore_errors=True)


def _child(job: dict, on: Callable[[dict], None], running: set) -> None:
    """Runs one job in a child process and passes on its messages; its death is a message too."""
    with tempfile.TemporaryDirectory(prefix="timesplat-", ignore_cleanup_errors=True) as tmp:
        file, log = Path(tmp) / "job.json", Path(tmp) / "log"
        file.write_text(json.dumps(job))
        command = [sys.executable, "-m", "timesplat.datagen.render_asset", str(file), str(log)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True)
        running.add(process)
        said_error = False
        try:
            for line in process.stdout:
                message = json.loads(line)
                said_error |= "error" in message
                on(message)
            code = process.wait()
        finally:
            process.kill()
            process.wait()
            running.discard(process)
            _sweep(job)
        if code and not said_error:
            reason = f"signal {-code}" if code < 0 else f"exit code {code}"
            lines = log.read_text("utf-8", errors="replace").strip().splitlines() if log.exists() else []
            last = f", last line: {lines[-1][:200]}" if lines else ""
            on({"error": f"{job['asset']}: Blender died on it ({reason}{last}); repair or leave out the file."})


# ---------------------------------------------------------------- the command line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `timesplat render`."""
    d = Settings()
    parser.add_argument("assets", nargs="*", metavar="ASSET", help=f"files or folders: {' '.join(ASSET_SUFFIXES)}")
    parser.add_argument("--out", required=True, type=Path, help="folder for the Sequences")
    parser.add_argument("--zoo", metavar="SEEDS", help="also procedural objects, for example 0-99 or 3,7,10-12")
    parser.add_argument("--rig", default=d.rig, choices=list(RIGS), help="cameras (default: %(default)s)")
    parser.add_argument("--targets", type=int, default=d.targets, metavar="N", help="held-out views a frame")
    parser.add_argument("--clip", default=d.clip, help="most-moving (default), first, all, or a clip's name")
    parser.add_argument("--frames", type=int, default=d.frames, help="length of a clip (%(default)s)")
    parser.add_argument("--size", type=int, default=d.size, help="pixels (%(default)s)")
    parser.add_argument("--samples", type=int, default=d.samples, help="samples a pixel (%(default)s)")
    parser.add_argument("--no-passes", dest="passes", action="store_false", help="no depth, no motion vectors")
    parser.add_argument("--linear", action="store_true", help="also the scene-linear picture, in the passes' EXR")
    parser.add_argument("--displace", action="store_true", help="still objects, moved a little along a line")
    parser.add_argument("--seed", type=int, default=d.seed)
    parser.add_argument("--device", default=d.device, choices=["CPU", "GPU"])
    parser.add_argument("--jobs", type=int, default=len(cores()), metavar="N", help="assets at a time (%(default)s)")


def run(args: argparse.Namespace) -> int:
    """`timesplat render`: 0 if all went well, 2 if an asset failed. InputError where nothing can start."""
    from tqdm import tqdm

    assets = [*args.assets, *(f"zoo:{s}" for s in parse_seeds(args.zoo))]
    if not assets:
        raise InputError("render: there is nothing to render; give an asset, a folder, or --zoo 0-9.")
    settings = Settings(**{name: getattr(args, name) for name in asdict(Settings())})
    with tqdm(total=0, unit="asset", disable=None) as bar:

        def progress(done: int, total: int, images: int) -> None:
            bar.total, bar.n = total, done
            bar.set_postfix_str(f"{images} images")

        def report(sentence: str) -> None:
            bar.write(sentence, file=sys.stderr)

        folders, failures = render_assets(assets, args.out, settings, jobs=args.jobs, report=report, progress=progress)
    print(f"{len(folders)} sequences in {args.out}" + (f", {len(failures)} failed" if failures else ""))
    return 2 if failures else 0


def parse_seeds(text: str | None) -> list[int]:
    """ "0-9,20" -> [0, …, 9, 20]. InputError for anything else."""
    seeds: list[int] = []
    for part in (text or "").split(","):
        match = re.fullmatch(r"\s*(\d+)(?:-(\d+))?\s*", part)
        if match:
            seeds += range(int(match[1]), int(match[2] or match[1]) + 1)
        elif text:
            raise InputError(f"--zoo {text}: not a list of seeds; write for example 0-99 or 3,7,10-12.")
    return seeds
