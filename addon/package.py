# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the extension's .zip with Blender's own builder: `python -m timesplat.addon.package [folder]`.

Blender itself is not started: the builder is one file of Python that comes with every Blender and with the
bpy wheel. What goes into the .zip is decided by blender_manifest.toml.
"""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from ..datagen.sequence import InputError
from ..datagen.whole_folders import move

ROOT = Path(__file__).resolve().parent.parent
BUILDER = "scripts/addons_core/bl_pkg/cli/blender_ext.py"


def build(folder: str | Path) -> Path:
    """Writes <folder>/timesplat-<version>.zip, whole or not at all; returns its path. Raises InputError where
    there is no Blender, the builder refuses, or the folder cannot be written."""
    folder = Path(folder)
    tool = [sys.executable, "-X", "utf8", str(_builder())]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as tmp:
            _run([*tool, "build", "--source-dir", str(ROOT), "--output-dir", tmp])
            made = next(Path(tmp).glob("*.zip"))
            _run([*tool, "validate", str(made)])
            move(made, folder / made.name)
    except OSError as e:
        raise InputError(f"{folder}: it cannot be written ({e.strerror or e}); choose another folder.") from None
    return folder / made.name


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace")
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip()).splitlines()
        raise InputError(f"{ROOT}: Blender's builder refused: {said[-1] if said else 'it said nothing'}")


def _builder() -> Path:
    """blender_ext.py of the bpy wheel, or of the `blender` on the search path."""
    places = []
    if spec := importlib.util.find_spec("bpy"):
        places.append(Path(spec.origin).resolve().parent)
    if program := shutil.which("blender"):
        home = Path(program).resolve().parent
        places += [home, home.parent / "Resources"]  # the latter on macOS
    for place in places:
        if found := sorted(place.glob(f"[0-9]*.[0-9]*/{BUILDER}")):
            return found[-1]
    raise InputError("The builder is part of Blender: pip install bpy (timesplat[render]), or put blender on PATH.")


if __name__ == "__main__":
    try:
        print(build(sys.argv[1] if len(sys.argv) > 1 else "dist"))
    except InputError as error:
        sys.exit(str(error))
