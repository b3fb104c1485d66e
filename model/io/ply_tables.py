# SPDX-License-Identifier: GPL-3.0-or-later
"""Any .ply as tables, whatever they mean: ascii or binary in either byte order, elements in any order. numpy only, for
inside Blender. Nothing of a file is believed before it is checked."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np

from ...datagen.sequence import InputError

MAX_HEADER_BYTES = 1 << 16
_NUMPY_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2"},
    **{"ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_CONTENTS = {"vertex": "Gaussians", "path": "paths", "knot": "knots"}


class PlyTables:
    """The header of a .ply, and its elements one by one. Raises InputError, which begins with `path`."""

    def __init__(self, data: bytes, path: Path):
        self.data, self.path = data, path
        self.meta: dict[str, str] = {}  # of `comment timesplat <key> <value>`
        self.counts: dict[str, int] = {}
        self.properties: dict[
            str, list[tuple[str, str]]
        ] = {}  # (name, type) of an element; the type of a list is "list"
        self.order = ""
        head = data[:MAX_HEADER_BYTES]
        if not re.match(rb"ply\r?\n", head):
            raise InputError(f"{path}: it is not a .ply file; choose a Gaussian splat .ply.")
        end = re.search(rb"\nend_header\r?\n", head)
        if end is None:
            raise InputError(f"{path}: the header has no end, the file is truncated; copy or export it again.")
        self.start = end.end()
        try:
            self._parse(head[: end.start()].decode("utf-8", "replace").splitlines()[1:])
        except (ValueError, KeyError, IndexError, StopIteration) as e:
            raise self._damaged(e) from None

    def _damaged(self, what: object) -> InputError:
        return InputError(f"{self.path}: the header is damaged ({what}); copy or export it again.")

    def _parse(self, lines: list[str]) -> None:
        for word in map(str.split, lines):
            if word[:1] == ["format"]:
                self.order = _ORDERS[word[1]]
            elif word[:2] == ["comment", "timesplat"]:
                self.meta[word[2]] = " ".join(word[3:])
            elif word[:1] == ["element"]:
                if int(word[2]) < 0 or word[1] in self.counts:
                    raise ValueError(f"no {_CONTENTS.get(word[1], word[1])}, or twice")
                self.counts[word[1]], self.properties[word[1]] = int(word[2]), []
            elif word[:1] == ["property"]:
                next(reversed(self.properties.values())).append((word[-1], word[1]))
        if not self.order:
            raise ValueError("it names no format")

    def names(self, element: str) -> list[str]:
        """Of the properties of an element; none where there is none."""
        return [name for name, _ in self.properties.get(element, [])]

    def table(self, element: str) -> np.ndarray:
        """The rows of an element as a record array. Raises InputError: it is not there, holds lists, or is cut off."""
        if element not in self.counts:
            first = next(iter(self.counts), "nothing")
            raise InputError(f"{self.path}: it has no {element}, but {first}; export it as an uncompressed 3DGS .ply.")
        count, dtype = self.counts[element], self._dtype(element)
        before = list(self.counts)[: list(self.counts).index(element)]
        if self.order == "=":
            return self._ascii(element, sum(self.counts[b] for b in before), count, dtype)
        at = self.start + sum(self.counts[b] * self._dtype(b).itemsize for b in before)
        have = max(len(self.data) - at, 0)
        if have < count * dtype.itemsize:
            raise self._truncated(element, have // dtype.itemsize)
        return np.frombuffer(self.data, dtype, count, at)

    def _dtype(self, element: str) -> np.dtype:
        try:
            if not self.properties[element]:
                raise ValueError(f"no {_CONTENTS.get(element, element)}")
            return np.dtype([(name, self.order + _NUMPY_TYPES[kind]) for name, kind in self.properties[element]])
        except (ValueError, KeyError) as e:
            raise self._damaged(e) from None

    def _ascii(self, element: str, first: int, count: int, dtype: np.dtype) -> np.ndarray:
        """A row a line."""
        lines = self.data[self.start :].splitlines()[first : first + count]
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # what is no number
            try:
                numbers = np.fromstring(b" ".join(lines), np.float64, sep=" ")
            except (ValueError, DeprecationWarning):
                raise InputError(
                    f"{self.path}: its element {element} holds what is no number; export it again."
                ) from None
        names = self.names(element)
        if len(lines) < count or len(numbers) != count * len(names):
            raise self._truncated(element, min(len(numbers) // len(names), len(lines)))
        rows = np.empty(count, dtype)
        with np.errstate(over="ignore", invalid="ignore"):
            for name, column in zip(names, numbers.reshape(count, len(names)).T, strict=True):
                rows[name] = column
        return rows

    def _truncated(self, element: str, have: int) -> InputError:
        return InputError(
            f"{self.path}: the file is truncated, {self.counts[element]} {_CONTENTS.get(element, element)} were "
            f"announced and there is data for {have}; copy or export it again."
        )
