# SPDX-License-Identifier: GPL-3.0-or-later
"""What the studies are made on: Sequences of the rig `evaluation`, choices of their views, and scores of
methods, each kept as soon as it is known so that an interrupted study goes on."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import torch

from ..datagen.rigs import CANONICAL
from ..datagen.sequence import InputError, Sequence, read_sequence, sequences_in
from ..model.checkpoints_io import CHECKPOINTS
from ..model.methods import METHODS, ReconstructOptions
from ..model.reconstruct import reconstruct_views
from ..model.views import Views
from . import protocol
from .evaluate import Truth, evaluate_views, load_inputs, load_truth, parse_method
from .figures import replace as write
from .lpips import LPIPS

# metric -> its column's title, and decimals
METRICS = {
    "psnr": ("PSNR (dB)", 2),
    "psnr_fg": ("PSNR fg (dB)", 2),
    "ssim": ("SSIM", 3),
    "lpips": ("LPIPS", 3),
    "flip": ("FLIP", 3),
}
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
        base = parse_method(self.name).name
        path = self.checkpoint or CHECKPOINTS / f"{METHODS[base].checkpoint or base}.safetensors"
        weights = hashlib.sha256(path.read_bytes()).hexdigest()[:12] if path.is_file() else "-"
        return f"{self.name} {weights}"


def methods(text: str) -> list[Method]:
    """`lift,sweep+refine:4,mine=predicted@run/network.safetensors` -> Methods: [LABEL=]METHOD[@CHECKPOINT], METHOD as
    in `timesplat evaluate`."""
    found = []
    for word in filter(None, (w.strip() for w in text.split(","))):
        label, _, rest = word.rpartition("=")
        name, _, checkpoint = rest.partition("@")
        parse_method(name)  # refuses what is none
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
    size: int

    def views(self, indices: list[int], method: Method) -> Views:
        return load_inputs(self.seq, indices, parse_method(method.name).has_depth, self.size)

    def truth(self, inputs: list[int], targets: list[int]) -> Truth:
        novel = protocol.novel(self.seq, inputs, targets)
        return _truth(str(self.seq.root), tuple(targets), tuple(novel), self.size)

    @property
    def frames(self) -> list[int]:
        return list(range(self.seq.frame_start, self.seq.frame_end + 1))

    def find(self, frame: int, camera: str, rig: str) -> int:
        """Index of a camera's view at a frame. Raises InputError where there is none."""
        found = self.seq.select(frame=frame, camera=camera, rig=rig)
        if not found:
            raise InputError(f"{self.seq.root}: frame {frame} has no view of the {rig} camera {camera}; {RENDER}.")
        return found[0]


@lru_cache(maxsize=1)  # methods come one after another on the same truth
def _truth(root: str, targets: tuple[int, ...], novel: tuple[int, ...], size: int) -> Truth:
    return load_truth(read_sequence(Path(root)), list(targets), novel, size)


def subjects(folders: list[Path], size: int) -> list[Subject]:
    """Every Sequence below the folders, named by object (and clip where an object has several)."""
    found = sorted({p for f in folders for p in sequences_in(f)})
    if not found:
        raise InputError(f"{folders[0]}: no Sequence in it; {RENDER}.")
    objects = [f.parent.name for f in found]
    names = [o if objects.count(o) == 1 else f"{o}/{f.name}" for o, f in zip(objects, found, strict=True)]
    out = []
    for name, folder in zip(names, found, strict=True):
        seq = read_sequence(folder)
        if seq.width != seq.height or size < 1 or seq.width % size:
            raise InputError(f"{folder}: {seq.width}x{seq.height} pixels cannot be shrunk to {size}; choose --size.")
        out.append(Subject(name, seq, size))
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


def reconstruct(views: Views, method: Method):
    """The scene, without what the inference filters would never draw."""
    with torch.no_grad():  # methods that fit a scene turn gradients on again
        wanted = parse_method(method.name)
        options = ReconstructOptions(checkpoint=method.checkpoint, refine=wanted.refine or 0.0)
        scene = reconstruct_views(views, wanted.name, options)
    return scene[scene.alive()]


def score(subject: Subject, method: Method, inputs, targets, still: bool = False, step: int = 1) -> dict:
    """Reconstructs from some views and scores others -> {metric: [a figure per target, None where there is
    none]}. `still`: with all times collapsed to 0; `step`: the inputs are of every step-th frame."""
    views, truth = thin(subject.views(inputs, method), step), subject.truth(inputs, targets)
    if still:
        views, truth = collapse(views), replace(truth, views=collapse(truth.views))
    row, _ = evaluate_views(views, method.name, truth, method.checkpoint, LPIPS.find())
    return {k: row["frames"][k] for k in METRICS}


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
        key = f"{study} {subject.name} {subject.size} {method.stamp} {views}"
        if key not in self.known:
            self.known[key] = score(subject, method, inputs, targets, **how)
            write(self.path, json.dumps(self.known, indent=0).encode())
        return self.known[key]
