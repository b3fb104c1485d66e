# SPDX-License-Identifier: GPL-3.0-or-later
"""Training data: rendered Sequences, packed once for quick random access, and samples drawn from them."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor
from tqdm import tqdm

from ..datagen.rigs import CANONICAL
from ..datagen.sequence import InputError, read_sequence
from .views import Views

# How the input views of a sample are chosen, and how often. Every one gives a view for each frame, as the
# paper's evaluation setups do; `every` takes any camera at each frame.
SAMPLERS = {"alternating": 0.4, "interpolation": 0.1, "moving": 0.15, "every": 0.35}


@dataclass
class Sample:
    """Input views with depth and flow, and the target views; `name` says which clip they are of."""

    inputs: Views
    targets: Views
    name: str


def pack(folder: Path, cache: Path) -> Path:
    """Sequence folder -> one .safetensors below `cache`, made anew when the Sequence changed. Depth and
    flow are kept for foreground pixels alone, in half precision."""
    folder = Path(folder)
    stamp = (folder / "transforms.json").stat().st_mtime_ns if (folder / "transforms.json").is_file() else 0
    key = hashlib.sha256(f"{folder.resolve()} {stamp}".encode()).hexdigest()[:16]
    path = Path(cache) / f"{key}.safetensors"
    if path.exists():
        return path
    seq = read_sequence(folder)
    rgba, values, offsets = [], [], [0]
    for i in range(len(seq.views)):
        passes = seq.load_passes(i)
        image = seq.load_image(i)
        known = np.isfinite(passes.depth) & (image[..., 3] > 0)
        depth = np.where(known, passes.depth, 0)[..., None]
        stack = np.concatenate([depth, passes.flow_next, passes.flow_prev], -1)
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
    }
    Path(cache).mkdir(parents=True, exist_ok=True)
    tmp = path.with_suffix(".tmp")
    save_file(tensors, tmp, meta)
    tmp.replace(path)
    return path


class Clips:
    """Packed clips and random samples of them."""

    def __init__(self, folders: list[Path], cache: Path, shrink: int = 1):
        """folders: Sequence folders, or folders that hold them at any depth. Samples are `shrink` times smaller
        than what was rendered. Raises InputError where there is no Sequence."""
        self.shrink = shrink
        found = [p.parent for f in folders for p in sorted(Path(f).rglob("transforms.json"))]
        if not found:
            raise InputError(f"{folders[0]}: no Sequence in it; render some with `timesplat render`.")
        self.paths = [pack(f, cache) for f in tqdm(found, desc="packing", unit="clip", leave=False, disable=None)]

    def sample(self, rng: np.random.Generator, targets: int, views: int = 24) -> Sample:
        """A clip at random, `views` input views by one of SAMPLERS, and `targets` other views of any time,
        those from moving cameras three times as likely as those from the canonical four."""
        path = self.paths[rng.integers(len(self.paths))]
        with safe_open(path, "pt") as f:
            meta = f.metadata()
            frame, camera = f.get_tensor("frame").numpy(), f.get_tensor("camera").numpy()
            names = json.loads(meta["cameras"])
            chosen = choose_inputs(rng, frame, camera, names, views)
            canonical = np.isin(camera, [names.index(c) for c in CANONICAL if c in names])
            weight = np.where(canonical, 1.0, 3.0)
            weight[chosen] = 0
            picked = rng.choice(len(frame), targets, replace=False, p=weight / weight.sum())
            step = 2 / max(int(meta["frames"]) - 1, 1)
            inputs, held_out = (shrink(_views(f, i, step), self.shrink) for i in (chosen, picked))
            return Sample(inputs, held_out, meta["asset"])


def choose_inputs(rng, frame, camera, names: list[str], views: int) -> np.ndarray:
    """Indices of the input views of a sample: at most `views`, in the order of time. Of the kind's cameras
    those are taken that have a view at the frame; all that have one where none of them does."""
    kinds = list(SAMPLERS)
    kind = kinds[rng.choice(len(kinds), p=list(SAMPLERS.values()))]
    canonical = np.isin(camera, [names.index(c) for c in CANONICAL if c in names])
    wanted = {"moving": ~canonical, "every": np.ones_like(canonical)}.get(kind, canonical)
    start = rng.integers(len(names))
    found: list[int] = []
    for n, t in enumerate(np.unique(frame)):
        here = np.flatnonzero(frame == t)
        pool = here[wanted[here]] if wanted[here].any() else here
        pool = sorted(pool, key=lambda i: _order(names[camera[i]]))
        turn = rng.integers(len(pool)) if kind == "every" else start + n
        if kind != "interpolation":
            found.append(pool[turn % len(pool)])
        elif n % 2 == 0:
            found += {pool[(turn + k) % len(pool)] for k in (0, 1)}
    if len(found) > views:
        found = [found[i] for i in np.sort(rng.choice(len(found), views, replace=False))]
    return np.array(found)


def _order(name: str) -> tuple:
    """Canonical cameras in their cyclic order first, then the others by name."""
    return (list(CANONICAL).index(name), "") if name in CANONICAL else (len(CANONICAL), name)


def _views(f, indices: np.ndarray, step: float) -> Views:
    # get_slice takes no index lists: whole tensors are memory-mapped, and only these rows are touched.
    rows = torch.from_numpy(np.asarray(indices))
    packed = f.get_tensor("rgba")[rows]
    offsets, values = f.get_tensor("offsets"), f.get_tensor("values")
    known = packed[..., 4] > 0
    depth = torch.full(known.shape, torch.inf)
    flow = torch.zeros(*known.shape, 4)
    for n, i in enumerate(rows.tolist()):
        v = values[offsets[i] : offsets[i + 1]].float()
        depth[n][known[n]], flow[n][known[n]] = v[:, 0], v[:, 1:]
    rgba = packed[..., :4].float() / 255
    tensors = [f.get_tensor(k)[rows] for k in ("c2w", "intrinsics", "time")]
    return Views(rgba[..., :3], rgba[..., 3], *tensors, step, depth, flow)


def shrink(views: Views, by: int) -> Views:
    """The views at 1/by of their size: colours and alpha are averaged as light is, depth and motion over the
    surface nearest to the camera in each block."""
    if by == 1:
        return views
    height, width = (n // by for n in views.size)

    def blocks(x: Tensor) -> Tensor:  # (V,H,W,C) -> (V,h,w,by²,C)
        x = x[:, : height * by, : width * by].reshape(len(views), height, by, width, by, -1)
        return x.transpose(2, 3).flatten(3, 4)

    alpha = blocks(views.alpha[..., None])
    total = alpha.mean(3)
    rgb = (blocks(views.rgb) * alpha).mean(3) / total.clamp_min(1e-6)
    depth, flow = blocks(views.depth[..., None]), blocks(views.flow)
    near = depth <= depth.amin(3, keepdim=True) + 0.05
    near &= torch.isfinite(depth)
    count = near.sum(3)
    mean = (torch.where(near, depth, 0.0).sum(3) / count.clamp_min(1))[..., 0]
    flow = torch.where(near, flow, 0.0).sum(3) / count.clamp_min(1) / by
    depth = torch.where(count[..., 0] > 0, mean, torch.inf)
    return Views(rgb, total[..., 0], views.c2w, views.intrinsics / by, views.time, views.frame_step, depth, flow)
