# SPDX-License-Identifier: GPL-3.0-or-later
"""What a folder of pictures and cameras holds, and whether it fits together: in sentences, before hours are spent.

The cameras agree where the silhouettes of all of them fit one object. Where they do not, every other reading of their
axes is tried, and the one that fits is said. numpy and Pillow alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from .readers import arranged, volume
from .readers.options import AXES, ReadOptions
from .readers.placing import looked_at, shows_object, silhouettes_of, small_masks
from .sequence import InputError, Sequence, opengl_to_opencv

FITS = 0.6  # the least share of the silhouettes that fit together where cameras are right
BETTER = 0.2  # by how much more another reading must fit to be told
NEAR = 30.0  # degrees within which a camera sees a side of the object
CAMERAS, EACH = 6, 8  # of whose pictures light and sharpness are looked at
JUMP = 0.25  # of the median brightness: more than that from one picture to others of its camera is told
BLURRED = 0.25  # of the median sharpness: less than that is told


@dataclass
class Inspection:
    """A Sequence as it was found, normalised where that was possible, and what there is to be said of it."""

    seq: Sequence
    counts: str
    agreement: str
    advice: str | None = None  # what to pass, where something else fits better
    warnings: list[str] = field(default_factory=list)
    placed: bool = True  # whether it was found where the object is

    @property
    def lines(self) -> list[str]:
        """All of it."""
        more = [self.advice] if self.advice else []
        return [self.counts, *self.seq.provenance.get("read", [])[1:], self.agreement, *more, *self.warnings]


def inspect(folder: Path, options: ReadOptions) -> Inspection:
    """Raises InputError for what cannot be read at all; cameras that do not agree are told instead."""
    found = arranged(folder, options)
    world, stated, advice = found.world, found.axes, None
    masks = small_masks(world) if shows_object(world) else None  # seconds for hundreds of pictures: once
    fits = {} if found.matrices is None or masks is None else readings(world, found.matrices, masks)
    best = max(fits, key=lambda a: fits[a], default=stated)
    if fits and best != stated and fits[best] > max(FITS, fits[stated] + BETTER):
        advice = (
            f"the cameras fit best when they are read as {best} ({fits[best]:.0%}, as {stated} {fits[stated]:.0%}): "
            f"pass --axes {best}"
        )
    try:
        seq, placed = found.place(masks), True
    except InputError:
        if advice is None:
            raise
        seq, placed = world, False
    return Inspection(
        seq,
        counts(seq),
        agreement(seq, masks),
        advice,
        [*(lying(seq) if placed and advice is None else []), *repeated(seq), *gaps(seq), *light(seq)],
        placed,
    )


def counts(seq: Sequence) -> str:
    """How many pictures, cameras and moments there are, of which size and rate."""
    inputs = [v for v in seq.views if not v.held_out]
    moments = len({v.frame for v in seq.views})
    held = len(seq.views) - len(inputs)
    clip = f"{moments} moments, {seq.fps:g} a second" if moments > 1 else "1 moment"
    poses = len({(v.camera, v.rig) for v in seq.views})
    what = f"{seq.provenance.get('format', 'Sequence')}: {len(seq.views)} pictures by {poses} cameras of {clip}"
    return f"{what}, {seq.width}x{seq.height} pixels" + f"; {held} are held out" * bool(held)


def agreement(seq: Sequence, masks: np.ndarray | None) -> str:
    """Whether the cameras look at one object, and which sides they see. masks: `small_masks`, None where nothing tells
    the object."""
    around = f"they see {coverage(seq):.0%} of its sides"
    if masks is None:
        place = np.array([v.c2w[:3, 3] for v in seq.views])
        axis = np.array([-v.c2w[:3, 2] for v in seq.views])
        met = volume.common_point(place, axis)
        if met is None:
            return "the cameras all look the same way"
        off = _miss(place, axis, met[0]) / np.median(met[1])
        front = (met[1] > 0).mean()
        return (
            f"{front:.0%} of the cameras look at one place, their axes pass it at {off:.0%} of its distance; {around}"
        )
    sil = silhouettes_of(seq, masks)
    if not sil.masks.any():
        return "no picture shows anything of an object"
    box = volume.box_of(sil)
    if box is None:
        return "the cameras do not agree: their silhouettes have no place in common"
    fit = float(np.nanmean(box.agreement))
    misses = []
    for w in np.unique(sil.window):
        mine = (sil.window == w) & sil.whole  # the middle of what a border cuts is elsewhere
        part = volume.Silhouettes(*(x[mine] for x in (sil.masks, sil.c2w, sil.intrinsics, sil.window)))
        place, direction = volume.centroid_rays(part)
        if len(place) > 2 and (met := volume.common_point(place, direction)):
            misses.append(_miss(place, direction, met[0]) / np.median(np.abs(met[1])))
    rays = f"rays through their middles pass one point at {np.median(misses):.1%} of its distance; " if misses else ""
    agree = "agree" if fit > 0.85 else "agree in part"
    return f"the cameras {agree}: {fit:.0%} of the silhouettes fit one object; {rays}{around}"


def _miss(place: np.ndarray, direction: np.ndarray, point: np.ndarray) -> float:
    """The median distance at which rays pass a point."""
    return float(np.median(np.linalg.norm(np.cross(point - place, direction), axis=1)))


def readings(seq: Sequence, matrices: list[np.ndarray], masks: np.ndarray) -> dict[str, float]:
    """How well the silhouettes fit together, 0..1, in every reading of the cameras' axes; none where they are empty.
    matrices: (4,4) as they are written, of each view; masks: `small_masks`."""
    views, _ = looked_at(seq)
    sil = silhouettes_of(seq, masks)
    if not sil.masks.any():
        return {}
    out = {}
    for axes, read in AXES.items():
        c2w = np.stack([read(matrices[i]) for i in views])
        if (np.linalg.det(c2w[:, :3, :3]) < 0).any():
            out[axes] = 0.0
            continue
        turned = replace(sil, c2w=opengl_to_opencv(c2w))
        hull = volume.hull_of(turned)
        out[axes] = 0.0 if hull is None else float(np.nanmean(volume.agreement(turned, hull)))
    return out


def coverage(seq: Sequence) -> float:
    """The share of the directions around the object that some camera that is not held out sees within 30 degrees."""
    n = 400
    z = 1 - 2 * (np.arange(n) + 0.5) / n
    angle = np.pi * (3 - 5**0.5) * np.arange(n)
    sides = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], -1)
    place = np.array([v.c2w[:3, 3] for v in seq.views if not v.held_out]).reshape(-1, 3)
    middle = np.mean(np.array(seq.aabb, float), 0)
    direction = place - middle
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    return float((sides @ direction.T > np.cos(np.radians(NEAR))).any(1).mean()) if len(place) else 0.0


def repeated(seq: Sequence) -> list[str]:
    """Views that are there twice: the same file, or the same camera at the same moment."""
    files = [v.image for v in seq.views]
    poses = [(v.frame, *np.round(v.c2w, 6).ravel()) for v in seq.views]
    out = []
    if twice := len(files) - len(set(files)):
        out.append(f"{twice} pictures are listed twice")
    elif twice := len(poses) - len(set(poses)):
        out.append(f"{twice} pictures have the camera and the moment of another")
    return out


def gaps(seq: Sequence) -> list[str]:
    """Times at which no camera looked, where that is much longer than elsewhere."""
    moments = np.unique([v.frame for v in seq.views if not v.held_out])
    if len(moments) < 3:
        return []
    steps = np.diff(moments)
    k = int(steps.argmax())
    if steps[k] < 3 * np.median(steps):
        return []
    often = f"elsewhere every {np.median(steps):g}"
    return [f"no camera looked between the frames {moments[k]:g} and {moments[k + 1]:g}, {often}"]


def up_axis(seq: Sequence) -> int:
    """The axis, 0 to 2, along which most of the cameras' upper sides point; less 3 where they point against it."""
    mean = np.mean([v.c2w[:3, 1] for v in seq.views], 0)
    axis = int(np.abs(mean).argmax())
    return axis if mean[axis] >= 0 else axis - 3


def lying(seq: Sequence) -> list[str]:
    """That what is up for the cameras is not what is up in Blender."""
    axis = up_axis(seq)
    if axis == 2:
        return []
    return [
        f"up is {'-' * (axis < 0)}{'xyz'[axis]} for its cameras, not z as in Blender: the asset will lie as they do"
    ]


def light(seq: Sequence) -> list[str]:
    """Pictures that are much brighter or darker than others of their camera, and blurred ones; of some cameras."""
    by_camera: dict[str, list[int]] = {}
    for i, v in enumerate(seq.views):
        if not v.held_out:
            by_camera.setdefault(v.camera, []).append(i)
    if all(len(x) < EACH for x in by_camera.values()):  # one that is carried around
        groups = [_spread([i for x in by_camera.values() for i in x], CAMERAS * EACH)]
    else:
        groups = [_spread(x, EACH) for x in _spread(list(by_camera.values()), CAMERAS)]
    dark, blurred = [], []
    for group in groups:
        bright, sharp = np.array([_light_and_edges(seq, i) for i in group]).T
        if len(groups) > 1:  # from different sides an object is not equally bright
            usual = np.nanmedian(bright)
            dark += [i for i, b in zip(group, bright, strict=True) if abs(b - usual) > JUMP * usual]
        blurred += [i for i, s in zip(group, sharp, strict=True) if s < BLURRED * np.nanmedian(sharp)]
    count = sum(map(len, groups))
    out = []
    for found, what in ((dark, "much brighter or darker than others of their camera"), (blurred, "blurred")):
        if found:
            names = ", ".join(seq.views[i].image for i in found[:3]) + " and others" * (len(found) > 3)
            out.append(f"{len(found)} of {count} pictures are {what}: {names}")
    return out


def _spread(items: list, count: int) -> list:
    return [items[k] for k in np.unique(np.linspace(0, len(items) - 1, count).round().astype(int))] if items else []


def _light_and_edges(seq: Sequence, index: int) -> tuple[float, float]:
    """Mean brightness of a view's object, and mean second difference; nan where it shows next to nothing of it."""
    rgba = seq.load_image(index).astype(np.float32) / 255
    inside, grey = rgba[1:-1, 1:-1, 3] > 0.5, rgba[..., :3].mean(-1)
    if inside.sum() < 16:
        return np.nan, np.nan
    edge = np.abs(4 * grey[1:-1, 1:-1] - grey[:-2, 1:-1] - grey[2:, 1:-1] - grey[1:-1, :-2] - grey[1:-1, 2:])
    return float(grey[1:-1, 1:-1][inside].mean()), float(edge[inside].mean())
