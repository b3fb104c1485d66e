# SPDX-License-Identifier: GPL-3.0-or-later
"""The table of a run, `index.parquet` with `index.csv` beside: a row for every Sequence, and one for every asset that
failed, so that nothing is lost.

Machines that render parts of the assets into one folder write a table each, `index-2-of-8.csv`; `join_index` makes one
of them. All of it is found again on disk, in the Sequences' provenance and in the `failed.json` that is in a failed
asset's folder, so that a run which was killed and started again writes the same table, seconds included: they stay as
they were measured.
"""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from .errors import InputError
from .licences import Terms
from .render_job import Asset, Part
from .whole_folders import write_whole

RENDERED = "rendered"
FAILURES = REFUSED, CRASHED, TIME, MEMORY = "refused", "crashed", "time", "memory"  # why an asset failed
FAILED = "failed.json"


def table_of(out: Path, part: Part | None = None) -> Path:
    """The table of a run, or of one of its parts, as CSV; the same as .parquet is beside it."""
    return out / (f"index-{part.number}-of-{part.of}.csv" if part else "index.csv")


@dataclass(frozen=True, order=True)
class Row:
    """One Sequence, or one asset that failed. Text is "" and a seed -1 where there is none."""

    name: str  # of the asset: its folder below the run's
    sequence: str  # folder of the Sequence below the run's
    source: str  # path of the file below the root, or "zoo:SEED"
    uid: str = ""
    sha256: str = ""
    licence: str = ""
    author: str = ""
    clip: str = ""
    camera_seed: int = -1
    blender: str = ""
    timesplat: str = ""
    pictures: int = 0
    seconds: float = 0.0  # by the clock: opening the file (with its first clip), measuring, rendering, writing
    cpu_seconds: float = 0.0  # of the processor, the start of Blender included; 0 where it was not measured
    status: str = RENDERED  # or one of FAILURES
    sentence: str = ""  # why it failed, or what there is to be said of the Sequence


def sequence_row(out: Path, folder: Path, asset: Asset | None = None) -> Row:
    """Of the Sequence in `folder`, which is below the run's folder `out`; what its asset is called is found out where
    it is not given. Raises InputError."""
    path = folder / "transforms.json"
    try:
        d = json.loads(path.read_text(encoding="utf-8"))
        p = d["provenance"]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path}: it is missing or damaged; render the Sequence again.") from None
    return Row(
        asset.name if asset else folder.parent.relative_to(out).as_posix(),
        folder.relative_to(out).as_posix(),
        asset.below_root if asset else str(p.get("path", p.get("asset", ""))),
        **{name: str(p.get(name, "")) for name in ("uid", "sha256", "licence", "author", "clip")},
        camera_seed=int(p.get("cameras_seed", -1)),
        blender=str(p.get("blender", "")),
        timesplat=str(p.get("timesplat", "")),
        pictures=len(d.get("frames", [])),
        seconds=float(p.get("seconds", 0)),
        cpu_seconds=float(p.get("cpu_seconds", 0)),
        sentence=" ".join(p.get("warnings", [])),
    )


def failure_row(
    asset: Asset,
    sentence: str,
    status: str,
    *,
    sha256: str = "",
    terms: Terms | None = None,
    seconds: float = 0.0,
    cpu_seconds: float = 0.0,
) -> Row:
    """Of an asset that failed; status: one of FAILURES."""
    times = {"seconds": round(seconds, 2), "cpu_seconds": round(cpu_seconds, 2)}
    more = {"sha256": sha256, **times, "status": status, "sentence": sentence}
    return Row(asset.name, "", asset.below_root, **(terms or Terms()).as_provenance(), **more)


# ---------------------------------------------------------------- failures, which the next run finds


def keep_failure(out: Path, row: Row, conditions: dict) -> None:
    """Writes why an asset failed into its folder. conditions: under which it did (settings, limits)."""
    write_whole(
        out / row.name / FAILED, (json.dumps({"conditions": conditions, "row": asdict(row)}, indent=1) + "\n").encode()
    )


def kept_failure(out: Path, asset: Asset, sha256: str, conditions: dict) -> Row | None:
    """The failure of this very file under these conditions; None where there is none."""
    try:
        row, under = _read_failure(out / asset.name / FAILED)
    except InputError:
        return None
    return row if (under, row.source, row.sha256) == (conditions, asset.below_root, sha256) else None


def _read_failure(path: Path) -> tuple[Row, dict]:
    """What `keep_failure` wrote. Raises InputError."""
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        return Row(**kept["row"]), kept["conditions"]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path}: it is missing or damaged; remove it, and render the asset again.") from None


def forget_failure(out: Path, asset: Asset) -> None:
    """Removes what `keep_failure` wrote."""
    (out / asset.name / FAILED).unlink(missing_ok=True)


def set_terms(folder: Path, terms: Terms) -> None:
    """Writes the terms, as far as they are known, into a finished Sequence where it has others."""
    path = folder / "transforms.json"
    d = json.loads(path.read_text(encoding="utf-8"))
    new = d["provenance"] | {key: text for key, text in terms.as_provenance().items() if text}
    if new != d["provenance"]:
        d["provenance"] = new
        write_whole(path, json.dumps(d, indent=1).encode())


# ---------------------------------------------------------------- the table


def write_index(out: Path, rows: Iterable[Row], part: Part | None = None) -> None:
    """Both files of a run or a part of it, sorted, each whole or as it was. Rows of other assets of earlier runs stay
    in it, while their Sequences do. Raises InputError without pyarrow."""
    pyarrow, parquet = needed()
    rows = list(rows)
    named = {row.name.lower() for row in rows}
    others = [row for row in read_index(out, part) if row.name.lower() not in named]
    rows = sorted([*rows, *(row for row in others if (out / row.sequence).is_dir())])
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, [f.name for f in fields(Row)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    write_whole(table_of(out, part), text.getvalue().encode("utf-8", "surrogateescape"))
    types = {"int": pyarrow.int64(), "float": pyarrow.float64()}
    schema = pyarrow.schema([(f.name, types.get(str(f.type), pyarrow.string())) for f in fields(Row)])
    whole = [{k: _sayable(v) for k, v in asdict(row).items()} for row in rows]
    sink = io.BytesIO()
    parquet.write_table(pyarrow.Table.from_pylist(whole, schema), sink, compression="zstd")
    write_whole(table_of(out, part).with_suffix(".parquet"), sink.getvalue())


def join_index(out: Path, progress: Callable[[int], None] = lambda found: None) -> list[Row]:
    """The rows of all that is in a run's folder, whoever rendered it, perhaps copied together from several machines or
    rendered at this moment; where there are tables of parts, `index.csv` and its .parquet are written with all of them.
    `progress` gets how many were found. Raises InputError."""
    rows: list[Row] = []
    for folder, below, files in os.walk(out):
        if "transforms.json" in files:
            rows.append(sequence_row(out, Path(folder)))
            below.clear()
        elif FAILED in files:
            rows.append(_read_failure(Path(folder) / FAILED)[0])
        below[:] = sorted(name for name in below if not name.startswith("."))
        progress(len(rows))
    parts = sorted(out.glob("index-*-of-*.csv"))
    named = {row.name.lower() for row in rows}
    tables = [row for path in (table_of(out), *parts) for row in _read(path)]
    left = {row for row in tables if row.status != RENDERED and row.name.lower() not in named}  # nothing else on disk
    rows = sorted([*rows, *left])
    if parts:
        write_index(out, rows)
    return rows


def read_index(out: Path, part: Part | None = None) -> list[Row]:
    """The rows in the table of a run, or of a part of it; none where there is no table. Raises InputError for one that
    is damaged."""
    return _read(table_of(out, part))


def _read(path: Path) -> list[Row]:
    try:
        with open(path, newline="", encoding="utf-8", errors="surrogateescape") as f:
            return [_row(d) for d in csv.DictReader(f)]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError, KeyError) as e:
        raise InputError(f"{path}: the table is damaged ({e}); remove it, and render makes it anew.") from None


def _row(d: dict[str, str]) -> Row:
    """Of a line of the table; columns that an earlier version did not write are as where nothing is known."""
    kinds: dict[str, type] = {"int": int, "float": float, "str": str}
    return Row(**{f.name: kinds[str(f.type)](d[f.name]) for f in fields(Row) if f.name in d})


def _sayable(value):
    """Parquet knows no bytes in text; a file's name may hold some."""
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value


def needed():
    """pyarrow and its parquet. Raises InputError where it is not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError:
        raise InputError(
            "render: pyarrow is missing, which writes the table; pip install 'timesplat[render]'."
        ) from None
    return pyarrow, pyarrow.parquet
