# SPDX-License-Identifier: GPL-3.0-or-later
"""What a user may say of others' data, where it is not found out, or found out wrongly."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, fields

import numpy as np

from ..sequence import InputError, opengl_to_opencv
from .backgrounds import colour_of

MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])


def _left_handed(m: np.ndarray) -> np.ndarray:
    """Of an engine like Unity, whose world is mirrored, or of cameras alone that are."""
    return m @ MIRROR if np.linalg.det(m[:3, :3]) < 0 else MIRROR @ m @ MIRROR


# How a matrix in a file is to be read, as a camera-to-world matrix in OpenGL axes.
AXES = {
    "opengl": lambda m: m,
    "opencv": opengl_to_opencv,
    "left-handed": _left_handed,
    "w2c-opengl": np.linalg.inv,
    "w2c-opencv": lambda m: opengl_to_opencv(np.linalg.inv(m)),
}


@dataclass(frozen=True)
class ReadOptions:
    """What the user says of others' data; by default all of it is found out."""

    background: str = "auto"  # or white, black, green, #rrggbb: what is behind objects in pictures without alpha
    axes: str | None = None  # of AXES, in place of the convention of the layout
    times: str | None = None  # a pattern for paths, see `times.of_names`, or none
    aabb: tuple[float, ...] | None = None  # x0 y0 z0 x1 y1 z1 of the volume, in the cameras' world
    scale: float | None = None  # half the volume's side, in the cameras' world, around what the cameras look at
    fps: float | None = None  # moments a second: so many are taken of videos, so many pictures have
    scene: bool = False  # all that pictures show is wanted, whatever alpha, masks and backgrounds say

    def __post_init__(self) -> None:
        if self.axes is not None and self.axes not in AXES:
            raise InputError(f"--axes {self.axes}: no such convention; choose {', '.join(AXES)}.")
        if self.background != "auto":
            colour_of(self.background)
            if self.scene:
                raise InputError("--scene takes the background too; leave out --background.")
        if self.aabb is not None:
            low, high = np.array(self.aabb[:3]), np.array(self.aabb[3:])
            if len(self.aabb) != 6 or not (np.isfinite(self.aabb).all() and (low < high).all()):
                raise InputError("--aabb: give x0 y0 z0 x1 y1 z1, each of the first three less than its like.")
        if self.scale is not None and not (np.isfinite(self.scale) and self.scale > 0):
            raise InputError(f"--scale {self.scale:g}: give more than 0.")
        if self.fps is not None and not (np.isfinite(self.fps) and self.fps > 0):
            raise InputError(f"--fps {self.fps:g}: give more than 0.")


def add_arguments(p: argparse.ArgumentParser) -> None:
    """The options on a command line, for others' data."""
    group = p.add_argument_group("what is read of others' data (found out by default)")
    group.add_argument("--background", default="auto", help="what is behind the object in pictures without alpha and "
                       "masks: white, black, green, #rrggbb, or auto: measured at the border (default)")  # fmt: skip
    group.add_argument("--scene", action="store_true", help="reconstruct all that is seen, what lies far away too, and "
                       "not the object alone (default where nothing tells the object)")  # fmt: skip
    group.add_argument("--axes", help=f"how cameras are written: {', '.join(AXES)} (default: as the layout has them)")
    group.add_argument("--times", metavar="PATTERN", help="a regular expression that finds the frame's number in a "
                       "picture's path, in brackets, and perhaps the (?P<camera>…); or none: one moment")  # fmt: skip
    group.add_argument("--aabb", type=float, nargs=6, metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
                       help="the volume that holds the object, in the cameras' world")  # fmt: skip
    group.add_argument("--scale", type=float, help="half the volume's side, in the cameras' world, around what they "
                       "look at")  # fmt: skip
    group.add_argument("--fps", type=float, help="moments a second: so many frames are taken of videos (default: all), "
                       "and so many pictures have whose rate nothing tells")  # fmt: skip


def from_arguments(args: argparse.Namespace) -> ReadOptions:
    """Raises InputError for what cannot be."""
    told = {f.name: getattr(args, f.name) for f in fields(ReadOptions)}
    return ReadOptions(**told | {"aabb": None if args.aabb is None else tuple(args.aabb)})
