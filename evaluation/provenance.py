# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a figure comes from: the command, the revision of the code, the weights, the machine and its packages."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Provenance:
    """What a table says of how it was made."""

    command: str  # as it would be typed again
    version: str | None = None  # of the package
    revision: str | None = None  # of the checkout that ran; None where the package is installed without one
    clean: bool | None = None  # whether no file of the checkout differed from that revision
    checkpoints: dict[str, str] = field(default_factory=dict)  # file name -> first 12 digits of its SHA-256

    @staticmethod
    def of(command: str, checkpoints: Iterable[Path | None] = ()) -> Provenance:
        """For this command and the code that runs; checkpoints that are None or no files are left out."""
        try:
            installed = version("timesplat")
        except PackageNotFoundError:
            installed = None
        hashes = {p.name: file_hash(p) for p in sorted({p for p in checkpoints if p}) if p.is_file()}
        return Provenance(command, installed, *revision(ROOT), hashes)

    @property
    def caption(self) -> str:
        """Command and code, as pictures have them in small print."""
        return f"{self.command} ({self})"

    def __str__(self) -> str:
        """The line below the command."""
        parts = [f"timesplat {self.version or '(not installed)'}"]
        if self.revision:
            parts.append(f"revision {self.revision}" + ("" if self.clean else " with uncommitted changes"))
        parts += [f"{name} {digest}" for name, digest in self.checkpoints.items()]
        return "; ".join(parts)


def revision(folder: Path) -> tuple[str | None, bool | None]:
    """The commit of the git checkout whose root `folder` is, and whether its files are as committed; (None, None)
    where there is no such checkout, or no git."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", "-C", str(folder), *words], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")).resolve() != folder.resolve():
            return None, None
        return git("rev-parse", "--short=12", "HEAD"), not git("status", "--porcelain")
    except (OSError, subprocess.CalledProcessError):
        return None, None


def file_hash(path: Path) -> str:
    """The first 12 hexadecimal digits of a file's SHA-256."""
    about = path.stat()
    fresh = time.time() - about.st_mtime < 2  # it may be written again at what a file system takes for the same time
    return (_hash.__wrapped__ if fresh else _hash)(path, about.st_mtime_ns, about.st_size)


@lru_cache(maxsize=256)
def _hash(path: Path, changed: int, size: int) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]


def machine() -> dict:
    """What the figures were taken on: processor, cores that may be used, system."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [x.split(":", 1)[1].strip() for x in cpuinfo.read_text().splitlines() if x.startswith("model name")]
        name = names[0] if names else name
    return {"cpu": name, "cores": usable_cores(), "system": f"{platform.system()} {platform.machine()}"}


def usable_cores() -> int:
    """How many processor cores this process may use; of the whole machine where the system does not say (macOS and
    Windows)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions() -> dict:
    """Versions of what has a say in the figures."""
    out: dict[str, str | None] = {"python": platform.python_version()}
    for package in ("timesplat", "torch", "numpy", "numba", "bpy", "usd-core"):
        try:
            out[package] = version(package)
        except PackageNotFoundError:
            out[package] = None
    return out
