# SPDX-License-Identifier: GPL-3.0-or-later
"""A contact sheet of a Sequence, to judge a data set by eye: every camera over time, and where there are passes its
first camera's depth (near is dark) and motion (hue is the direction, saturation the length).

    python -m timesplat.evaluation.contact_sheet data/fox/fox/Run sheet.png --frames 8
"""

from __future__ import annotations

import argparse
import io
import sys
from pathlib import Path

import numpy as np
import torch

from ..datagen.readers import open_sequence
from ..datagen.sequence import Sequence
from ..datagen.whole_folders import write_whole
from ..exit_codes import exit_code
from ..model.views import load_views
from .pictures import grid


def contact_sheet(seq: Sequence, frames: int):
    """-> PIL image: a row a camera, `frames` columns evenly spread over the clip."""
    chosen = np.unique(np.linspace(seq.frame_start, seq.frame_end, frames).round().astype(int))
    cameras: dict[str, dict[float, int]] = {}
    rigs: dict[str, set] = {}
    for v in seq.views:
        rigs.setdefault(v.camera, set()).add(v.rig)
    for i, v in enumerate(seq.views):
        name = v.camera if len(rigs[v.camera]) == 1 else f"{v.camera}, {v.rig}"
        cameras.setdefault(name, {})[v.frame] = i
    rows: dict[str, torch.Tensor] = {}
    taken = {name: [at.get(f) for f in chosen] for name, at in cameras.items()}
    shown = {name: indices for name, indices in taken.items() if any(i is not None for i in indices)}
    for name, indices in shown.items():
        rows[name] = torch.stack([_picture(seq, i) for i in indices])
    name, indices = next(iter(shown.items()))
    whole = [i for i in indices if i is not None and seq.views[i].passes]
    if len(whole) == len(indices):
        views = load_views(seq, whole, has_depth=True)
        assert views.depth is not None and views.flow is not None
        rows[f"depth, {name}"] = _depth(views.depth)
        rows[f"motion, {name}"] = _motion(views.flow[..., :2].nan_to_num(0).numpy())
    return grid(rows, [f"frame {f}" for f in chosen])


def _picture(seq: Sequence, index: int | None) -> torch.Tensor:
    if index is None:  # this camera took none then
        return torch.full((seq.height, seq.width, 3), 0.85)
    return load_views(seq, [index]).over()[0]


def _depth(depth: torch.Tensor) -> torch.Tensor:
    """depth (n,H,W), infinite behind the object -> (n,H,W,3) grey values, white there."""
    near, far = depth[depth.isfinite()].aminmax()
    grey = ((depth - near) / (far - near).clamp(min=1e-6) * 0.8).nan_to_num(1.0, 1.0, 1.0)
    return torch.where(depth.isfinite(), grey, 1.0)[..., None].expand(-1, -1, -1, 3)


def _motion(flow: np.ndarray) -> torch.Tensor:
    """flow (n,H,W,2) in pixels a frame -> (n,H,W,3)."""
    from matplotlib.colors import hsv_to_rgb

    length = np.linalg.norm(flow, axis=-1)
    hue = (np.arctan2(flow[..., 1], flow[..., 0]) / (2 * np.pi)) % 1
    most = max(float(np.percentile(length[length > 0], 98)) if (length > 0).any() else 1.0, 1e-6)
    saturation = np.clip(length / most, 0, 1)
    return torch.from_numpy(hsv_to_rgb(np.stack([hue, saturation, np.ones_like(hue)], -1)).astype(np.float32))


def main(argv: list[str] | None = None) -> int:
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("sequence", type=Path, help="folder that `timesplat render` wrote")
    p.add_argument("out", type=Path, help=".png to write")
    p.add_argument("--frames", type=int, default=8, help="columns (default: 8)")
    args = p.parse_args(argv)
    return exit_code("contact_sheet", lambda: write_contact_sheet(args.sequence, args.out, args.frames))


def write_contact_sheet(folder: Path, out: Path, frames: int) -> None:
    """The contact sheet of the Sequence in a folder as a .png, whole or not at all. Raises InputError."""
    data = io.BytesIO()
    contact_sheet(open_sequence(folder), frames).save(data, "PNG", optimize=True)
    write_whole(out, data.getvalue())
    print(out)


if __name__ == "__main__":
    sys.exit(main())
