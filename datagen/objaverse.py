# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat fetch objaverse`: files of Objaverse 1.0 with their licences, through the package `objaverse`, which keeps
what it fetched."""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import os
import re
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

from .errors import InputError
from .whole_folders import write_whole

LICENCES = "licences.csv"  # beside the files; `render --licences` reads it
_COLUMNS = ("uid", "licence", "author", "title", "url", "sha256")
_SPDX = {
    "by": "CC-BY-4.0",
    "by-sa": "CC-BY-SA-4.0",
    "by-nd": "CC-BY-ND-4.0",
    "by-nc": "CC-BY-NC-4.0",
    "by-nc-sa": "CC-BY-NC-SA-4.0",
    "by-nc-nd": "CC-BY-NC-ND-4.0",
    "cc0": "CC0-1.0",
}
_AT_ONCE = 64  # objects from one look at the table to the next: what is there when the network goes is kept
_UID = re.compile(r"[0-9a-f]{32}")


def fetch(
    out: Path,
    uids: list[str] | None = None,
    *,
    animated: bool = False,
    limit: int | None = None,
    leave_out: Iterable[str] = (),
    processes: int = 4,
    report: Callable[[str], None] = print,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Path]:
    """Fetches objects into `out/<uid>.glb`, and writes whose they are into `out/licences.csv`; what is there is not
    fetched again. Returns the files.

    uids        those, in their order; None: all that Objaverse has
    animated    only those that have an animation; limit: no more than so many
    leave_out   UIDs that are not fetched, such as the test objects of others
    Raises InputError without the package, where nothing is left to fetch, and without network.
    """
    package = _package()
    out, left_out = Path(out), set(leave_out)
    known = dict.fromkeys(_ask(package.load_uids))
    for uid in uids or ():
        if uid not in known:
            report(f"{uid}: Objaverse has no such object; it is left out.")
    wanted = [uid for uid in (known if uids is None else uids) if uid in known and uid not in left_out]
    if animated:
        notes = _ask(package.load_annotations, wanted if uids is not None else None)
        wanted = [uid for uid in wanted if notes.get(uid, {}).get("animationCount")]
    wanted = list(dict.fromkeys(wanted))[:limit]
    if not wanted:
        raise InputError("fetch objaverse: nothing is left to fetch; give other --uids, or a shorter --leave-out.")
    out.mkdir(parents=True, exist_ok=True)
    rows, files = _read_rows(out / LICENCES), []
    for start in range(0, len(wanted), _AT_ONCE):
        batch = wanted[start : start + _AT_ONCE]
        progress(start, len(wanted))
        new = [uid for uid in batch if uid not in rows or not (out / f"{uid}.glb").is_file()]
        if new:
            notes = _ask(package.load_annotations, new)
            paths = _ask(package.load_objects, new, processes)
            for uid in new:
                if uid in paths:
                    _put(Path(paths[uid]), out / f"{uid}.glb")
                    rows[uid] = _row(uid, notes.get(uid, {}), out / f"{uid}.glb")
                else:
                    report(f"{uid}: it could not be fetched; start again later.")
            _write_rows(out / LICENCES, rows)
        files += [out / f"{uid}.glb" for uid in batch if uid in rows]
    progress(len(wanted), len(wanted))
    return files


def read_uids(path: Path) -> list[str]:
    """The UIDs, 32 hexadecimal digits each, that a text, CSV or JSON file holds, in order. Raises InputError."""
    try:
        found = list(dict.fromkeys(_UID.findall(path.read_text(encoding="utf-8", errors="replace").lower())))
    except OSError:
        raise InputError(f"{path}: it cannot be read; give a file with a UID on each line.") from None
    if not found:
        raise InputError(f"{path}: there is no UID in it, 32 hexadecimal digits; give a file with one on each line.")
    return found


def _package():
    try:
        import objaverse
    except ModuleNotFoundError:
        remedy = "pip install 'timesplat[objaverse]'"
        raise InputError(f"fetch objaverse: the package objaverse is missing; {remedy}.") from None
    return objaverse


def _ask(question: Callable, *arguments):
    """An answer of the package, which fetches what it needs. InputError where it cannot."""
    try:
        return question(*arguments)
    except (OSError, EOFError, ValueError) as e:  # of the network; of a file that was cut off when it was fetched
        remedy = (
            "look at the network, or remove ~/.objaverse/hf-objaverse-v1/metadata if that is damaged, and start again"
        )
        raise InputError(f"fetch objaverse: it cannot be reached ({e}); {remedy}.") from None


def _put(source: Path, target: Path) -> None:
    """The file under another name: a link where the disk is the same, else a copy; whole or not at all."""
    tmp = target.with_name(f".{target.name}.tmp")
    tmp.unlink(missing_ok=True)
    try:
        os.link(source, tmp)
    except OSError:
        shutil.copyfile(source, tmp)
    tmp.replace(target)


def _row(uid: str, note: dict, file: Path) -> dict[str, str]:
    user = note.get("user") or {}
    licence = str(note.get("license") or "")
    return {
        "uid": uid,
        "licence": _SPDX.get(licence, licence),
        "author": str(user.get("displayName") or user.get("username") or ""),
        "title": str(note.get("name") or ""),
        "url": str(note.get("viewerUrl") or note.get("uri") or ""),
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
    }


def _read_rows(path: Path) -> dict[str, dict[str, str]]:
    if not path.is_file():
        return {}
    with open(path, newline="", encoding="utf-8") as f:
        return {
            row["uid"]: {name: row.get(name) or "" for name in _COLUMNS} for row in csv.DictReader(f) if row.get("uid")
        }


def _write_rows(path: Path, rows: dict[str, dict[str, str]]) -> None:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows[uid] for uid in sorted(rows))
    write_whole(path, text.getvalue().encode())


# ---------------------------------------------------------------- the command line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `timesplat fetch`."""
    parser.add_argument("source", choices=["objaverse"], help="Objaverse 1.0, some 800,000 objects under CC licences")
    parser.add_argument("--out", type=Path, required=True, help="folder for the files and licences.csv")
    parser.add_argument("--uids", type=Path, metavar="FILE", help="only these: a file with UIDs")
    parser.add_argument("--animated", action="store_true", help="only those with an animation")
    parser.add_argument("--limit", type=int, metavar="N", help="no more than so many")
    parser.add_argument("--leave-out", type=Path, action="append", default=[], metavar="FILE", help="not these, such "
                        "as the test objects of others; can be given more than once")  # fmt: skip
    parser.add_argument("--processes", type=int, default=4, metavar="N", help="downloads at a time (%(default)s)")


def run(args: argparse.Namespace) -> int:
    """`timesplat fetch`: 0, or 2 where an object is missing. InputError where nothing can be fetched."""
    from tqdm import tqdm

    if args.uids is None and not args.animated and args.limit is None:
        raise InputError("fetch objaverse: that would be all of it; give --uids, --animated or --limit.")
    if args.limit is not None and args.limit < 1:
        raise InputError(f"--limit {args.limit}: too small; give 1 or more.")
    told: list[str] = []
    with tqdm(total=0, unit="object", delay=2, disable=None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        def report(sentence: str) -> None:
            told.append(sentence)
            bar.write(sentence)

        files = fetch(
            args.out,
            read_uids(args.uids) if args.uids else None,
            animated=args.animated,
            limit=args.limit,
            leave_out=[uid for path in args.leave_out for uid in read_uids(path)],
            processes=args.processes,
            report=report,
            progress=progress,
        )
    print(f"{len(files)} objects in {args.out}; render them with --licences {args.out / LICENCES}")
    return 2 if told else 0
