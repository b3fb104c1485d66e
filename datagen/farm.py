# SPDX-License-Identifier: GPL-3.0-or-later
"""Many assets to Sequences: `timesplat render`.

Each asset is opened and rendered in a child process of its own (`render_asset`, run with a job file), so that one
that crashes Blender or eats the memory never takes the others with it. The child writes its messages as JSON
lines; what Blender prints goes to a log of which the last line is shown if it dies.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from queue import SimpleQueue

from . import ASSET_SUFFIXES
from .render_job import ALL_CLIPS, CLIPS, Asset, RenderSettings, finished_sequences, list_assets
from .rigs import RIGS
from .sequence import InputError, Sequence, read_sequence


def render_assets(
    assets: list[str],
    out: Path,
    settings: RenderSettings | None = None,
    *,
    root: Path | None = None,
    jobs: int = 1,
    report: Callable[[str], None] = print,
    progress: Callable[[int, int, int], None] = lambda done, total, images: None,
) -> tuple[list[Path], list[str]]:
    """Renders every asset (a file, a folder of files, or "zoo:SEED") to `out/<name>/<clip>`, `jobs` at a time. Names
    are those of `list_assets`; below `root` (by default the folder given, or a file's own) paths in files may lead.

    Returns the folders of all Sequences, those found finished included, and one sentence for each asset that
    failed. `report` gets warnings and failures as they happen, `progress` assets done, in all, and images.
    """
    settings, out = settings or RenderSettings(), Path(out)
    listed = list_assets(assets, root)
    pending, folders, failures = _sort_out(listed, out, settings)
    for sentence in failures:
        report(sentence)
    done, images = len(listed) - len(pending), 0
    progress(done, len(listed), images)

    with _Farm(out, settings, max(1, min(jobs, len(pending)))) as farm:
        for message in farm.render(pending):
            if message is None:
                done += 1
            elif "written" in message:
                folders.append(Path(message["written"]))
            elif "image" in message:
                images += message["image"]
            elif "warning" in message:
                report(message["warning"])
            else:
                failures.append(message["error"])
                report(message["error"])
            progress(done, len(listed), images)
    return folders, failures


def _sort_out(assets: list[Asset], out: Path, settings: RenderSettings) -> tuple[list[Asset], list[Path], list[str]]:
    """Assets still to render, folders of Sequences that are finished, and a sentence for each asset that another one
    of the same name would overwrite."""
    pending, finished, failures, seen = [], [], [], {}
    for asset in assets:
        other = seen.setdefault(asset.name.lower(), asset)  # one folder for both on Windows and macOS
        if other != asset:
            remedy = "rename one of the two, or give a --root that holds both, for names are paths below it"
            failures.append(f"{asset.path}: it would be written over that of {other.path}; {remedy}.")
        elif folders := finished_sequences(out / asset.name, asset, settings):
            finished += folders
        else:
            pending.append(asset)
    return pending, finished, failures


class _Farm:
    """Child processes, so many at a time. As a context: an exception inside kills those that run."""

    def __init__(self, out: Path, settings: RenderSettings, jobs: int) -> None:
        self.out, self.settings = out, settings
        self.pool = ThreadPoolExecutor(jobs)
        self.running: set[subprocess.Popen] = set()
        self.messages: SimpleQueue[dict | None] = SimpleQueue()
        self.free_cores: SimpleQueue[list[int]] = SimpleQueue()
        for i in range(jobs):  # one core each: twice as efficient as threads that wait for each other
            self.free_cores.put([cores()[i % len(cores())]] if jobs > 1 else [])

    def __enter__(self) -> _Farm:
        return self

    def __exit__(self, kind, error, traceback) -> None:
        if kind:
            self.pool.shutdown(wait=False, cancel_futures=True)
            for process in list(self.running):
                process.kill()
        self.pool.shutdown()

    def render(self, assets: list[Asset]) -> Iterator[dict | None]:
        """The messages of all children as they come (see `render_asset`); None once for each asset, its last."""
        for asset in assets:
            self.pool.submit(self._render_one, asset)
        unfinished = len(assets)
        while unfinished:
            message = self.messages.get()
            if message is None:
                unfinished -= 1
            yield message

    def _render_one(self, asset: Asset) -> None:
        own_cores = self.free_cores.get()
        out, settings = str(self.out / asset.name), asdict(self.settings)
        try:
            job = {"asset": asdict(asset), "out": out, "settings": settings, "cores": own_cores}
            _run_child(job, self.messages.put, self.running)
        finally:
            self.free_cores.put(own_cores)
            self.messages.put(None)


def render_shots(
    asset: str,
    folder: Path,
    setup: str,
    settings: RenderSettings | None = None,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Sequence:
    """One clip of one asset (a file or "zoo:SEED") into exactly `folder`, in a child process: the views of
    the setup or rig `setup`, and `settings.targets` held-out views a frame (rig "target"). Returns the
    Sequence; raises InputError with the sentence that says what went wrong."""
    settings = RenderSettings(**{**asdict(settings or RenderSettings(targets=1)), "rig": setup})
    if settings.clip == ALL_CLIPS:
        raise InputError("--clip all: one clip is wanted here; give its name, first or most-moving.")
    errors, images = [], 0

    def receive(message: dict) -> None:
        nonlocal images
        if "error" in message:
            errors.append(message["error"])
        elif "image" in message:
            images += message["image"]
            progress(images, message["of"])

    (one,) = list_assets([str(asset)])
    job = {"asset": asdict(one), "folder": str(folder), "settings": asdict(settings), "cores": []}
    _run_child(job, receive, set())
    if errors:
        raise InputError(errors[0])
    return read_sequence(Path(folder))


def cores() -> list[int]:
    """The processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def _remove_half_written(job: dict) -> None:
    """Removes what a killed child left behind: `write_sequence` works in a hidden folder."""
    if "folder" in job:
        folder = Path(job["folder"])
        hidden = folder.parent.glob(f".{folder.name}.*")
    else:
        hidden = Path(job["out"]).glob(".*")
    for path in hidden:
        shutil.rmtree(path, ignore_errors=True)


def _run_child(job: dict, receive: Callable[[dict], None], running: set[subprocess.Popen]) -> None:
    """Runs one job in a child process, which is in `running` meanwhile, and passes on its messages; its death is a
    message too."""
    with tempfile.TemporaryDirectory(prefix="timesplat-", ignore_cleanup_errors=True) as tmp:
        job_file, log = Path(tmp) / "job.json", Path(tmp) / "log"
        job_file.write_text(json.dumps(job))
        command = [sys.executable, "-m", "timesplat.datagen.render_asset", str(job_file), str(log)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True)
        running.add(process)
        said_error = False
        try:
            for line in process.stdout:
                message = json.loads(line)
                said_error |= "error" in message
                receive(message)
            code = process.wait()
        finally:
            process.kill()
            process.wait()
            running.discard(process)
            _remove_half_written(job)
        if code and not said_error:
            reason = f"signal {-code}" if code < 0 else f"exit code {code}"
            lines = log.read_text("utf-8", errors="replace").strip().splitlines() if log.exists() else []
            last = f", last line: {lines[-1][:200]}" if lines else ""
            receive(
                {"error": f"{job['asset']['path']}: Blender died on it ({reason}{last}); repair or leave out the file."}
            )


# ---------------------------------------------------------------- the command line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `timesplat render`."""
    defaults = RenderSettings()
    parser.add_argument("assets", nargs="*", metavar="ASSET", help=f"files or folders: {' '.join(ASSET_SUFFIXES)}")
    parser.add_argument("--out", required=True, type=Path, help="folder for the Sequences")
    parser.add_argument("--root", type=Path, metavar="FOLDER", help="paths in files may lead below it, and names "
                        "are the paths below it (default: the folder given; a file's own)")  # fmt: skip
    parser.add_argument("--zoo", metavar="SEEDS", help="also procedural objects, for example 0-99 or 3,7,10-12")
    parser.add_argument("--rig", default=defaults.rig, choices=list(RIGS), help="cameras (default: %(default)s)")
    parser.add_argument("--targets", type=int, default=defaults.targets, metavar="N", help="held-out views a frame")
    parser.add_argument("--clip", default=defaults.clip, help="most-moving (default), first, all, or a clip's name")
    parser.add_argument("--clips", default=defaults.clips, choices=CLIPS, help="of a long animation the first frames "
                        "(default), or all of it in consecutive clips")  # fmt: skip
    parser.add_argument("--start", type=int, default=defaults.start, metavar="N", help="pass over so many frames")
    parser.add_argument("--every", type=int, default=defaults.every, metavar="N", help="take each Nth frame")
    parser.add_argument("--spread", action="store_true", help="spread the frames evenly over the whole animation")
    parser.add_argument("--frames", type=int, default=defaults.frames, help="length of a clip (%(default)s)")
    parser.add_argument("--size", type=int, default=defaults.size, help="pixels (%(default)s)")
    parser.add_argument("--samples", type=int, default=defaults.samples, help="samples a pixel (%(default)s)")
    parser.add_argument("--no-passes", dest="passes", action="store_false", help="no depth, no motion vectors")
    parser.add_argument("--linear", action="store_true", help="also the scene-linear picture, in the passes' EXR")
    parser.add_argument("--tracks", default=defaults.tracks, metavar="N", help="surface points: auto, none or so many")
    parser.add_argument("--displace", action="store_true", help="still objects, moved a little along a line")
    parser.add_argument("--seed", type=int, default=defaults.seed)
    parser.add_argument("--device", default=defaults.device, choices=["CPU", "GPU"])
    parser.add_argument("--jobs", type=int, default=len(cores()), metavar="N", help="assets at a time (%(default)s)")


def run(args: argparse.Namespace) -> int:
    """`timesplat render`: 0 if all went well, 2 if an asset failed. InputError where nothing can start."""
    from tqdm import tqdm

    assets = [*args.assets, *(f"zoo:{s}" for s in parse_seeds(args.zoo))]
    if not assets:
        raise InputError("render: there is nothing to render; give an asset, a folder, or --zoo 0-9.")
    settings = RenderSettings(**{name: getattr(args, name) for name in asdict(RenderSettings())})
    with tqdm(total=0, unit="asset", disable=None) as bar:

        def progress(done: int, total: int, images: int) -> None:
            bar.total, bar.n = total, done
            bar.set_postfix_str(f"{images} images")

        def report(sentence: str) -> None:
            bar.write(sentence, file=sys.stderr)

        folders, failures = render_assets(
            assets, args.out, settings, root=args.root, jobs=args.jobs, report=report, progress=progress
        )
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
