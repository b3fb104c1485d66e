# SPDX-License-Identifier: GPL-3.0-or-later
"""Sequences as WebDataset shards: `timesplat pack`, and how they are read back. numpy and Pillow only.

A shard is a plain tar whose samples are clips, one after another: KEY.json (a Sequence's transforms.json, licence and
author in its provenance), then KEY.0000.webp or .png of each view, and KEY.0000.exr, its passes byte for byte. The same
Sequences give the same bytes. The order of clips is that of their names' hashes, so that who reads a shard from front
to back sees them mixed. `manifest.csv` says where each clip starts, and what it is; its JSON says where its files are.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import json
import os
import re
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path

import numpy as np

from .curation.decisions import OUT, decided, set_of
from .curation.measures import motion_of
from .errors import InputError
from .image_files import encode_png
from .passes import Passes, read_passes
from .readers import described_by, open_sequence, sequences_in
from .rigs import CANONICAL
from .sequence import Sequence, distinct, sequence_from_json, sequence_to_json
from .whole_folders import write_whole

MANIFEST = "manifest.csv"
FORMATS = WEBP, PNG = "webp", "png"
_BLOCK = tarfile.BLOCKSIZE


@dataclass(frozen=True)
class PackSettings:
    """passes: depth and motion too; pictures: one of FORMATS, both without loss; clips: in a shard. InputError where
    there would be none."""

    passes: bool = True
    pictures: str = WEBP
    clips: int = 256

    def __post_init__(self) -> None:
        if self.clips < 1:
            raise InputError(f"--clips {self.clips}: give 1 or more for a shard.")


@dataclass(frozen=True)
class Clip:
    """A row of the manifest."""

    name: str  # folder of the Sequence, below the one that was packed
    key: str  # what WebDataset calls it
    shard: str  # file name
    offset: int  # of its JSON in the shard
    size: int  # of its JSON
    views: int
    passes: int  # 1 where every view has some
    set: str  # one of curation's SETS
    motion: float  # as `measures.motion_of` has it
    licence: str
    author: str
    stamp: str  # of what was packed: what has another is packed anew


# ---------------------------------------------------------------- writing


def pack(
    folder: Path,
    out: Path,
    settings: PackSettings | None = None,
    *,
    jobs: int = 1,
    report: Callable[[str], None] = print,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Clip]:
    """Writes all Sequences below `folder`, but those that curation threw out, into shards in `out`, so many shards at a
    time, and the manifest of them all, which is returned. Shards that are there and hold what they should stay.
    `report` gets a sentence for each Sequence that cannot be read, which is left out; `progress` shards done and all.
    Raises InputError where there is no Sequence."""
    folder, out, settings = Path(folder), Path(out), settings or PackSettings()
    found = sequences_in(folder)
    sets = decided(found)
    found = [f for f in found if sets.get(f) != OUT]
    if not found:
        raise InputError(f"{folder}: there is no Sequence to pack in it; render some with `timesplat render`.")
    names = sorted((f.relative_to(folder).as_posix() for f in found), key=lambda n: hashlib.sha256(n.encode()).digest())
    keys = dict(zip(names, distinct([_key(name) for name in names]), strict=True))
    shards = [names[i : i + settings.clips] for i in range(0, len(names), settings.clips)]
    out.mkdir(parents=True, exist_ok=True)

    def write(number: int) -> list[Clip]:
        path = out / f"shard-{number:06d}.tar"
        wanted = {n: _stamp(folder / n, settings, sets.get(folder / n, "")) for n in shards[number]}
        rows = read_manifest(path.with_suffix(".csv"))
        if path.is_file() and {row.name: row.stamp for row in rows} == wanted:
            return rows
        rows = _write_shard(path, folder, wanted, keys, sets, settings, report)
        write_manifest(path.with_suffix(".csv"), rows)
        return rows

    clips: list[Clip] = []
    pool = ThreadPoolExecutor(max(jobs, 1))
    try:
        for done, rows in enumerate(pool.map(write, range(len(shards)))):
            progress(done, len(shards))
            clips += rows
    finally:
        pool.shutdown(cancel_futures=True)
    write_manifest(out / MANIFEST, clips)
    for old in out.glob("shard-*"):  # of more Sequences than there are now
        if int(old.stem.removeprefix("shard-")) >= len(shards):
            old.unlink()
    progress(len(shards), len(shards))
    return clips


def _key(name: str) -> str:
    """Of at most 60 letters, digits and hyphens: tar's short names hold it, and WebDataset splits at the first dot."""
    plain = re.sub(r"[^A-Za-z0-9-]+", "_", name)
    return plain if len(plain) <= 60 else f"{plain[:48]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def _stamp(folder: Path, settings: PackSettings, chosen: str) -> str:
    """Changes with the Sequence, the settings, and the set that curation chose."""
    changed = [path.stat().st_mtime_ns for path in described_by(folder)]
    return hashlib.sha256(f"1 {changed} {settings} {chosen}".encode()).hexdigest()[:16]


def _write_shard(
    path: Path,
    folder: Path,
    stamps: dict[str, str],
    keys: dict[str, str],
    sets: dict[Path, str],
    settings: PackSettings,
    report: Callable[[str], None],
) -> list[Clip]:
    """One shard, whole or as it was, of the Sequences `stamps`; their rows."""
    rows = []
    tmp = path.with_name(f".{path.name}.tmp")
    with open(tmp, "wb") as raw, tarfile.open(fileobj=raw, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name, stamp in stamps.items():
            try:
                seq = open_sequence(folder / name)
                about, files, motion = _packed(seq, settings)
            except InputError as e:
                report(str(e))
                continue
            still = bool(seq.provenance.get("settings", {}).get("displace")) or seq.frame_end == seq.frame_start
            about["set"] = sets.get(folder / name) or set_of(motion, still)
            head = json.dumps(about).encode()
            row = Clip(
                name, keys[name], path.name, tar.offset + _BLOCK, len(head), len(seq.views),
                int(all("exr_path" in f for f in about["frames"])), about["set"], motion,
                str(seq.provenance.get("licence", "")), str(seq.provenance.get("author", "")), stamp,
            )  # fmt: skip
            for end, data in (("json", head), *files):
                member = tarfile.TarInfo(f"{row.key}.{end}")
                member.size = len(data)
                tar.addfile(member, io.BytesIO(data))
            rows.append(row)
    tmp.replace(path)
    return rows


def _packed(seq: Sequence, settings: PackSettings) -> tuple[dict, list[tuple[str, bytes]], float]:
    """A clip's JSON, its files by what follows the key, and how much it moves. Raises InputError."""
    about, files, at = sequence_to_json(seq), [], 0
    about.pop("tracks_path", None)
    still: dict[str, list[tuple[float, np.ndarray]]] = {}

    def add(end: str, data: bytes) -> list[int]:
        """-> where the file starts behind the JSON's last block, and its size."""
        nonlocal at
        files.append((end, data))
        start = at + _BLOCK
        at = start + -(-len(data) // _BLOCK) * _BLOCK
        return [start, len(data)]

    for i, (view, frame) in enumerate(zip(seq.views, about["frames"], strict=True)):
        rgba = seq.load_image(i)
        if view.camera in CANONICAL:
            still.setdefault(view.camera, []).append((view.frame, rgba))
        frame["file_path"] = f"{i:04d}.{settings.pictures}"
        frame["file_span"] = add(frame["file_path"], _encoded(rgba, settings.pictures))
        if frame.pop("exr_path", None) and settings.passes:
            frame["exr_path"] = f"{i:04d}.exr"
            frame["exr_span"] = add(frame["exr_path"], _bytes(seq, view.passes or ""))
    ordered = [[rgba for _, rgba in sorted(shots, key=lambda s: s[0])] for shots in still.values()]
    return about, files, motion_of([np.stack(shots) for shots in ordered])


def bytes_in_shard(seq: Sequence, settings: PackSettings) -> dict[str, int]:
    """How large a clip is in a shard: bytes by the ending of its files, "json", "webp" or "png", "exr", with what tar
    adds. Raises InputError."""
    about, files, _ = _packed(seq, settings)
    sizes: dict[str, int] = {}
    for end, size in (("json", len(json.dumps(about))), *((name, len(data)) for name, data in files)):
        kind = end.rpartition(".")[2]
        sizes[kind] = sizes.get(kind, 0) + _BLOCK + -(-size // _BLOCK) * _BLOCK
    return sizes


def _bytes(seq: Sequence, relative: str) -> bytes:
    try:
        return (seq.folder / relative).read_bytes()
    except OSError as e:
        raise InputError(f"{seq.folder / relative}: it cannot be read ({e.strerror}); {seq.remedy}.") from None


def _encoded(rgba: np.ndarray, form: str) -> bytes:
    if form == PNG:
        return encode_png(rgba)
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(rgba).save(data, "WEBP", lossless=True, exact=True, quality=60)  # of lossless ones the effort
    return data.getvalue()


def write_manifest(path: Path, clips: Iterable[Clip]) -> None:
    """The table, whole or as it was."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, [f.name for f in fields(Clip)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(c) for c in clips)
    write_whole(path, text.getvalue().encode("utf-8", "surrogateescape"))


# ---------------------------------------------------------------- reading


def read_manifest(path: Path) -> list[Clip]:
    """The rows of a manifest; none where there is no such file. Raises InputError for one that is damaged."""
    kinds: dict[str, type] = {"int": int, "float": float, "str": str}
    try:
        with open(path, newline="", encoding="utf-8", errors="surrogateescape") as f:
            types = {x.name: kinds[str(x.type)] for x in fields(Clip)}
            return [Clip(**{name: kind(row[name]) for name, kind in types.items()}) for row in csv.DictReader(f)]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError, KeyError, csv.Error) as e:
        raise InputError(f"{path}: it is damaged ({e}); remove it, and `timesplat pack` makes it anew.") from None


@dataclass
class PackedSequence(Sequence):
    """A clip of a shard: a Sequence whose files lie in the tar, of which those are read that are asked for."""

    shard: Path = Path()
    key: str = ""
    behind: int = 0  # offset of the first block behind its JSON
    spans: list = field(default_factory=list)  # of each view [start behind that, size] of its picture and of its passes

    @classmethod
    def open(cls, folder: Path, clip: Clip) -> PackedSequence:
        """The clip of a manifest in `folder`. Raises InputError where the shard is missing or damaged."""
        path = Path(folder) / clip.shard
        head = _read(path, clip.offset, clip.size, clip.key)
        try:
            about = json.loads(head)
            seq = sequence_from_json(about, path)
            spans = [(f["file_span"], f.get("exr_span")) for f in about["frames"]]
        except (KeyError, TypeError, ValueError):
            raise InputError(f"{path}: {clip.key} is damaged in it; remove it and pack again.") from None
        behind = clip.offset + -(-clip.size // _BLOCK) * _BLOCK
        return cls(**vars(seq), shard=path, key=clip.key, behind=behind, spans=spans)

    def load_image(self, index: int) -> np.ndarray:
        """As of any Sequence."""
        from PIL import Image

        data = self._file(index, 0)
        try:
            rgba = np.asarray(Image.open(io.BytesIO(data)).convert("RGBA"))
        except Exception:
            raise self._damaged(index) from None
        if rgba.shape != (self.height, self.width, 4):
            raise self._damaged(index)
        return rgba

    def load_passes(self, index: int) -> Passes:
        """As of any Sequence."""
        if self.spans[index][1] is None:
            raise InputError(f"{self.shard}: {self.key} was packed without passes; pack it with them.")
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:  # OpenEXR reads files alone
            path = Path(folder) / "x.exr"
            path.write_bytes(self._file(index, 1))
            try:
                return read_passes(path, (self.height, self.width))
            except InputError:
                raise self._damaged(index) from None

    def _file(self, index: int, which: int) -> bytes:
        start, size = self.spans[index][which]
        return _read(self.shard, self.behind + start, size, self.key)

    def _damaged(self, index: int) -> InputError:
        return InputError(f"{self.shard}: view {index} of {self.key} is damaged in it; remove it and pack again.")


def _read(path: Path, offset: int, size: int, key: str) -> bytes:
    try:
        with open(path, "rb") as f:
            f.seek(offset)
            data = f.read(size)
    except OSError as e:
        raise InputError(f"{path}: the shard cannot be read ({e.strerror}); pack again.") from None
    if len(data) != size:
        raise InputError(f"{path}: it ends within {key}; remove it and pack again.")
    return data


# ---------------------------------------------------------------- the command line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `timesplat pack`."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    parser.add_argument("folder", type=Path, help="of Sequences at any depth, as `timesplat render` writes them")
    parser.add_argument("--out", type=Path, required=True, help="folder for the shards")
    parser.add_argument("--no-passes", dest="passes", action="store_false", help="pictures alone")
    parser.add_argument("--pictures", default=WEBP, choices=FORMATS, help="both without loss (%(default)s)")
    parser.add_argument("--clips", type=int, default=PackSettings.clips, metavar="N", help="in a shard (%(default)s)")
    parser.add_argument("--jobs", type=int, default=cores, metavar="N", help="shards at a time (%(default)s)")


def run(args: argparse.Namespace) -> int:
    """`timesplat pack`: 0, or 2 where a Sequence cannot be read. InputError where there is nothing to pack."""
    from tqdm import tqdm

    settings, told = PackSettings(args.passes, args.pictures, args.clips), []
    with tqdm(total=0, unit="shard", delay=2, leave=False, disable=None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        def report(sentence: str) -> None:
            told.append(sentence)
            bar.write(sentence, file=sys.stderr)

        clips = pack(args.folder, args.out, settings, jobs=args.jobs, report=report, progress=progress)
    shards = {clip.shard for clip in clips}
    size = sum((args.out / name).stat().st_size for name in shards) / 1e6
    views = sum(clip.views for clip in clips)
    left_out = f", {len(told)} Sequences left out" if told else ""
    print(f"{len(clips)} clips of {views} pictures in {len(shards)} shards, {size:.1f} MB{left_out}")
    print(f"{args.out / MANIFEST} has them all")
    return 2 if told else 0
