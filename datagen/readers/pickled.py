# SPDX-License-Identifier: GPL-3.0-or-later
"""Numbers, lists and dictionaries that numpy wrote with pickle (`np.save` of a dictionary), read without running what a
file says: nothing of Python or numpy can be called by it, only the stand-ins below."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np


class _Kind:
    """Stands in for numpy.dtype."""

    def __init__(self, code: str, *_: object):
        self.code, self.order = str(code), "="

    def __setstate__(self, state: tuple) -> None:
        self.order = state[1]

    def dtype(self) -> np.dtype:
        kind = np.dtype(self.code)
        if kind.hasobject:
            raise ValueError(f"an array of {self.code}")
        return kind.newbyteorder(">") if self.order == ">" else kind


class _Array:
    """Stands in for an array that is being put together."""

    value: Any = None

    def __setstate__(self, state: tuple) -> None:
        _, shape, kind, by_columns, data = state
        if isinstance(data, list):  # of objects
            self.value = data
        else:
            self.value = _shaped(np.frombuffer(data, kind.dtype()), shape, by_columns)


def _scalar(kind: _Kind, data: bytes) -> Any:
    return np.frombuffer(data, kind.dtype())[0].item()


def _whole(data: bytes, kind: _Kind, shape: tuple, order: Any) -> np.ndarray:
    return _shaped(np.frombuffer(data, kind.dtype()), shape, order == "F")


def _shaped(flat: np.ndarray, shape: tuple, by_columns: bool) -> np.ndarray:
    return flat.reshape(shape[::-1]).T if by_columns else flat.reshape(shape)


def _encode(text: str, _coding: str = "latin1") -> bytes:
    return text.encode("latin1")


_STAND_INS = {
    "dtype": _Kind,
    "_reconstruct": lambda *_: _Array(),
    "ndarray": object,  # is passed to _reconstruct and not called
    "scalar": _scalar,
    "_frombuffer": _whole,
    "encode": _encode,
}


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if module.split(".")[0] in ("numpy", "_codecs") and name in _STAND_INS:
            return _STAND_INS[name]
        raise ValueError(f"it asks for {module}.{name}, which is not run")


def read_pickled(path: Path) -> Any:
    """What an .npy file of one object holds: dictionaries, lists, text, numbers and arrays of numbers. Raises
    ValueError where it is damaged or asks for anything else."""
    with path.open("rb") as file:
        version = np.lib.format.read_magic(file)
        head = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        _, _, kind = head(file)
        if not kind.hasobject:
            raise ValueError("it holds numbers alone, no dictionary")
        try:
            found = _plain(_Reader(file).load())
        except (pickle.UnpicklingError, EOFError, AttributeError, IndexError, TypeError, MemoryError) as e:
            raise ValueError(str(e) or "it ends too early") from None
    return found[0] if isinstance(found, list) and len(found) == 1 else found


def _plain(x: Any) -> Any:
    """Without stand-ins, at any depth."""
    if isinstance(x, _Array):
        return _plain(x.value)
    if isinstance(x, dict):
        return {_plain(k): _plain(v) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return [_plain(v) for v in x]
    return x
