# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes of the stress suite: each is hard by one number, its level, and the same in every process. numpy only.

`TRIALS[name](level)` gives the parts and paints of an object that moves within a ball of 1.1 around the origin, posed
at STEPS steps, BETWEEN of them from one moment of the clip to the next: inputs show whole moments, and what lies
between them is known too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from .puppet import TAU, Paint, Part
from .shapes import apply, blob, rotation, scaling, torus, translation, tube

MOMENTS, BETWEEN = 12, 4
STEPS = (MOMENTS - 1) * BETWEEN + 1
TIMES = np.arange(STEPS) / BETWEEN  # in moments: 0 … MOMENTS - 1
REACH = 0.75  # how far from the origin centres of small things go
SMALL = 0.22  # their radius
VERSION = 1  # a change to any trial that shows something else; figures of another one are not comparable

SKIN = Paint([(0.85, 0.45, 0.2), (0.98, 0.85, 0.6), (0.35, 0.2, 0.12)], "patches", 6.0)
BLUE = Paint([(0.15, 0.35, 0.75), (0.6, 0.8, 0.95)], "stripes", 3.0, axis=2)
PAINTS = {
    "skin": SKIN,
    "second": BLUE,
    "accent": Paint([(0.8, 0.1, 0.15)]),
    "dark": Paint([(0.08, 0.08, 0.1)]),
}


@dataclass(frozen=True)
class Trial:
    """Parts with their points at every step, (STEPS,V,3), and the paints that they name."""

    parts: list[Part]
    paints: dict[str, Paint]


def _posed(name: str, shape: tuple, motion: np.ndarray, paint: str) -> Part:
    """A shape (points (V,3), faces) carried by `motion` (STEPS,4,4)."""
    points, faces = shape
    return Part(name, points, apply(motion, points), faces, paint, False)


def _moved(shape: tuple, offset) -> tuple:
    return shape[0] + np.asarray(offset, float), shape[1]


def _creature(radius: float, motion: np.ndarray, paint: str = "skin") -> list[Part]:
    """A ball with a nose, two ears and a belt: from every side it shows which way it looks."""
    found = [_posed("body", blob((radius,) * 3, 2.4, 12), motion, paint)]
    nose = _moved(blob((radius * 0.3,) * 3, 2, 6), (0, -radius, radius * 0.15))
    found.append(_posed("nose", nose, motion, "accent"))
    for side in (-1, 1):
        ear = _moved(blob((radius * 0.25, radius * 0.2, radius * 0.5), 2, 6), (side * radius * 0.5, 0, radius * 1.1))
        found.append(_posed("ear", ear, motion, "second"))
    found.append(_posed("belt", _moved(torus(radius, radius * 0.12, 28), (0, 0, -radius * 0.3)), motion, "dark"))
    return found


def _along(places: np.ndarray, degrees: float = 0.0) -> np.ndarray:
    """(STEPS,4,4) through the places (STEPS,3), turning about Z by `degrees` a moment."""
    return translation(places) @ rotation((0, 0, 1), np.radians(degrees) * TIMES)


def _fold(s: np.ndarray) -> np.ndarray:
    """Distances along an endless line -> -REACH … REACH, turning back at each end."""
    return np.abs((s + REACH) % (4 * REACH) - 2 * REACH) - REACH


def calm(level: float = 0.0) -> Trial:
    """What all other sweeps start from: a large creature that turns and drifts a little."""
    places = np.stack([0.02 * (TIMES - 5.5), 0 * TIMES, 0 * TIMES], -1)
    return Trial(_creature(0.62, _along(places, 4.0)), PAINTS)


def speed(level: float) -> Trial:
    """A small creature that goes straight, `level` of its radii a moment, and back where it gets to the end."""
    way = level * SMALL * TIMES
    start = min(way[-1] / 2, REACH)
    direction = np.array([0.9, 0.35, 0.25]) / np.linalg.norm([0.9, 0.35, 0.25])
    return Trial(_creature(SMALL, _along(-_fold(way + 2 * REACH - start)[:, None] * direction)), PAINTS)


def bend(level: float) -> Trial:
    """The same at 0.6 radii a moment, on a path that turns by `level` degrees a moment."""
    step, turn = 0.6 * SMALL, np.radians(level)
    if level:
        places = step / turn * np.stack([np.sin(turn * TIMES), 1 - np.cos(turn * TIMES), 0 * TIMES], -1)
    else:
        places = step * np.stack([TIMES, 0 * TIMES, 0 * TIMES], -1)
    return Trial(_creature(SMALL, _along(places - (places.max(0) + places.min(0)) / 2)), PAINTS)


def jumps(level: float) -> Trial:
    """It stands, and is elsewhere at once, `level` times in the clip, each time half-way between two moments."""
    rng = np.random.default_rng(15)
    where = rng.uniform(-0.45, 0.45, (MOMENTS, 3))
    when = np.linspace(0, MOMENTS - 1, round(level) + 2)[1:-1].round() - 0.5
    return Trial(_creature(SMALL, _along(where[(TIMES[:, None] > when).sum(1)])), PAINTS)


def spin(level: float) -> Trial:
    """A propeller of three blades that turns by `level` degrees a moment."""
    motion = rotation((0.2, -1, 0.3), np.radians(level) * TIMES)
    parts = [_posed("hub", blob((0.2, 0.3, 0.2), 2.4, 8), motion, "dark")]
    for n, paint in enumerate(("skin", "second", "accent")):
        blade = _moved(blob((0.13, 0.05, 0.42), 3, 10), (0, 0, 0.5))
        turned = apply(rotation((0, 1, 0), TAU * n / 3), blade[0]), blade[1]
        parts.append(_posed("blade", turned, motion, paint))
    return Trial(parts, PAINTS)


def appear(level: float) -> Trial:
    """A creature among eight balls, of which `level` appear or vanish at some moment."""
    motion = _along(np.zeros((STEPS, 3)), 4.0)
    parts = _creature(0.4, motion)
    for n in range(8):
        angle = TAU * n / 8
        place = np.array([0.8 * np.cos(angle), 0.8 * np.sin(angle), 0.3 * (-1) ** n])
        there = TIMES >= 0
        if n < level:
            when = 1.5 + n
            there = (when < TIMES) == bool(n % 2)
        # What is not there is a point inside of the body: the mesh keeps its faces.
        size = np.where(there, 1.0, 0.0)
        carried = translation(place * size[:, None]) @ scaling(np.repeat(size[:, None], 3, 1))
        parts.append(_posed("ball", blob((0.17,) * 3, 2.4, 8), carried, ("second", "accent", "skin")[n % 3]))
    return Trial(parts, PAINTS)


def contact(level: float) -> Trial:
    """Two creatures go past one another; where they meet, `level` of a diameter of each is within the other (below 0:
    a gap)."""
    radius, way = 0.3, 0.12 * (TIMES - 5.5)
    off = radius * (1 - level) + 0 * TIMES
    first = _creature(radius, _along(np.stack([way, off, 0 * TIMES], -1)))
    second = _creature(radius, _along(np.stack([-way, -off, 0 * TIMES], -1)) @ rotation((0, 0, 1), np.pi), "second")
    return Trial(first + second, PAINTS)


def thin(level: float) -> Trial:
    """A cage of 24 rods that turns, each as thick as `level` percent of the cage."""
    motion, radius, up = _along(np.zeros((STEPS, 3)), 5.0), level / 100, np.array([0, 0, 0.7])
    parts = []
    for n in range(12):
        angle = TAU * n / 12
        out = 0.75 * np.array([np.cos(angle), np.sin(angle), 0])
        for tilt in (-1, 1):
            other = 0.75 * np.array([np.cos(angle + tilt * 0.9), np.sin(angle + tilt * 0.9), 0])
            rod = tube([out - up, other + up], [radius, radius], np.eye(3)[0], 6)
            parts.append(_posed("rod", rod, motion, ("skin", "second", "accent")[n % 3]))
    return Trial(parts, PAINTS)


def _painted(**skin) -> Trial:
    """`calm` in one paint all over."""
    trial, paint = calm(), replace(SKIN, **skin)
    return Trial([replace(p, paint="skin") for p in trial.parts], PAINTS | {"skin": paint})


def plain(level: float) -> Trial:
    """Of the colours' differences `level` is lost: 1 is one colour all over."""
    colours = np.array(SKIN.colours)
    return _painted(colours=[tuple(c) for c in colours + level * (colours.mean(0) - colours)])


def repeated(level: float) -> Trial:
    """A checkerboard of some `level` squares along the object: one looks like the next."""
    return _painted(colours=[(0.9, 0.9, 0.85), (0.1, 0.15, 0.3)], pattern="checker", scale=level / 2)


def gloss(level: float) -> Trial:
    """From matt (0) to a mirror (1)."""
    return _painted(roughness=0.7 * (1 - level) + 0.03, metallic=level)


def glass(level: float) -> Trial:
    """`level` of the light goes through each side."""
    return _painted(alpha=1 - level)


def aside(level: float) -> Trial:
    """A creature `level` from where all cameras look, of the 1.1 that they see whole."""
    places = np.tile(level * 1.1 * np.array([0.8, 0.5, 0.33]), (STEPS, 1))
    return Trial(_creature(0.45, _along(places, 4.0)), PAINTS)


TRIALS: dict[str, Callable[[float], Trial]] = {
    f.__name__: f for f in (calm, speed, bend, jumps, spin, appear, contact, thin, plain, repeated, gloss, glass, aside)
}
