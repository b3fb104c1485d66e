# SPDX-License-Identifier: GPL-3.0-or-later
"""From a Sequence to Gaussians4D by a named method, and the checkpoints that methods load."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import torch

from ..datagen.sequence import InputError, Sequence
from .gaussians import DynamicScene, Gaussians4D
from .io.asset import Clip, pixel_size
from .views import Views, load_views, pad_to_multiple

CHECKPOINTS = Path(__file__).parent / "checkpoints"
# What each method is, whose it is, and what it needs: depth and motion vectors, or pictures with alpha alone.
METHODS = {
    "white": "reference: the empty picture",
    "hull": "reference: visual hull in the object's mean colour (RGB and alpha)",
    "lift": "ours: depth and motion vectors to Gaussians, no network",
    "guided": "ours: the network over depth and motion vectors",
    "rgb": "ours: the network over RGB alone: the better of `sweep` and `predicted` on held-out objects",
    "sweep": "ours: the network over RGB with depths swept from the other views",
    "predicted": "the paper's network over RGB, token dropping on",
    "gs-lrm-frame": "after GS-LRM: our network trained without time, each frame from its own views alone",
    "gs-lrm-all": "after GS-LRM: our network trained without time, all views taken for one moment",
    "4dgs": "after 4DGS: 4D Gaussians fitted to the views from random points, for some seconds",
    "som": "after Shape of Motion: one cloud and a few rigid motions fitted to the views, from swept depths, no tracks",
}
NEEDS_PASSES = {"lift", "guided"}
FITTED = {"4dgs", "som"}  # to the scene, for some seconds
# The checkpoint of a method that does not have one of its own name.
WEIGHTS = {"rgb": "sweep", "gs-lrm-frame": "static", "gs-lrm-all": "static"}


def clip_of(seq: Sequence) -> Clip:
    """The Clip that leads an asset of this Sequence back to its scene: at the scene's frames where these are noted and
    lie evenly (a last one that repeats is a scene that holds still), else at the Sequence's own. Its rate is that of
    these frames."""
    first, count = seq.frame_start, seq.frame_end - seq.frame_start + 1
    step, frames = 1, seq.provenance.get("scene_frames")
    if isinstance(frames, list) and len(frames) == count and all(type(f) is int for f in frames):
        apart = frames[1] - frames[0] if count > 1 else 1
        if apart > 0 and frames == [min(frames[0] + i * apart, frames[-1]) for i in range(count)]:
            first, step = frames[0], apart
    n = seq.normalisation
    return Clip(seq.fps * step, first, first + step * (count - 1), n.scale, tuple(n.translation), pixel_size(seq))


def reconstruct(
    sequence: Sequence,
    method: str = "guided",
    indices=None,
    device: str = "cpu",
    checkpoint: Path | None = None,
    progress=None,
    seconds: float = 10.0,
    refine: float = 0.0,
    budget: str | None = None,
    max_loss: float = 0.1,
) -> Gaussians4D | DynamicScene:
    """Views `indices` of the Sequence (all of them by default) -> the scene, Gaussians filtered out that the
    paper's inference filters would never draw. `progress(fraction, text)` is called between steps; `seconds`
    is what methods that fit a scene may take, `refine` the seconds for which the result is then fitted to the
    views (`refine.py`), `budget` how many Gaussians it may have: "N", "P%" or "auto", which keeps within `max_loss`
    dB (`budget.py`).

    Raises InputError for an unknown method, missing passes, a damaged image or checkpoint."""
    report = progress or (lambda fraction, text: None)
    if method not in METHODS:
        raise InputError(f"{method}: no such method; choose one of {', '.join(METHODS)}.")
    report(0.0, "reading views")
    indices = range(len(sequence.views)) if indices is None else indices
    views = load_views(sequence, indices, passes=method in NEEDS_PASSES)
    if not (views.alpha > 0.5).any():
        raise InputError(f"{sequence.root}: no view shows the object; check the cameras and the alpha channel.")
    report(0.3, f"reconstructing ({method})")
    with torch.inference_mode():
        fit = progress and (lambda fraction, text: report(0.3 + 0.7 * fraction, text))
        g = reconstruct_views(views, method, device, checkpoint, seconds, fit, refine, budget, max_loss)
    return g[g.alive()]


def reconstruct_views(
    views: Views,
    method: str,
    device: str = "cpu",
    checkpoint: Path | None = None,
    seconds: float = 10.0,
    progress=None,
    refine: float = 0.0,
    budget: str | None = None,
    max_loss: float = 0.1,
    dense: bool = False,
) -> Gaussians4D | DynamicScene:
    """The same from tensors; unfiltered. `seconds` is for methods that fit a scene, `progress` for what takes
    seconds; `dense`: tokens of a network everywhere, and not only where the object is."""
    if refine or budget:
        from .fitting.budget import reduced
        from .fitting.refine import check_seconds, start_size
        from .fitting.refine import refine as fit

        check_seconds(refine)
        near, drawing = method in NEEDS_PASSES, _draws(device)
        # What is fused into a few thousand Gaussians may start from small pictures, in a quarter of the time.
        seen = views if near or method in FITTED or "%" in (budget or "") else start_size(views)
        start = reconstruct_views(seen, method, device, checkpoint, seconds, dense=dense)
        if budget:
            told = {"near": near, "max_loss": max_loss, "device": drawing, "progress": progress}
            return reduced(start, views, budget, refine, **told)
        return fit(start, views, refine, drawing, near=near, progress=progress)
    if method in ("white", "hull"):
        from .baselines import visual_hull as hull

        return getattr(hull, method)(views)
    if method == "lift":
        from .geometry.lift import lift

        return lift(views)
    if method in FITTED:
        from .baselines.four_dgs import four_dgs
        from .baselines.shape_of_motion import som

        return {"4dgs": four_dgs, "som": som}[method](views, _draws(device), seconds, progress=progress)
    network = load_network(checkpoint or CHECKPOINTS / f"{WEIGHTS.get(method, method)}.safetensors", device)

    def run(views: Views) -> Gaussians4D:
        return apply_network(network, views, device, drop_empty=not dense)

    if method.startswith("gs-lrm"):
        from .baselines import gs_lrm

        return {"gs-lrm-frame": gs_lrm.per_frame, "gs-lrm-all": gs_lrm.all_in}[method](views, run)
    return run(views)


def apply_network(network, views: Views, device: str = "cpu", drop_empty: bool = True) -> Gaussians4D:
    """Views of any size -> what the network makes of them and of their Geometry, on the CPU."""
    views = pad_to_multiple(views, network.config.patch)
    geometry = geometry_for(network.config.source, views)
    return network(views.to(device), geometry and geometry.to(device), drop_empty).to("cpu")


def geometry_for(source: str, views: Views):
    """The Geometry that a network with this depth source starts from (None for `predicted`)."""
    if source == "given":
        from .geometry.lift import lift_geometry

        return lift_geometry(views)
    if source == "sweep":
        from .geometry.plane_sweep import sweep_geometry

        return sweep_geometry(views)
    return None


def save_network(path: Path, network, extra: dict[str, str] | None = None) -> None:
    """Weights in half precision with the config (and `extra` strings) inside, written whole or not at all."""
    from safetensors.torch import save_file

    path = Path(path)
    tensors = {k: v.detach().half().contiguous() for k, v in network.state_dict().items()}
    tmp = path.with_name(path.name + ".tmp")
    save_file(tensors, tmp, {"config": json.dumps(asdict(network.config)), **(extra or {})})
    tmp.replace(path)


def check_device(device: str) -> None:
    """Raises InputError where torch cannot use a device of this name on this machine."""
    try:
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as e:
        reason = str(e).splitlines()[0]
        raise InputError(f"{device}: torch cannot use this device here ({reason}); choose cpu.") from None


def _draws(device: str) -> str:
    """The device that scenes are fitted on: this one if it is CUDA's, else the processor; there is no rasteriser for
    others, such as Apple's."""
    check_device(device)
    return device if torch.device(device).type == "cuda" else "cpu"


def load_network(path: Path, device: str = "cpu"):
    """A network in evaluation mode from a .safetensors with its config inside. Raises InputError."""
    from safetensors import safe_open

    from .network import Config, Network

    check_device(device)
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such checkpoint; train one with `timesplat train`, or name another.")
    try:
        with safe_open(path, "pt") as f:
            config = Config(**json.loads(f.metadata()["config"]))
            tensors = {k: f.get_tensor(k).float() for k in f.keys()}  # noqa: SIM118
        network = Network(config)
        network.load_state_dict(tensors, assign=True)
    except Exception as e:
        reason = str(e).rstrip(".")
        raise InputError(f"{path}: not a whole Timesplat checkpoint ({reason}); copy or train it again.") from None
    bad = [k for k, v in tensors.items() if not torch.isfinite(v).all()]
    if bad:
        raise InputError(f"{path}: the weights {bad[0]} hold NaN or infinity; copy or train it again.")
    return network.to(device).eval()
