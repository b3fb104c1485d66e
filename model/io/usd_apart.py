# SPDX-License-Identifier: GPL-3.0-or-later
"""USD files read in a process of their own: over some damaged ones the library itself dies, hangs or takes all memory,
and no exception says so. `load_usd_apart` turns each of these into a sentence.

The child is this very module, `python -m timesplat.model.io.usd_apart FILE OUT.npz`; what comes back are arrays and
numbers, nothing that is executed.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np

from ...datagen.sequence import InputError
from .asset import ARRAYS, Asset, Clip, LoadedAsset
from .paths import Paths
from .usd_read import load_usd

LONGEST = 600.0  # seconds that reading may take
REFUSED = 2  # exit code after a sentence


def load_usd_apart(path: str | Path) -> LoadedAsset:
    """`load_usd` in a process of its own. Raises InputError as that does, and where the USD library dies over the file
    or does not come to an end."""
    path = Path(path)
    with tempfile.TemporaryDirectory(prefix="timesplat-", ignore_cleanup_errors=True) as folder:
        out = Path(folder) / "asset.npz"
        command = [sys.executable, "-X", "utf8", "-m", "timesplat.model.io.usd_apart", str(path), str(out)]
        try:
            done = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace", timeout=LONGEST)
        except subprocess.TimeoutExpired:
            raise InputError(f"{path}: the USD library has not read it in {LONGEST:.0f} s; export it again.") from None
        if done.returncode == 0:
            return _from_npz(out)
        lines = done.stderr.strip().splitlines()
        if done.returncode == REFUSED and lines:
            raise InputError(lines[-1])
        how = _how(done.returncode)
        raise InputError(f"{path}: the USD library gave up on it ({how}); it is damaged, export it again.")


def _how(code: int) -> str:
    """Of a process that did not end by itself."""
    if code >= 0:
        return f"exit code {code}"
    with contextlib.suppress(ValueError):
        return signal.Signals(-code).name
    return f"signal {-code}"


def limit_memory() -> None:
    """To half of the machine's, on Linux: a damaged USD file may claim to need any amount. (Windows has no such limit,
    and on macOS an address space is larger than any memory from the start.)"""
    if sys.platform != "linux":
        return
    with contextlib.suppress(OSError, ValueError):
        import resource

        half = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
        resource.setrlimit(resource.RLIMIT_AS, (half, resource.getrlimit(resource.RLIMIT_AS)[1]))


# ---------------------------------------------------------------- what goes between the two


def _to_npz(out: Path, loaded: LoadedAsset) -> None:
    asset = loaded.asset
    arrays = {name: getattr(asset, name) for name in ARRAYS}
    if asset.paths is not None:
        arrays |= {"path": asset.path} | {f"paths.{f.name}": getattr(asset.paths, f.name) for f in fields(Paths)}
    if loaded.motion is not None:
        arrays["motion"] = loaded.motion
    told = json.dumps({"up": loaded.up, "note": loaded.note, "clip": asdict(asset.clip)})
    np.savez(out, told=np.frombuffer(told.encode(), np.uint8), **arrays)


def _from_npz(file: Path) -> LoadedAsset:
    with np.load(file, allow_pickle=False) as found:
        arrays = {name: found[name] for name in found.files}
    told = json.loads(arrays.pop("told").tobytes())
    clip = Clip(**{**told["clip"], "translation": tuple(told["clip"]["translation"])})
    motion = arrays.pop("motion", None)
    riding = {}
    if "path" in arrays:
        paths = Paths(**{f.name: arrays.pop(f"paths.{f.name}") for f in fields(Paths)})
        riding = {"path": arrays.pop("path"), "paths": paths}
    return LoadedAsset(Asset(**arrays, clip=clip, **riding), told["up"], told["note"], motion)


def _main(source: str, out: str) -> int:
    limit_memory()
    try:
        _to_npz(Path(out), load_usd(source))
    except InputError as e:
        print(e, file=sys.stderr)
        return REFUSED
    return 0


if __name__ == "__main__":
    code = _main(*sys.argv[1:])
    sys.stderr.flush()
    os._exit(code)  # of a damaged file the library may die on its way out
