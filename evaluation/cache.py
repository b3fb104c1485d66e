# SPDX-License-Identifier: GPL-3.0-or-later
"""The folder in which an evaluation keeps what it has made, so that the same command goes on where it was:

renders/RIG/OBJECT/CLIP     Sequences                    rows.jsonl      a line for each finished run
scenes/KEY.safetensors      scenes that were asked for
"""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from tqdm import tqdm

from ..datagen.farm import render_assets
from ..datagen.readers import DEFAULTS, ReadOptions, name_of, open_sequence, sequences_in
from ..datagen.render_job import RenderSettings
from ..datagen.sequence import Sequence
from ..model.gaussians import FIELDS, Gaussians4D, ReconstructedScene
from ..model.tracks import LOOKS, Paths, Tracks4D


class Cache:
    """What lies below `folder`; nothing is written before the first row, scene or render."""

    def __init__(self, folder: Path):
        self.folder = Path(folder)
        self.path = self.folder / "rows.jsonl"

    # ---------------------------------------------------------------- Sequences

    def sequences(
        self, assets: list[str], settings: RenderSettings, jobs: int, reading: ReadOptions = DEFAULTS
    ) -> tuple[dict[str, Sequence], list[str]]:
        """Of files and folders: the finished Sequences in them, and those of assets, rendered where they are not yet,
        by name; and one sentence for each asset that failed. reading: what the user says of what is found."""
        found, others = find_sequences(assets, reading)
        if not others:
            return found, []
        with tqdm(total=0, desc="rendering", unit="object", disable=None) as bar:

            def progress(done: int, total: int, images: int) -> None:
                bar.total, bar.n = total, done
                bar.refresh()

            folder = self.folder / "renders" / settings.rig
            made, failures = render_assets(others, folder, settings, jobs=jobs, report=bar.write, progress=progress)
        names = {f: "-".join(f.parent.relative_to(folder).parts) for f in sorted(made)}
        return found | {name: open_sequence(f) for f, name in names.items()}, failures

    # ---------------------------------------------------------------- rows

    def rows(self) -> dict[str, dict]:
        """{key: row}; a line that was cut off is left out."""
        found = {}
        for line in self.path.read_text().splitlines() if self.path.exists() else ():
            try:
                row = json.loads(line)
                found[row["key"]] = row
            except (ValueError, KeyError, TypeError):
                continue
        return found

    def add(self, row: dict) -> None:
        """A line of JSON in one write, so that lines of several processes never mix; a line that was cut off before it
        is ended."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with open(self.path, "a+b", buffering=0) as f:
            start = b""
            if f.tell():
                f.seek(-1, 2)
                start = b"" if f.read(1) == b"\n" else b"\n"
            f.write(start + (json.dumps(row) + "\n").encode())

    def seconds_spent(self) -> float:
        """Seconds by the clock that all sessions that wrote rows took."""
        sessions: dict[float, float] = {}
        for row in self.rows().values():
            sessions[row["session"]] = max(sessions.get(row["session"], 0.0), row["elapsed"])
        return sum(sessions.values())

    # ---------------------------------------------------------------- scenes

    def scene(self, key: str) -> Gaussians4D | Tracks4D | None:
        """The scene of a run that was kept, if it was."""
        path = self._scene_path(key)
        if not path.is_file():
            return None
        tensors = load_file(path)
        if "path" not in tensors:
            return Gaussians4D(**tensors)
        of_paths = {k.removeprefix("paths."): tensors.pop(k) for k in list(tensors) if k.startswith("paths.")}
        return Tracks4D(**tensors, paths=Paths(**of_paths))

    def keep_scene(self, key: str, scene: Gaussians4D | ReconstructedScene) -> None:
        """Keeps a scene of 4D Gaussians or of tracks, whole or not at all; other kinds are not kept."""
        if isinstance(scene, Gaussians4D):
            axed = scene.with_axes()
            tensors = {k: getattr(axed, k) for k in FIELDS}
        elif isinstance(scene, Tracks4D):
            tensors = {k: getattr(scene, k) for k in (*LOOKS, "path")}
            tensors |= {f"paths.{k}": x for k, x in vars(scene.paths).items()}
        else:
            return
        path = self._scene_path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        tmp = path.with_suffix(".tmp")
        save_file({k: torch.clone(x).contiguous() for k, x in tensors.items()}, tmp)
        tmp.replace(path)

    def _scene_path(self, key: str) -> Path:
        return self.folder / "scenes" / f"{key}.safetensors"


def find_sequences(assets: list[str], reading: ReadOptions = DEFAULTS) -> tuple[dict[str, Sequence], list[str]]:
    """Of files and folders: the finished Sequences in them by name, and those that hold none and are to be rendered."""
    folders, others = [], []
    for asset in assets:
        found = sequences_in(Path(asset))
        folders += found
        others += [] if found else [asset]
    return {n: open_sequence(f, reading) for n, f in name_sequences(folders).items()}, others


def name_sequences(folders: list[Path]) -> dict[str, Path]:
    """{name: folder}: see `name_of`; with the folder above where several are called so, as an object's clips are."""
    objects = [name_of(f) for f in folders]
    names = [
        o if objects.count(o) == 1 else f"{f.absolute().parent.name}/{f.name}"
        for o, f in zip(objects, folders, strict=True)
    ]
    return dict(zip(names, folders, strict=True))
