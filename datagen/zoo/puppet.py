# SPDX-License-Identifier: GPL-3.0-or-later
"""The puppet that every family of the procedural zoo is built from: joints, skin, paint. numpy only.

All frames are posed at once: a joint is a stack of F matrices, a part is F point sets, and nothing needs
an armature. Characters face -Y and stand on z = 0, as in Blender.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, field

import numpy as np

from .shapes import apply, blob, lumpy, on_blob, rotation, scaling, spline, translation, tube

FRAMES = 24  # of every clip of the zoo
TAU = 2 * np.pi
PATTERNS = ("flat", "stripes", "checker", "noise", "patches", "gradient", "spots", "cells", "tiles", "belly")


@dataclass
class Paint:
    """A material: `colours` (sRGB) spread by a `pattern` over rest positions, `scale` patterns per size."""

    colours: list
    pattern: str = "flat"
    scale: float = 4.0
    axis: int = 1
    roughness: float = 0.7
    metallic: float = 0.0
    alpha: float = 1.0  # 0: seen through


@dataclass
class Part:
    """A piece of skin: `rest` (V, 3) carries the pattern, `posed` (F, V, 3) is where it goes."""

    name: str
    rest: np.ndarray
    posed: np.ndarray
    faces: list
    paint: str
    flat: bool


def colour(hue: float, saturation: float, value: float) -> tuple:
    """sRGB from hue (any real number), saturation and value (clipped)."""
    return colorsys.hsv_to_rgb(hue % 1.0, float(np.clip(saturation, 0, 1)), float(np.clip(value, 0, 1)))


def palette(rng) -> dict[str, Paint]:
    """Paints of one object: low-poly-game colours, one or two of them patterned."""
    schemes = ["toy", "fur", "pastel", "grey", "dark", "vivid"]
    scheme = rng.choice(schemes, p=[0.27, 0.34, 0.1, 0.12, 0.11, 0.06])
    u = rng.uniform
    hue = u(0.02, 0.13) if scheme == "fur" else u()
    base_s, base_v = {
        "toy": (u(0.55, 0.9), u(0.65, 0.95)),
        "fur": (u(0.25, 0.85), u(0.25, 0.9)),
        "pastel": (u(0.15, 0.4), u(0.8, 1.0)),
        "grey": (u(0.0, 0.12), u(0.3, 0.97)),
        "dark": (u(0.1, 0.6), u(0.08, 0.3)),
        "vivid": (u(0.8, 0.95), u(0.8, 1.0)),
    }[scheme]
    base = colour(hue, base_s, base_v)
    near = colour(hue + u(-0.06, 0.06), base_s * u(0.5, 1.1), base_v * u(0.5, 0.8) if base_v > 0.4 else 0.6)
    other_hue = hue + rng.choice([0.33, 0.5, 0.15, -0.15, u()])
    other = colour(other_hue, u(0.3, 0.9), u(0.4, 0.95))
    light = colour(hue + u(-0.05, 0.05), u(0, 0.25), u(0.85, 1.0))
    dark = colour(hue, u(0, 0.5), u(0.05, 0.22))
    accent = colour(rng.choice([0.0, 0.08, 0.14, 0.3, 0.55, 0.6, 0.78, 0.92]), u(0.7, 1), u(0.7, 1))
    pools = [[base, dark], [base, light], [base, near], [base, other], [base, near, light], [base, light, accent]]

    def paint(first, chance):
        colours = [first, *pools[rng.integers(len(pools))]]
        return Paint(
            colours,
            "flat" if u() > chance else str(rng.choice(PATTERNS[1:])),
            scale=u(2.0, 7.0),
            axis=int(rng.choice(3, p=[0.2, 0.5, 0.3])),
            roughness=u(0.25, 0.5) if u() < 0.2 else u(0.55, 1.0),
            metallic=1.0 if u() < 0.06 else 0.0,
        )

    metal = colour(u(), u(0, 0.15), u(0.45, 0.8))
    return {
        "skin": paint(base, 0.6),
        "second": paint(near if u() < 0.5 else other, 0.3),
        "accent": paint(accent, 0.15),
        "light": Paint([light], roughness=u(0.5, 0.9)),
        "dark": Paint([dark], roughness=u(0.4, 0.9)),
        "metal": Paint([metal], roughness=u(0.25, 0.5), metallic=float(u() < 0.5)),
        "flesh": Paint([colour(u(0.04, 0.09), u(0.25, 0.65), u(0.35, 0.98))]),
        "white": Paint([(0.95, 0.95, 0.95)], roughness=0.4),
        "black": Paint([(0.02, 0.02, 0.03)], roughness=0.25),
    }


@dataclass
class Puppet:
    """Joints, parts and warps of one object under construction; joint 0 is the body's fixed frame.

    rng, u, chance, pick    where all its random numbers come from, and short ways to draw them
    t                       (F,) time, 0 at the first frame, below 1 at the last
    still, energy, tempo    whether it holds still; how strong its swings are; swings a clip
    sides, n                corners of a tube's cross-section, squares along the edge of a ball's grid
    flat                    faceted instead of smooth
    paints                  name -> Paint
    """

    rng: np.random.Generator
    rest: list = field(default_factory=lambda: [np.eye(4)])
    pose: list = field(default_factory=lambda: [np.tile(np.eye(4), (FRAMES, 1, 1))])
    parts: list = field(default_factory=list)
    warps: list = field(default_factory=list)
    motions: list = field(default_factory=list)

    def __post_init__(self):
        rng = self.rng
        self.t = np.arange(FRAMES) / FRAMES
        mood = rng.uniform()
        self.still = mood < 0.08
        # Idle clips are common in games and hard in their own way: small motion must not be smoothed away.
        self.energy = 0.0 if self.still else rng.uniform(0.15, 0.4) if mood < 0.2 else rng.uniform(0.6, 1.3)
        self.tempo = float(rng.choice([0.5, 1, 1.5, 2, 3], p=[0.15, 0.45, 0.15, 0.17, 0.08]))
        self.detail = int(rng.choice(3, p=[0.25, 0.5, 0.25]))
        self.flat = self.detail == 0 or rng.uniform() < 0.15
        self.sides, self.n = (6, 10, 16)[self.detail], (4, 6, 9)[self.detail]
        self.paints = palette(rng)

    # Chance
    def u(self, low=0.0, high=1.0) -> float:
        """A uniform random number."""
        return float(self.rng.uniform(low, high))

    def chance(self, probability: float) -> bool:
        """True with this probability."""
        return bool(self.rng.uniform() < probability)

    def pick(self, *options):
        """One of the options."""
        return options[self.rng.integers(len(options))]

    # Motion
    def osc(self, amplitude=1.0, phase=0.0, cycles=1.0) -> np.ndarray:
        """A swing over the clip's frames, as strong and fast as this object's temper."""
        return amplitude * self.energy * np.sin(TAU * cycles * self.tempo * self.t + phase)

    def turn(self, turns=1.0) -> np.ndarray:
        """An even rotation over the clip; at most a sixth of a turn a frame, beyond which it would alias."""
        turns = 0.0 if self.still else np.clip(turns, -FRAMES / 6, FRAMES / 6)
        return TAU * turns * self.t

    def joint(self, parent=0, at=(0, 0, 0), motion=None, tilt=None) -> int:
        """A joint at `at` in its parent, turned by `tilt` (4, 4) at rest and by `motion` (F, 4, 4)."""
        base = translation(at) if tilt is None else translation(at) @ tilt
        self.rest.append(self.rest[parent] @ base)
        self.pose.append(self.pose[parent] @ base if motion is None else self.pose[parent] @ base @ motion)
        return len(self.rest) - 1

    # Skin
    def add(self, name, shape, paint="skin", joint=0, at=(0, 0, 0), tilt=None, flat=None):
        """Hang a shape on a joint. Shapes that already have frames are posed in the joint's frame."""
        points, faces = shape
        local = translation(at) if tilt is None else translation(at) @ tilt
        points = apply(local, points)
        rest = points[0] if points.ndim == 3 else points
        self.parts.append(
            Part(
                name,
                apply(self.rest[joint], rest),
                apply(self.pose[joint], points),
                faces,
                paint,
                self.flat if flat is None else flat,
            )
        )

    def ball(self, name, size, paint="skin", joint=0, at=(0, 0, 0), power=2.0, tilt=None, lumps=0.0):
        """A superquadric on a joint; `size` is one radius or three."""
        small = np.max(size) < 0.09
        points, faces = blob(np.broadcast_to(size, 3), power, 3 if small else self.n)
        self.add(name, (lumpy(points, self.rng, lumps) if lumps else points, faces), paint, joint, at, tilt)

    def rod(self, name, a, b, r0, r1=None, paint="skin", joint=0, cap=1.0, outline=None):
        """A straight tapered rod between two points of a joint's frame."""
        a, b = np.asarray(a, float), np.asarray(b, float)
        ref = np.eye(3)[np.argmin(np.abs(b - a))]
        shape = tube([a, b], [r0, r0 if r1 is None else r1], ref, self.sides, cap, outline)
        self.add(name, shape, paint, joint)

    def chain(self, name, joint, at, bones, angles, axis, radii, paint="skin", soft=True) -> int:
        """A limb, tail or neck: `bones` (n, 3) one after the other, each joint turning about `axis` by its
        angle (F) on top of those before it. Soft: one smooth tube; else a rod a bone. Returns the tip."""
        joints, offset = [], at
        for bone, angle, r0, r1 in zip(bones, angles, radii[:-1], radii[1:], strict=True):
            joints.append(self.joint(joints[-1] if joints else joint, offset, rotation(axis, angle)))
            offset = np.asarray(bone, float)
            if not soft:
                self.rod(name, (0, 0, 0), offset, r0, r1, paint, joints[-1])
        tip = self.joint(joints[-1], offset)
        if soft:
            knots = [*joints, tip]
            weights = spline(len(knots), 3 if len(knots) < 6 else 2)
            rest = weights @ np.stack([self.rest[k][:3, 3] for k in knots])
            pose = weights @ np.stack([self.pose[k][:, :3, 3] for k in knots], 1)
            radii = weights @ np.asarray(radii, float)
            # The axis is at right angles to the plane of bending: a frame of reference that cannot flip.
            axis = np.asarray(axis, float)
            ref, refs = self.rest[joint][:3, :3] @ axis, (self.pose[joint][:, :3, :3] @ axis)[:, None]
            rest, faces = tube(rest, radii, ref, self.sides)
            posed, _ = tube(pose, radii, refs, self.sides)
            self.parts.append(Part(name, rest, posed, faces, paint, self.flat))
        return tip

    def eyes(self, joint, size, power, at=(0, 0, 0), radius=0.2, spread=0.45, up=0.3, style=None):
        """Two eyes (or one) on the front of a blob of half sizes `size` centred at `at`."""
        style = style or self.pick("dot", "dot", "big", "big", "glow", "one")
        for side in (0,) if style == "one" else (-1, 1):
            place = on_blob((side * spread, -1.0, up), size, power) + at
            r = radius * float(np.mean(size)) * (1.6 if style == "one" else 1.0)
            white = {"dot": "black", "glow": "accent"}.get(style, "white")
            self.ball("eye", (r, r * 0.6, r), white, joint, place)
            if white == "white":
                pupil = place + np.array([0, -0.42 * r, 0.05 * r])
                self.ball("pupil", (r * 0.6, r * 0.36, r * 0.6), "black", joint, pupil)

    def finish(self) -> list[Part]:
        """Apply the warps, in order, to every part's posed points."""
        for part in self.parts:
            for warp in self.warps:
                part.posed = warp(part.posed)
        return self.parts

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The rest pose's box."""
        points = np.concatenate([part.rest for part in self.parts])
        return points.min(0), points.max(0)


def squash(p: Puppet, amount: float):
    """A warp that stretches z and keeps the volume."""
    tall = np.exp(p.osc(amount, p.u(0, 6)))
    factors = scaling(np.stack([tall**-0.5, tall**-0.5, tall], -1))
    return lambda points: apply(factors, points)
