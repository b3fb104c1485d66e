# SPDX-License-Identifier: GPL-3.0-or-later
"""What the studies are made on: Sequences of the rig `evaluation`, choices of their views, and scores of
methods, each kept as soon as it is known so that an interrupted study goes on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from timesplat.benchmarks.figures import replace as write
from timesplat.datagen.rigs import CANONICAL
from timesplat.datagen.sequence import InputError, Sequence, read_sequence
from timesplat.model.data import shrink
from timesplat.model.evaluate import draw
from timesplat.model.flip import flip
from timesplat.model.metrics import psnr, psnr_foreground, ssim
from timesplat.model.reconstruct import CHECKPOINTS, METHODS, NEEDS_PASSES, WEIGHTS, reconstruct_views
from timesplat.model.views import Views, load_views

# metric -> its column's title, and decimals
METRICS = {"psnr": ("PSNR (dB)", 2), "psnr_fg": ("PSNR fg (dB)", 2), "ssim": ("SSIM", 3), "flip": ("FLIP", 3)}
RENDER = "render it with `timesplat render --rig evaluation --targets 1`"


@dataclass(frozen=True)
class Method:
    """A method of `timesplat reconstruct`, with its own weights or others; `label` is how figures call it."""

    name: str
    label: str
    checkpoint: Path | None = None

    @property
    def stamp(self) -> str:
        """Changes with the method and the weights it loads."""
        path = self.checkpoint or CHECKPOINTS / f"{WEIGHTS.get(self.name, self.name)}.safetensors"
        weights = hashlib.sha256(path.read_bytes()).hexdigest()[:12] if path.is_file() else "-"
        return f"{self.name} {weights}"


def methods(text: str) -> list[Method]:
    """`lift,predicted,mine=predicted@run/network.safetensors` -> Methods: [LABEL=]METHOD[@CHECKPOINT]."""
    found = []
    for word in filter(None, (w.strip() for w in text.split(","))):
        label, _, rest = word.rpartition("=")
        name, _, checkpoint = rest.partition("@")
        if name not in METHODS:
            raise InputError(f"{name}: no such method; choose from {', '.join(METHODS)}.")
        if checkpoint and not Path(checkpoint).is_file():
            raise InputError(f"{checkpoint}: no such checkpoint; train one with `timesplat train`.")
        found.append(Method(name, label or name, Path(checkpoint) if checkpoint else None))
    if not found or len({m.label for m in found}) < len(found):
        raise InputError(f"--methods {text}: name at least one, and each once (LABEL=METHOD tells two alike apart).")
    return found


@dataclass
class Subject:
    """A Sequence under a name, and its pictures at `size` pixels."""

    name: str
    seq: Sequence
    by: int  # the rendered size over the size wanted

    def views(self, indices: Iterable[int], passes: bool = False) -> Views:
        parts = [shrink(blank_passes(load_views(self.seq, [i], passes)), self.by) for i in indices]
        pick = {
            k: torch.cat([getattr(p, k) for p in parts])
            for k in ("rgb", "alpha", "c2w", "intrinsics", "time", "depth", "flow")
        }
        return Views(frame_step=parts[0].frame_step, **pick)

    @property
    def frames(self) -> list[int]:
        return list(range(self.seq.frame_start, self.seq.frame_end + 1))

    def find(self, frame: int, camera: str, rig: str) -> int:
        """Index of a camera's view at a frame. Raises InputError where there is none."""
        found = self.seq.select(frame=frame, camera=camera, rig=rig)
        if not found:
            raise InputError(f"{self.seq.root}: frame {frame} has no view of the {rig} camera {camera}; {RENDER}.")
        return found[0]


def blank_passes(views: Views) -> Views:
    """The views with empty depth and motion where they were loaded without: shrinking wants them."""
    if views.depth is not None:
        return views
    return replace(views, depth=torch.full_like(views.alpha, torch.inf), flow=torch.zeros(*views.alpha.shape, 4))


def subjects(folders: list[Path], size: int) -> list[Subject]:
    """Every Sequence below the folders, named by object (and clip where an object has several)."""
    found = sorted({p.parent for f in folders for p in Path(f).rglob("transforms.json")})
    if not found:
        raise InputError(f"{folders[0]}: no Sequence in it; {RENDER}.")
    objects = [f.parent.name for f in found]
    names = [o if objects.count(o) == 1 else f"{o}/{f.name}" for o, f in zip(objects, found, strict=True)]
    out = []
    for name, folder in zip(names, found, strict=True):
        seq = read_sequence(folder)
        if seq.width != seq.height or seq.width % size:
            raise InputError(f"{folder}: {seq.width}x{seq.height} pixels cannot be shrunk to {size}; choose --size.")
        out.append(Subject(name, seq, seq.width // size))
    return out


# ---------------------------------------------------------------- choices of views, beside those of the protocol


def every(s: Subject, step: int) -> list[int]:
    """One canonical view at every `step`-th frame: front, left, back, right in turn."""
    return [s.find(f, list(CANONICAL)[n % 4], "canonical") for n, f in enumerate(s.frames[::step])]


def at_frame(s: Subject, frame: int, *rigs: str) -> list[int]:
    """All views of these rigs at a frame. Raises InputError where there are none."""
    found = [i for rig in rigs for i in s.seq.select(rig=rig, frame=frame)]
    if not found:
        raise InputError(f"{s.seq.root}: frame {frame} has no view of the rigs {', '.join(rigs)}; {RENDER}.")
    return found


# ---------------------------------------------------------------- scores


def collapse(views: Views) -> Views:
    """One moment: all times 0, nothing moves."""
    flow = None if views.flow is None else torch.zeros_like(views.flow)
    return replace(views, time=torch.zeros_like(views.time), flow=flow, frame_step=2.0)


def thin(views: Views, step: int) -> Views:
    """Views of every `step`-th frame as those of a clip of `step` times fewer frames: motion vectors lead on at
    the same speed to what is the next frame then."""
    flow = None if views.flow is None else views.flow * step
    return replace(views, flow=flow, frame_step=views.frame_step * step)


def score(subject: Subject, method: Method, inputs, targets, still: bool = False, step: int = 1) -> dict:
    """Reconstructs from some views and scores others -> {metric: [a figure per target]}, and the number of
    Gaussians. `still`: with all times collapsed to 0; `step`: the inputs are of every step-th frame."""
    views, truth = thin(subject.views(inputs, method.name in NEEDS_PASSES), step), subject.views(targets)
    if still:
        views, truth = collapse(views), collapse(truth)
    with torch.inference_mode():
        g = reconstruct_views(views, method.name, checkpoint=method.checkpoint)
        g = g[g.alive()]
        rgb, alpha = draw(g, truth)
    target = truth.over(1.0)
    frames = {
        "psnr": psnr(rgb, target),
        "psnr_fg": psnr_foreground(rgb, target, alpha, truth.alpha),
        "ssim": ssim(rgb, target),
        "flip": flip(rgb, target),
    }
    return {k: [round(x, 5) for x in v.tolist()] for k, v in frames.items()} | {"gaussians": len(g)}


class Scores:
    """Scores by key, kept in a file that is written after each new one."""

    def __init__(self, path: Path):
        self.path = path
        self.known: dict[str, dict] = {}
        if path.is_file():
            try:
                self.known = json.loads(path.read_text())
            except json.JSONDecodeError as e:
                raise InputError(f"{path}: it is damaged ({e}); delete it, and the study starts anew.") from None

    def of(self, study: str, subject: Subject, method: Method, inputs, targets, **how) -> dict:
        """`score`, or what is known of it. The key holds all that has a say in it but the code."""
        text = json.dumps([study, list(map(int, inputs)), list(map(int, targets)), how])
        stamp = (subject.seq.root / "transforms.json").stat().st_mtime_ns
        views = hashlib.sha256(f"{text} {subject.seq.root.resolve()} {stamp}".encode()).hexdigest()[:12]
        size = subject.seq.width // subject.by
        key = f"{study} {subject.name} {size} {method.stamp} {views}"
        if key not in self.known:
            self.known[key] = score(subject, method, inputs, targets, **how)
            write(self.path, json.dumps(self.known, indent=0).encode())
        return self.known[key]
