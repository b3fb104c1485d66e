# SPDX-License-Identifier: GPL-3.0-or-later
"""Many assets to Sequences: `timesplat render`.

Each asset is opened and rendered in a child process of its own (`render_child`), so that one that crashes Blender,
never ends or eats the memory takes no other with it. What became of each stands in the run's table (`render_index`).
"""

from __future__ import annotations

import argparse
import contextlib
import re
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from .. import __version__
from . import ASSET_SUFFIXES
from .licences import Licences, Terms, read_licences
from .ray_pool import LOCAL, RayPool
from .render_child import Limits, remove_half_written, run_child
from .render_index import (
    REFUSED,
    Row,
    failure_row,
    forget_failure,
    keep_failure,
    kept_failure,
    needed,
    sequence_row,
    set_terms,
    table_of,
    write_index,
)
from .render_job import ALL_CLIPS, CLIPS, Asset, Part, RenderSettings, file_sha256, list_assets, rendered_sequences
from .render_pool import LocalPool, cores
from .rigs import RIGS
from .sequence import InputError, Sequence, read_sequence


def render_assets(
    assets: list[str],
    out: Path,
    settings: RenderSettings | None = None,
    *,
    root: Path | None = None,
    part: Part | None = None,
    jobs: int = 1,
    ray: str | None = None,
    limits: Limits | None = None,
    licences: Licences | None = None,
    retry: bool = True,
    report: Callable[[str], None] = print,
    progress: Callable[[int, int, int], None] = lambda done, total, images: None,
) -> tuple[list[Path], list[str]]:
    """Renders every asset (a file, a folder of files, or "zoo:SEED") to `out/<name>/<clip>`, `jobs` at a time, and
    writes the table of all of them (`render_index`). Names are those of `list_assets`; below `root` (by default the
    folder given, or a file's own) paths in files may lead. An asset that goes beyond `limits` is given up; `licences`
    go into the Sequences. ray: the address of a Ray cluster that renders in place of this machine, LOCAL for one of
    `jobs` cores here; as many at a time as it has cores. part: of all these assets only those in it, whose table is one
    of its own. retry False: what failed in an earlier run, under the same settings and limits, is not tried again.

    Returns the folders of all Sequences, those found finished included, and one sentence for each asset that
    failed. `report` gets warnings and failures as they happen, `progress` assets done, in all, and images.
    """
    needed()
    settings, out = settings or RenderSettings(), Path(out)
    run = _Run(out, settings, limits or Limits(), licences or Licences())
    listed = [asset for asset in list_assets(assets, root) if part is None or part.holds(asset.name)]
    cluster = None if ray is None else RayPool(ray, jobs, run.limits)
    pending = run.sort_out(listed, retry)
    for sentence in run.failures:
        report(sentence)
    done, images = len(listed) - len(pending), 0
    progress(done, len(listed), images)
    try:
        with cluster or LocalPool(max(1, min(jobs, len(pending))), run.limits) as pool:
            for message in pool.render([run.job(task) for task in pending]):
                if "warning" in message:
                    report(message["warning"])
                elif "image" in message:
                    images += message["image"]
                elif "end" in message:
                    done += 1
                    if sentence := run.finish(pending[message.pop("end")], **message):
                        report(sentence)
                progress(done, len(listed), images)
    finally:
        write_index(out, run.rows, part)
    return run.folders, run.failures


@dataclass
class _Run:
    """What is asked for, and what is known of it so far."""

    out: Path
    settings: RenderSettings
    limits: Limits
    licences: Licences
    rows: list[Row] = field(default_factory=list)
    folders: list[Path] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)  # sentences

    def sort_out(self, assets: list[Asset], retry: bool) -> list[_Task]:
        """What is still to render; what is finished, failed before, or would overwrite another asset is noted."""
        pending, seen = [], {}
        for asset in assets:
            other = seen.setdefault(asset.name.lower(), asset)  # one folder for both on Windows and macOS
            if other != asset:
                remedy = "rename one of the two, or give a --root that holds both, for names are paths below it"
                sentence = f"{asset.path}: it would be written over that of {other.path}; {remedy}."
                self._note_failure(failure_row(asset, sentence, REFUSED))
                continue
            task = _Task(asset, sha256 := file_sha256(asset), self.licences.of(asset, sha256))
            remove_half_written({"out": str(self.out / asset.name)})  # of a run that was killed
            folders, whole = rendered_sequences(self.out / asset.name, asset, self.settings)
            kept = None if retry else kept_failure(self.out, asset, sha256, self._conditions())
            if whole or kept:
                self._note_sequences(task, folders)
                if not whole:
                    self._note_failure(kept)
            else:
                pending.append(task)
        return pending

    def finish(self, task: _Task, written: list[str], error: dict | None, **seconds: float) -> str | None:
        """Notes what became of an asset, as `render_job` tells it; the sentence if it failed."""
        self._note_sequences(task, [Path(folder) for folder in written])
        # Blender may crash on its way out, after all is written: the next run would find it finished
        if not error or rendered_sequences(self.out / task.asset.name, task.asset, self.settings)[1]:
            forget_failure(self.out, task.asset)
            return None
        row = failure_row(task.asset, error["error"], error["status"], sha256=task.sha256, terms=task.terms, **seconds)
        with contextlib.suppress(OSError):  # the disk is full, or a file has that folder's name: the table has it still
            keep_failure(self.out, row, self._conditions())
        self._note_failure(row)
        return row.sentence

    def job(self, task: _Task) -> dict:
        """As `render_asset` takes it, but for the cores."""
        job = {"asset": asdict(task.asset), "settings": asdict(self.settings), "terms": task.terms.as_provenance()}
        return job | {"out": str(self.out / task.asset.name)}

    def _conditions(self) -> dict:
        return {"settings": asdict(self.settings), "limits": asdict(self.limits), "timesplat": __version__}

    def _note_sequences(self, task: _Task, folders: list[Path]) -> None:
        for folder in folders:
            set_terms(folder, task.terms)
            self.rows.append(sequence_row(self.out, folder, task.asset))
            self.folders.append(folder)

    def _note_failure(self, row: Row) -> None:
        self.rows.append(row)
        self.failures.append(row.sentence)


@dataclass(frozen=True)
class _Task:
    """An asset to render."""

    asset: Asset
    sha256: str
    terms: Terms


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
    job = {"asset": asdict(one), "folder": str(folder), "settings": asdict(settings), "terms": {}, "cores": []}
    run_child(job, receive, set())
    if errors:
        raise InputError(errors[0])
    return read_sequence(Path(folder))


# ---------------------------------------------------------------- the command line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `timesplat render`."""
    defaults = RenderSettings()
    from .writers import layout_argument

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
    layout_argument(parser)
    parser.add_argument("--shard", metavar="I/N", help="of these assets the Ith of N parts alone, 1/N to N/N: for "
                        "machines that are given the same assets; `timesplat report` joins their tables")  # fmt: skip
    parser.add_argument("--jobs", type=int, default=len(cores()), metavar="N", help="assets at a time (%(default)s)")
    parser.add_argument("--ray", nargs="?", const=LOCAL, metavar="ADDRESS", help="hand the assets out by Ray: to the "
                        "cluster at this address, or to one of --jobs cores that is started here; needs the extra "
                        "`ray`")  # fmt: skip
    parser.add_argument("--limit-seconds", type=float, default=3600.0, metavar="S", help="an asset that takes longer, "
                        "by the clock, is given up (%(default)g)")  # fmt: skip
    parser.add_argument("--limit-memory", type=float, metavar="GB", help="an asset that needs more is given up "
                        "(default: no limit)")  # fmt: skip
    parser.add_argument("--licences", type=Path, metavar="CSV", help="columns licence, author, and one of sha256, "
                        "path, uid, name that says whose; they stay with every Sequence")  # fmt: skip
    parser.add_argument("--retry", action="store_true", help="try again what failed in an earlier run")


def run(args: argparse.Namespace) -> int:
    """`timesplat render`: 0 if all went well, 2 if an asset failed. InputError where nothing can start."""
    from tqdm import tqdm

    assets = [*args.assets, *(f"zoo:{s}" for s in parse_seeds(args.zoo))]
    if not assets:
        raise InputError("render: there is nothing to render; give an asset, a folder, or --zoo 0-9.")
    settings = RenderSettings(**{name: getattr(args, name) for name in asdict(RenderSettings())})
    # In another layout they are not Sequences, from which a run that was stopped goes on: these are kept, hidden.
    out = args.out if args.layout == "sequence" else args.out / ".sequences"
    limits = Limits(args.limit_seconds, args.limit_memory)
    licences = read_licences(args.licences) if args.licences else None
    part = Part.parse(args.shard) if args.shard else None
    with tqdm(total=0, unit="asset", disable=None) as bar:

        def progress(done: int, total: int, images: int) -> None:
            bar.total, bar.n = total, done
            bar.set_postfix_str(f"{images} images")

        def report(sentence: str) -> None:
            bar.write(sentence, file=sys.stderr)

        folders, failures = render_assets(
            assets,
            out,
            settings,
            root=args.root,
            part=part,
            jobs=args.jobs,
            ray=args.ray,
            limits=limits,
            licences=licences,
            retry=args.retry,
            report=report,
            progress=progress,
        )
    for folder in folders if out != args.out else ():
        _in_layout(folder, args.out / folder.relative_to(out), args.layout)
    failed = f", {len(failures)} failed (--retry tries them again)" if failures else ""
    print(f"{len(folders)} sequences in {args.out}{failed}; {table_of(out, part)} has them all")
    return 2 if failures else 0


def _in_layout(folder: Path, out: Path, layout: str) -> None:
    """Writes a Sequence in a layout, unless that is done."""
    from .writers import LAYOUTS, write_layout

    mark, source = out / LAYOUTS[layout].mark, folder / "transforms.json"
    if not mark.is_file() or mark.stat().st_mtime < source.stat().st_mtime:
        write_layout(read_sequence(folder), out, layout)


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
