# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a figure comes from: the command, the revision of the code, and the weights that it was made with."""

from __future__ import annotations

import hashlib
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache
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
    def of(command: str, checkpoints: Iterable[Path] = ()) -> Provenance:
        """For this command and the code that runs; checkpoints that are no files are left out."""
        try:
            installed = version("timesplat")
        except PackageNotFoundError:
            installed = None
        hashes = {p.name: file_hash(p) for p in sorted(set(checkpoints)) if p.is_file()}
        return Provenance(command, installed, *revision(ROOT), hashes)

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


@cache
def file_hash(path: Path) -> str:
    """The first 12 hexadecimal digits of a file's SHA-256."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]
