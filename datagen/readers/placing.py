# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a Sequence's object is, from its views, and how it is brought into the unit box."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..sequence import InputError, Normalisation, Sequence, opengl_to_opencv
from . import volume
from .options import ReadOptions
from .pictures import Pictures

UNIT = [[-1, -1, -1], [1, 1, 1]]
DOUBTFUL = 0.7  # the least share of the silhouettes that should fit together


def place(
    seq: Sequence, points: np.ndarray | None, options: ReadOptions, path: Path, masks: np.ndarray | None = None
) -> None:
    """Normalises a Sequence whose views are in the cameras' own world, and says how in `provenance["read"]`. points
    (P,3): what is known of its surface; masks: its `small_masks`, where they are known already. Raises InputError
    naming `path` where no picture shows anything, and where the silhouettes, or without any the cameras, have no place
    in common."""
    norm, how, box = _found(seq, points, options, path, masks)
    seq.normalisation, t = norm, np.array(norm.translation)
    seq.aabb = UNIT if box is None else [((x - t) / norm.scale).tolist() for x in box]
    for v in seq.views:
        v.c2w = norm.from_world(v.c2w)
    x, y, z = norm.translation
    seq.provenance["read"].append(f"volume: {how}; ±{norm.scale:.4g} around ({x:.4g}, {y:.4g}, {z:.4g})")


def shows_object(seq: Sequence) -> bool:
    """Whether pictures tell the object from what is behind it."""
    p = seq.picture
    return not isinstance(p, Pictures) or p.has_alpha or p.background is not None


def looked_at(seq: Sequence) -> tuple[list[int], NDArray[np.integer]]:
    """Views that are not held out, spread over the clip, and the window of time that each is of (V,)."""
    inputs = [i for i, v in enumerate(seq.views) if not v.held_out] or list(range(len(seq.views)))
    windows = volume.chosen_views(np.array([seq.views[i].frame for i in inputs]))
    number = np.repeat(np.arange(len(windows)), [len(w) for w in windows])
    return [inputs[k] for window in windows for k in window], number


def small_masks(seq: Sequence) -> np.ndarray:
    """(V,h,w) bool of the views that are `looked_at`. Raises InputError for a picture that cannot be read."""
    return np.stack([_alpha(seq, i) > 0.5 for i in looked_at(seq)[0]])


def silhouettes_of(seq: Sequence, masks: np.ndarray | None = None) -> volume.Silhouettes:
    """The `small_masks` of a Sequence, which are read where they are not given, with its cameras. Raises InputError."""
    views, window = looked_at(seq)
    masks = small_masks(seq) if masks is None else masks
    return volume.Silhouettes(masks, *small_cameras(seq, views, masks.shape[2], masks.shape[1]), window)


def small_cameras(seq: Sequence, views: list[int], width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """c2w (V,4,4) in OpenCV axes, and intrinsics (V,4) fx fy cx cy in pixels of pictures of another size."""
    c2w = opengl_to_opencv(np.stack([seq.views[i].c2w for i in views]))
    intrinsics = np.array([[v.fx, v.fy, v.cx, v.cy] for v in (seq.views[i] for i in views)])
    return c2w, intrinsics * ([width / seq.width, height / seq.height] * 2)


def _alpha(seq: Sequence, index: int) -> np.ndarray:
    """(h,w) 0..1 of a view at the size of silhouettes."""
    from .pictures import shrunk

    if isinstance(seq.picture, Pictures):
        return seq.picture.alpha(seq.views[index], volume.SIDE)
    return shrunk(seq.load_image(index)[..., 3], volume.SIDE)


def _found(
    seq: Sequence, points: np.ndarray | None, options: ReadOptions, path: Path, known: np.ndarray | None
) -> tuple[Normalisation, str, tuple[np.ndarray, np.ndarray] | None]:
    """What leads from the unit box to the cameras' world, how it was found, and the object's box there, if known."""
    if options.aabb:
        low, high = np.array(options.aabb[:3]), np.array(options.aabb[3:])
        return volume.normalisation_around(low, high), "the box that --aabb says", (low, high)
    if shows_object(seq):
        sil = silhouettes_of(seq, known)
        if not sil.masks.any():
            raise InputError(f"{path}: no picture shows anything of an object; check masks and background.")
        box = volume.box_of(sil)
        if box is None:
            raise InputError(
                f"{path}: its cameras do not look at one object: the silhouettes have no place in common; "
                "`timesplat inspect` says whether another reading of the axes fits."
            )
        if (fit := float(np.nanmean(box.agreement))) < DOUBTFUL:
            seq.provenance["read"].append(
                f"only {fit:.0%} of the silhouettes fit together: `timesplat inspect` says whether another reading of "
                "the axes fits better"
            )
        norm = volume.normalisation_around(box.low, box.high, box.points)
        if options.scale:
            norm = Normalisation(options.scale, norm.translation)
            return norm, "as large as --scale says, around the silhouettes", (box.low, box.high)
        return norm, f"the visual hull of {len(sil.masks)} silhouettes, {fit:.0%} fit", (box.low, box.high)
    at = np.array([v.c2w[:3, 3] for v in seq.views])
    axis = np.array([-v.c2w[:3, 2] for v in seq.views])
    slope = np.array([min(seq.width / v.fx, seq.height / v.fy) / 2 for v in seq.views])
    norm = volume.normalisation_of_views(at, axis, slope, path)
    if options.scale:
        return (
            Normalisation(options.scale, norm.translation),
            "as large as --scale says, around what is looked at",
            None,
        )
    if points is not None and len(points):
        views = list(range(len(seq.views)))
        masks = np.broadcast_to(np.array(True), (len(views), seq.height, seq.width))
        frusta = volume.Silhouettes(masks, *small_cameras(seq, views, seq.width, seq.height), np.zeros(len(views), int))
        reach = float(np.median(np.linalg.norm(at - norm.translation, axis=1)))
        if seen := volume.bounds_of_points(points, frusta, reach, np.array(norm.translation)):
            return volume.normalisation_around(*seen), f"what half of the cameras see of {len(points)} points", seen
    return norm, "what the cameras look at together", None
