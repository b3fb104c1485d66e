# SPDX-License-Identifier: GPL-3.0-or-later
"""Training data: rendered Sequences, packed once for quick random access, and samples drawn from them.

Clips are of three groups, as the paper's data are (appendix, "Dataset Curation"): `hq4d` moves much, but not
wildly; `4d` is all else that moves; `3d` are still objects, displaced or not. The paper draws from them 200:50:1.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor
from tqdm import tqdm

from ...datagen.rigs import CANONICAL
from ...datagen.sequence import InputError, read_sequence, sequences_in
from ..views import Views
from .view_sampling import Layout, choose

VERSION = 2  # of packed files; others are made anew
GROUPS = ("hq4d", "4d", "3d")
# Bounds of `motion_measure`: below the first nothing moves; hq4d lies between the other two. (The paper keeps 3,000
# of 32,000 objects, "sufficient but not overly aggressive"; of 135 of ours, animated files and zoo, 59.)
STILL, SUFFICIENT, AGGRESSIVE = 0.01, 0.25, 0.45


@dataclass
class Sample:
    """Input views, with depth and flow where asked for, and target views; `name` says which clip they are of."""

    inputs: Views
    targets: Views
    name: str


def pack(folder: Path, cache: Path, passes: bool = True) -> Path:
    """Sequence folder -> one .safetensors below `cache`, made anew when the Sequence changed. Depth and
    flow are kept for foreground pixels alone, in half precision. `passes`: whether they are needed; where they are not,
    a Sequence that lacks them for a view is packed without any, by another name. Raises InputError."""
    folder = Path(folder)
    stamp = (folder / "transforms.json").stat().st_mtime_ns if (folder / "transforms.json").is_file() else 0
    key = hashlib.sha256(f"{VERSION} {folder.resolve()} {stamp}".encode()).hexdigest()[:16]
    path, pictures = (Path(cache) / f"{key}{end}.safetensors" for end in ("", "-pictures"))
    for made in (path,) if passes else (path, pictures):
        if made.exists():
            return made
    seq = read_sequence(folder)
    whole = all(v.passes for v in seq.views)
    if passes and not whole:
        raise InputError(
            f"{folder}: not every view has a depth pass, which --source given and --geometric need; "
            "render it with passes, or train with --source sweep or predicted alone."
        )
    path = path if whole else pictures
    rgba, values, offsets = [], [], [0]
    for i in range(len(seq.views)):
        image = seq.load_image(i)
        known, stack = np.zeros(image.shape[:2], bool), np.zeros((*image.shape[:2], 5))
        if whole:
            found = seq.load_passes(i)
            known = np.isfinite(found.depth) & (image[..., 3] > 0)
            depth = np.where(known, found.depth, 0)[..., None]
            stack = np.concatenate([depth, found.flow_next, found.flow_prev], -1)
        rgba.append(np.concatenate([image, known[..., None].astype(np.uint8)], -1))
        values.append(stack[known].astype(np.float16))
        offsets.append(offsets[-1] + int(known.sum()))
    c2w, intrinsics = seq.cameras()
    cameras = [v.camera for v in seq.views]
    names = sorted(set(cameras))
    tensors = {
        "rgba": torch.from_numpy(np.stack(rgba)),  # the fifth channel says where depth is known
        "values": torch.from_numpy(np.concatenate(values)),
        "offsets": torch.tensor(offsets),
        "c2w": torch.from_numpy(c2w),
        "intrinsics": torch.from_numpy(intrinsics),
        "time": torch.from_numpy(seq.times()),
        "frame": torch.tensor([v.frame - seq.frame_start for v in seq.views]),
        "camera": torch.tensor([names.index(c) for c in cameras]),
    }
    meta = {
        "cameras": json.dumps(names),
        "frames": str(seq.frame_end - seq.frame_start + 1),
        "asset": str(seq.provenance.get("asset", folder.parent.name)),
        "motion": str(motion_measure(tensors, names)),
        "displaced": str(bool(seq.provenance.get("settings", {}).get("displace"))),
    }
    Path(cache).mkdir(parents=True, exist_ok=True)
    tmp = path.with_suffix(f".{os.getpid()}.tmp")  # several trainings may pack at a time
    save_file(tensors, tmp, meta)
    tmp.replace(path)
    return path


def motion_measure(tensors: dict[str, Tensor], names: list[str]) -> float:
    """How much a packed clip moves: the greatest L1 distance between two frames of a camera that stands still
    (appendix, "Dataset Curation"), mean over the canonical cameras. 0..1 per colour channel over white, per pixel
    that the object covers at any of the frames, so that slim objects count as stout ones do; NaN where no canonical
    camera has two frames."""
    found = []
    for name in CANONICAL:
        here = (tensors["camera"] == names.index(name)) if name in names else torch.zeros(1, dtype=torch.bool)
        if here.sum() < 2:
            continue
        rgba = tensors["rgba"][here][..., :4].float() / 255
        over = (rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]).flatten(1)
        covered = (rgba[..., 3] > 0).any(0).sum().clamp_min(1)
        found.append(float(torch.cdist(over, over, p=1).max() / (3 * covered)))
    return float(np.mean(found)) if found else float("nan")


def group_of(meta: dict[str, str]) -> str:
    """The group of a packed clip; one of unknown motion is of 4d."""
    motion = float(meta["motion"])
    if meta["displaced"] == "True" or meta["frames"] == "1" or motion < STILL:
        return "3d"
    return "hq4d" if SUFFICIENT <= motion < AGGRESSIVE else "4d"


def parse_mix(text: str) -> dict[str, float] | None:
    """ "200:50:1" -> weight of each group; "uniform" -> None: every clip is as likely. Raises InputError."""
    if text == "uniform":
        return None
    try:
        weights = dict(zip(GROUPS, map(float, text.split(":")), strict=True))
        if min(weights.values()) < 0 or not np.isfinite(sum(weights.values())):
            raise ValueError
    except ValueError:
        raise InputError(f"--mix {text}: not weights of {':'.join(GROUPS)}; write 200:50:1, or uniform.") from None
    return weights


class Clips:
    """Packed clips and random samples of them."""

    def __init__(
        self,
        folders: list[Path],
        cache: Path,
        shrink: int = 1,
        sampling: str = "setups",
        mix: str = "uniform",
        passes: bool = True,
    ):
        """folders: Sequence folders, or folders that hold them at any depth. Samples are `shrink` times smaller
        than what was rendered. sampling: see sampling.py; mix: see `parse_mix`, groups without clips are left out;
        passes: whether inputs come with depth and flow. Raises InputError where there is no Sequence, none that the
        mix would draw, or one without the passes that are needed."""
        self.shrink, self.sampling, self.passes = shrink, sampling, passes
        weights = parse_mix(mix)
        found = [p for f in folders for p in sequences_in(f)]
        if not found:
            raise InputError(f"{folders[0]}: no Sequence in it; render some with `timesplat render`.")
        bar = tqdm(found, desc="packing", unit="clip", leave=False, disable=None)
        self.paths = [pack(f, cache, passes) for f in bar]
        self.groups: dict[str, list[Path]] = {}
        for path in self.paths:
            with safe_open(path, "pt") as f:
                self.groups.setdefault(group_of(f.metadata()), []).append(path)
        counts = {g: len(self.groups.get(g, [])) for g in GROUPS}
        share = {g: counts[g] if weights is None else weights[g] * (counts[g] > 0) for g in GROUPS}
        if not sum(share.values()):
            raise InputError(f"--mix {mix}: none of the clips is of a group with weight; there are {counts}.")
        self.weights = np.array([share[g] for g in GROUPS]) / sum(share.values())

    def __str__(self) -> str:
        parts = [f"{len(self.groups.get(g, []))} {g} ({w:.1%})" for g, w in zip(GROUPS, self.weights, strict=True)]
        return f"{len(self.paths)} clips: {', '.join(parts)}"

    def sample(self, rng: np.random.Generator, targets: int, views: int = 24) -> Sample:
        """A clip at random, and of it at most `views` input and `targets` target views as `sampling` chooses them.
        Static samples are at time 0, and nothing moves in them."""
        group = self.groups[GROUPS[rng.choice(len(GROUPS), p=self.weights)]]
        path = group[rng.integers(len(group))]
        with safe_open(path, "pt") as f:
            meta = f.metadata()
            frame, camera = f.get_tensor("frame").numpy(), f.get_tensor("camera").numpy()
            clip = Layout(frame, camera, json.loads(meta["cameras"]), meta["asset"])
            step = 2 / max(int(meta["frames"]) - 1, 1)
            chosen = choose(self.sampling, rng, clip, views, targets)
            parts = zip(chosen, (self.passes, False), strict=True)
            inputs, held_out = (shrink(_views(f, i, step, passes), self.shrink) for i, passes in parts)
        if self.sampling == "static":
            inputs.time, held_out.time = 0 * inputs.time, 0 * held_out.time
            inputs.flow = inputs.flow if inputs.flow is None else 0 * inputs.flow
        return Sample(inputs, held_out, meta["asset"])


def _views(f, indices: np.ndarray, step: float, passes: bool) -> Views:
    # get_slice takes no index lists: whole tensors are memory-mapped, and only these rows are touched.
    rows = torch.from_numpy(np.asarray(indices))
    packed = f.get_tensor("rgba")[rows]
    rgba = packed[..., :4].float() / 255
    tensors = [f.get_tensor(k)[rows] for k in ("c2w", "intrinsics", "time")]
    views = Views(rgba[..., :3], rgba[..., 3], *tensors, step)
    if not passes:
        return views
    offsets, values = f.get_tensor("offsets"), f.get_tensor("values")
    known = packed[..., 4] > 0
    depth = torch.full(known.shape, torch.inf)
    flow = torch.zeros(*known.shape, 4)
    for n, i in enumerate(rows.tolist()):
        v = values[offsets[i] : offsets[i + 1]].float()
        depth[n][known[n]], flow[n][known[n]] = v[:, 0], v[:, 1:]
    return replace(views, depth=depth, flow=flow)


def shrink(views: Views, by: int) -> Views:
    """The views at 1/by of their size: colours and alpha are averaged as light is, depth and motion, if known, over
    the surface nearest to the camera in each block."""
    if by == 1:
        return views
    height, width = (n // by for n in views.size)

    def blocks(x: Tensor) -> Tensor:  # (V,H,W,C) -> (V,h,w,by²,C)
        x = x[:, : height * by, : width * by].reshape(len(views), height, by, width, by, -1)
        return x.transpose(2, 3).flatten(3, 4)

    alpha = blocks(views.alpha[..., None])
    total = alpha.mean(3)
    rgb = (blocks(views.rgb) * alpha).mean(3) / total.clamp_min(1e-6)
    small = Views(rgb, total[..., 0], views.c2w, views.intrinsics / by, views.time, views.frame_step)
    if views.depth is None or views.flow is None:
        return small
    depth, flow = blocks(views.depth[..., None]), blocks(views.flow)
    near = depth <= depth.amin(3, keepdim=True) + 0.05
    near &= torch.isfinite(depth)
    count = near.sum(3)
    mean = (torch.where(near, depth, 0.0).sum(3) / count.clamp_min(1))[..., 0]
    flow = torch.where(near, flow, 0.0).sum(3) / count.clamp_min(1) / by
    return replace(small, depth=torch.where(count[..., 0] > 0, mean, torch.inf), flow=flow)
