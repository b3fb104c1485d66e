# SPDX-License-Identifier: GPL-3.0-or-later
"""Training data: rendered Sequences, packed once for quick random access, and samples drawn from them."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor
from tqdm import tqdm

from ...datagen.curation.decisions import CURATION, OUT, decided
from ...datagen.curation.measures import motion_of
from ...datagen.readers import DEFAULTS, ReadOptions, described_by, open_sequence, sequences_in
from ...datagen.rigs import CANONICAL
from ...datagen.sequence import InputError, Sequence
from ..views import Views, shrink
from .clip_groups import GROUPS, group_of, group_probabilities
from .view_sampling import ClipLayout, sample_views

PACKED_VERSION = 3  # of packed files; others are made anew


@dataclass
class Sample:
    """Input views, with depth and flow where asked for, and target views; `name` says which clip they are of."""

    inputs: Views
    targets: Views
    name: str


class ClipDataset:
    """Packed clips and random samples of them."""

    def __init__(
        self,
        folders: Iterable[Path],
        cache: Path,
        shrink: int = 1,
        sampling: str = "setups",
        mix: str = "uniform",
        has_depth: bool = True,
        reading: ReadOptions = DEFAULTS,
    ):
        """folders: Sequence folders, or folders that hold them at any depth. Samples are `shrink` times smaller
        than what was rendered. sampling: see view_sampling.py; mix: see clip_groups.py; has_depth: whether inputs come
        with depth and flow; reading: what is said of others' folders. Where `timesplat curate` was called, its sets are
        the groups, and what it threw out is left out. Raises InputError where there is no Sequence, none that the mix
        would draw, or one without the passes that are needed."""
        self.shrink, self.sampling, self.has_depth = shrink, sampling, has_depth
        folders = list(folders)
        found = [p for f in folders for p in sequences_in(f)]
        if not found:
            raise InputError(f"{folders[0]}: no Sequence in it; render some with `timesplat render`.")
        curated = decided(found)
        found = [p for p in found if curated.get(p) != OUT]
        if not found:
            raise InputError(
                f"{folders[0]}: {CURATION} throws out all of its Sequences; put some back by its column override."
            )
        bar = tqdm(found, desc="packing", unit="clip", leave=False, disable=None)
        self.paths = [pack(f, cache, has_depth, reading) for f in bar]
        self.groups: dict[str, list[Path]] = {g: [] for g in GROUPS}
        for folder, path in zip(found, self.paths, strict=True):
            with safe_open(path, "pt") as f:
                self.groups[curated.get(folder) or group_of(f.metadata())].append(path)
        self.probabilities = group_probabilities(mix, {g: len(paths) for g, paths in self.groups.items()})

    def __str__(self) -> str:
        parts = [f"{len(self.groups[g])} {g} ({p:.1%})" for g, p in zip(GROUPS, self.probabilities, strict=True)]
        return f"{sum(map(len, self.groups.values()))} clips: {', '.join(parts)}"

    def sample(self, rng: np.random.Generator, targets: int, inputs: int = 24) -> Sample:
        """A clip at random, and of it at most `inputs` and `targets` views as `sampling` chooses them. Static samples
        are at time 0, and nothing moves in them. Raises InputError where the clip lacks the views for it."""
        group = self.groups[GROUPS[rng.choice(len(GROUPS), p=self.probabilities)]]
        sample = self._read(group[rng.integers(len(group))], rng, targets, inputs)
        for views in (sample.inputs, sample.targets):
            if self.sampling == "static":
                views.time, views.flow = 0 * views.time, None if views.flow is None else 0 * views.flow
        return sample

    def _read(self, path: Path, rng: np.random.Generator, targets: int, inputs: int) -> Sample:
        with safe_open(path, "pt") as f:
            meta = f.metadata()
            frame, camera = f.get_tensor("frame").numpy(), f.get_tensor("camera").numpy()
            clip = ClipLayout(frame, camera, json.loads(meta["cameras"]), meta["asset"])
            step = 2 / max(int(meta["frames"]) - 1, 1)
            input_rows, target_rows = sample_views(self.sampling, rng, clip, inputs, targets)
            seen = shrink(read_views(f, input_rows, step, self.has_depth), self.shrink)
            wanted = shrink(read_views(f, target_rows, step, has_depth=False), self.shrink)
        return Sample(seen, wanted, meta["asset"])


def pack(folder: Path, cache: Path, has_depth: bool = True, reading: ReadOptions = DEFAULTS) -> Path:
    """Sequence folder -> one .safetensors below `cache`, made anew when the Sequence changed. has_depth: whether depth
    and flow are needed; where they are not, a Sequence that lacks them for a view is packed without any, by another
    name. Raises InputError for a Sequence that cannot be read, or lacks what is needed."""
    folder = Path(folder)
    stamp = " ".join(str(path.stat().st_mtime_ns) for path in described_by(folder)) or 0
    told = "" if reading == DEFAULTS else f" {reading}"
    key = hashlib.sha256(f"{PACKED_VERSION} {folder.resolve()} {stamp}{told}".encode()).hexdigest()[:16]
    path, pictures = (Path(cache) / f"{key}{end}.safetensors" for end in ("", "-pictures"))
    for made in (path,) if has_depth else (path, pictures):
        if made.exists():
            return made
    seq = open_sequence(folder, reading)
    whole = all(v.passes for v in seq.views)
    if has_depth and not whole:
        raise InputError(
            f"{folder}: not every view has a depth pass, which --source given and --geometric need; "
            "render it with passes, or train with --source sweep or predicted alone."
        )
    path = path if whole else pictures
    tensors = packed_tensors(seq, whole)
    names = camera_names(seq)
    meta = {
        "cameras": json.dumps(names),
        "frames": str(seq.frame_end - seq.frame_start + 1),
        "asset": str(seq.provenance.get("asset", folder.parent.name)),
        "motion": str(motion_of(canonical_pictures(tensors, names))),
        "displaced": str(bool(seq.provenance.get("settings", {}).get("displace"))),
        "licence": str(seq.provenance.get("licence", "")),
        "author": str(seq.provenance.get("author", "")),
    }
    Path(cache).mkdir(parents=True, exist_ok=True)
    tmp = path.with_suffix(f".{os.getpid()}.tmp")  # several trainings may pack at a time
    save_file(tensors, tmp, meta)
    tmp.replace(path)
    return path


def camera_names(seq: Sequence) -> list[str]:
    """Of all cameras, in the order by which packed clips number them."""
    return sorted({v.camera for v in seq.views})


def packed_tensors(seq: Sequence, has_depth: bool) -> dict[str, Tensor]:
    """What a packed clip of V views holds: rgba (V,H,W,5) uint8, whose fifth channel says where depth is known;
    values (K,5) float16, depth and the two flows of those K pixels alone, view by view; offsets (V+1,) into them;
    c2w (V,4,4), intrinsics (V,4), time (V,) as Views have them; frame (V,) from 0; camera (V,), its number."""
    rgba, values, offsets = [], [], [0]
    for i in range(len(seq.views)):
        image = seq.load_image(i)
        known, stack = np.zeros(image.shape[:2], bool), np.zeros((*image.shape[:2], 5))
        if has_depth:
            passes = seq.load_passes(i)
            known = np.isfinite(passes.depth) & (image[..., 3] > 0)
            depth = np.where(known, passes.depth, 0)[..., None]
            stack = np.concatenate([depth, passes.flow_next, passes.flow_prev], -1)
        rgba.append(np.concatenate([image, known[..., None].astype(np.uint8)], -1))
        values.append(stack[known].astype(np.float16))
        offsets.append(offsets[-1] + int(known.sum()))
    c2w, intrinsics = seq.cameras()
    names = camera_names(seq)
    return {
        "rgba": torch.from_numpy(np.stack(rgba)),
        "values": torch.from_numpy(np.concatenate(values)),
        "offsets": torch.tensor(offsets),
        "c2w": torch.from_numpy(c2w),
        "intrinsics": torch.from_numpy(intrinsics),
        "time": torch.from_numpy(seq.times()),
        "frame": torch.tensor([v.frame - seq.frame_start for v in seq.views]),
        "camera": torch.tensor([names.index(v.camera) for v in seq.views]),
    }


def canonical_pictures(tensors: dict[str, Tensor], names: list[str]) -> list[np.ndarray]:
    """(F,H,W,4) uint8 of each canonical camera of a packed clip (tensors: see `packed_tensors`; its cameras' names)."""
    chosen = [names.index(name) for name in CANONICAL if name in names]
    return [tensors["rgba"][tensors["camera"] == i][..., :4].numpy() for i in chosen]


def read_views(packed, rows: np.ndarray, frame_step: float, has_depth: bool) -> Views:
    """Views `rows` (n,) of an open packed clip, with depth and flow where asked for."""
    # get_slice takes no index lists: whole tensors are memory-mapped, and only these rows are touched.
    rows = torch.from_numpy(np.asarray(rows))
    pixels = packed.get_tensor("rgba")[rows]
    rgba = pixels[..., :4].float() / 255
    tensors = [packed.get_tensor(k)[rows] for k in ("c2w", "intrinsics", "time")]
    views = Views(rgba[..., :3], rgba[..., 3], *tensors, frame_step)
    if not has_depth:
        return views
    offsets, values = packed.get_tensor("offsets"), packed.get_tensor("values")
    known = pixels[..., 4] > 0
    depth = torch.full(known.shape, torch.inf)
    flow = torch.zeros(*known.shape, 4)
    for n, i in enumerate(rows.tolist()):
        v = values[offsets[i] : offsets[i + 1]].float()
        depth[n][known[n]], flow[n][known[n]] = v[:, 0], v[:, 1:]
    return replace(views, depth=depth, flow=flow)
