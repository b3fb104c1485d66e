# SPDX-License-Identifier: GPL-3.0-or-later
"""Whose an asset is and under which licence it may be used, from a table that the user brings. numpy is not needed."""

from __future__ import annotations

import csv
from dataclasses import asdict, dataclass
from pathlib import Path

from .errors import InputError
from .render_job import Asset, zoo_seed

_KEYS = ("sha256", "path", "uid", "name")  # columns that say which asset a row is of, the surest first
_LICENCE, _AUTHOR = ("licence", "license"), ("author", "creator", "artist")


@dataclass(frozen=True)
class Terms:
    """What stays with every Sequence of an asset. Empty where nothing is known."""

    uid: str = ""  # the table's, or else the file's name without its ending, which is Objaverse's UID
    licence: str = ""
    author: str = ""

    def as_provenance(self) -> dict[str, str]:
        """The entries of a Sequence's provenance."""
        return asdict(self)


class Licences:
    """The terms of assets, looked up by what the table has of `sha256`, `path` (below the root), `uid` and `name` (of
    the file, without its ending)."""

    def __init__(self, rows: list[dict[str, str]] | None = None) -> None:
        self._by: dict[str, dict[str, dict[str, str]]] = {key: {} for key in _KEYS}
        for row in rows or []:
            for key in _KEYS:
                if row.get(key):
                    self._by[key].setdefault(row[key], row)

    def of(self, asset: Asset, sha256: str = "") -> Terms:
        """Those of an asset. sha256: of its file, "" where there is none."""
        stem = asset.path if zoo_seed(asset.path) else Path(asset.path).stem
        keys = {"sha256": sha256, "path": asset.below_root, "uid": stem, "name": stem}
        found = next((row for key in _KEYS if (row := self._by[key].get(keys[key]))), {})
        return Terms(found.get("uid") or stem, _first(found, _LICENCE), _first(found, _AUTHOR))


def read_licences(path: Path) -> Licences:
    """The table in a CSV file: a column `licence` (or `license`), perhaps `author`, and one or more of `sha256`,
    `path`, `uid`, `name` that say whose it is; others are passed over. Raises InputError."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as f:
            reader = csv.DictReader(f)
            columns = [str(c).strip().lower() for c in reader.fieldnames or []]
            reader.fieldnames = columns
            rows = [{k: (v or "").strip() for k, v in row.items() if k and isinstance(v, str)} for row in reader]
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give a CSV of licences.") from None
    except (OSError, UnicodeDecodeError, csv.Error) as e:
        raise InputError(f"{path}: it cannot be read as CSV ({e}); save it as UTF-8 with commas.") from None
    if not set(columns) & set(_LICENCE):
        raise InputError(f"{path}: it has no column licence; name one so, beside {', '.join(_KEYS)}.")
    if not set(columns) & set(_KEYS):
        raise InputError(f"{path}: nothing says whose the licences are; add a column {' or '.join(_KEYS)}.")
    return Licences(rows)


def _first(row: dict[str, str], names: tuple[str, ...]) -> str:
    return next((row[name] for name in names if row.get(name)), "")
