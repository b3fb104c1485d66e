# SPDX-License-Identifier: GPL-3.0-or-later
"""The families of the procedural zoo that swim, fly and float. numpy only."""

from __future__ import annotations

import numpy as np

from .puppet import FRAMES, TAU, Puppet, squash
from .shapes import X, Y, Z, rotation, scaling, sheet, translation, tube
from .walkers import head, nod, tail


def swimmer(p: Puppet):
    """A fish, shark, whale, snake or worm: a body with fins, bent by a wave that travels to the tail."""
    kind = p.pick("fish", "fish", "fish", "whale", "snake", "shark")
    p.motions.append(f"{kind} wave")
    snake = kind == "snake"
    width = p.u(0.03, 0.08) if snake else p.u(0.07, 0.2)
    height = width * (p.u(0.8, 1.2) if snake or kind == "whale" else p.u(1.0, 2.6))
    profile = {
        "fish": [0.15, 0.65, 1, 1, 0.75, 0.4, 0.2],
        "shark": [0.1, 0.6, 0.95, 1, 0.7, 0.35, 0.15],
        "whale": [0.75, 1, 1.05, 0.95, 0.6, 0.3, 0.15],
        "snake": [1.1, 1.2, 0.9, 1, 1, 0.7, 0.1],
    }[kind]
    profile = np.array(profile) * p.rng.uniform(0.85, 1.15, 7)
    fine = np.interp(np.linspace(0, 6, 25), np.arange(7), profile)
    y = np.linspace(-0.5, 0.5, 25)
    points = np.stack([0 * y, y, 0 * y], -1)
    p.add("body", tube(points, np.stack([width * fine, height * fine], -1), Z, p.sides + 4))
    snout, style = np.array([width, 0.15, height]) * 0.9, p.pick("dot", "big")
    p.eyes(0, snout, 2, (0, -0.36, 0), p.u(0.15, 0.3), p.u(0.8, 1.6), p.u(0.1, 0.5), style)
    if not snake:
        fin = p.pick("skin", "second", "accent")
        level = kind == "whale"
        span, fork = p.u(0.12, 0.3), p.u(0.3, 1.2)
        reach, beat = np.array([p.u(0.08, 0.3), p.u(0.05, 0.2), -p.u(0, 0.12)]), p.osc(0.5, p.u(0, 6))
        for side in (-1, 1):
            lobe = span * side * (X if level else Z) + (0.1 + 0.1 * fork) * Y
            _fin(p, (0, 0.47, 0), lobe, (0, 0.14, 0), fin)
            out, flap = reach * (side, 1, 1), rotation(Y, side * beat)
            _fin(p, (side * width * 0.8, -0.2, -height * 0.3), out, (0, 0.12, 0), fin, flap)
        if kind != "whale" or p.chance(0.4):
            _fin(p, (0, -0.1, height * 0.8), (0, 0.12, p.u(0.05, 0.25)), (0, p.u(0.1, 0.4), -height * 0.1), fin)
        if p.chance(0.5):
            _fin(p, (0, 0.12, -height * 0.6), (0, 0.1, -p.u(0.05, 0.15)), (0, 0.15, height * 0.2), fin)
    elif p.chance(0.5):
        p.ball("head", (width * 1.6, width * 2, width * 1.1), p.pick("skin", "second"), 0, (0, -0.5, 0))
    waves = p.u(1.2, 2.2) if snake else p.u(0.5, 1.0)
    depth = p.u(0.06, 0.12) if snake else p.u(0.06, 0.16)
    p.warps.append(_wave(p, Y, Z if kind == "whale" else X, depth, waves, even=snake))


def _fin(p, root, out, back, paint, motion=None):
    """A thin triangle-like fin: `out` to its tip, `back` along its root."""
    s, c = np.meshgrid(np.linspace(0, 1, 6), np.linspace(0, 1, 4), indexing="ij")
    out, back = np.asarray(out, float), np.asarray(back, float)
    taper = c[..., None] * (1 - s[..., None] * 0.75)
    points = s[..., None] * out + taper * back
    p.add("fin", sheet(points), paint, p.joint(0, root, motion), flat=False)


def _wave(p, along, sideways, depth, waves, even=False, anchor=-0.5):
    """A warp that bends space along an axis as a travelling wave; parts turn with the slope, as on a spine."""
    along, sideways = np.asarray(along), np.asarray(sideways)
    phase = (TAU * p.tempo * p.t)[:, None]
    depth, rate = depth * p.energy, TAU * waves

    def warp(points):
        s = points @ along
        grow = 1.0 if even else np.clip((s - anchor) / 1.0, 0, 2) ** 1.5 + 0.12
        shift = depth * grow * np.sin(rate * s - phase)
        angle = np.arctan(depth * grow * rate * np.cos(rate * s - phase))
        off = points @ sideways
        return (
            points
            + (shift + off * (np.cos(angle) - 1))[..., None] * sideways
            - (off * np.sin(angle))[..., None] * along
        )

    return warp


def flyer(p: Puppet):
    """A bird, bat, dragon, bee, butterfly or ray: a body between flapping sheets."""
    kind = p.pick("bird", "bird", "butterfly", "bee", "dragon", "ray")
    p.motions.append(f"{kind} flap")
    beat = np.stack([0 * p.t, 0 * p.t, p.osc(p.u(0.02, 0.12), 0.8)], -1)
    body = p.joint(0, (0, 0, 0), translation(beat) @ rotation(X, p.osc(0.1, 2.0)))
    fat = {"bird": p.u(0.08, 0.16), "bee": p.u(0.16, 0.25), "dragon": p.u(0.08, 0.14)}.get(kind, p.u(0.025, 0.06))
    long = {"bee": fat * p.u(1.0, 1.6), "butterfly": p.u(0.2, 0.3)}.get(kind, p.u(0.22, 0.36))
    p.ball("body", (fat, long, fat * p.u(0.8, 1.1)), "skin", body, power=p.pick(2, 2, 2, 4))
    size = fat * (p.u(1.0, 1.5) if kind == "butterfly" else p.u(0.6, 0.95))
    if kind == "dragon":
        bones = np.array([(0, -0.1, 0.05), (0, -0.1, 0.08), (0, -0.08, 0.05)]) * p.u(0.7, 1.6)
        sway, radii = [p.osc(0.15, k) for k in range(3)], fat * np.array([0.7, 0.5, 0.4, 0.4])
        neck = p.chain("neck", body, (0, -long * 0.8, 0), bones, sway, X, radii)
        tail(p, body, (0, long * 0.8, 0), p.u(0.4, 0.8), fat * 0.5)
    else:
        neck = p.joint(body, (0, -long - size * 0.4, fat * p.u(0, 0.6)), nod(p))
    if kind == "ray":
        p.eyes(body, (fat, long, fat), 2, radius=0.15, spread=0.3, up=0.6, style="dot")
        tail(p, body, (0, long * 0.9, 0), p.u(0.4, 0.9), 0.02)
    else:
        head(p, neck, size)
    paint = _wings(p, kind, body, fat, long)
    if kind == "bird":
        s, c = np.meshgrid(np.linspace(0, 1, 5), np.linspace(-1, 1, 5), indexing="ij")
        fan = np.stack([c * (0.04 + s * p.u(0.03, 0.16)), s * p.u(0.12, 0.4), 0.03 * np.cos(3 * c)], -1)
        p.add("tail", sheet(fan), paint, p.joint(body, (0, long * 0.85, 0), rotation(X, p.osc(0.3))))
    if kind in ("bird", "bee", "dragon") and p.chance(0.5):
        for side in (-1, 1):
            foot = p.joint(body, (side * fat * 0.5, long * 0.2, -fat * 0.7), rotation(X, p.osc(0.3, side)))
            p.rod("leg", (0, 0, 0), (0, 0.06, -0.12), 0.02, 0.012, "accent", foot)


def _wings(p: Puppet, kind: str, body: int, fat: float, long: float) -> str:
    """One or two pairs of sheets that beat; returns their paint."""
    span, lobes = p.u(0.45, 0.9), 1
    chords = {"bird": 0.22, "dragon": 0.35, "bee": 0.2, "ray": 1.6 * long, "butterfly": 0.4}
    chord = chords[kind] * p.u(0.75, 1.3)
    if kind in ("butterfly", "bee"):
        span, lobes = p.u(0.35, 0.6), 2
    tip, sweep, lag = p.u(0.1, 0.7), p.u(-0.1, 0.35), p.u(0.2, 1.4)
    swing = p.u(0.9, 1.2) if kind == "butterfly" else p.u(0.45, 0.9)
    cycles = p.pick(2, 3) if kind == "bee" else p.pick(1, 1, 2)
    scallop = p.u(0.05, 0.15) if kind == "dragon" else 0.0
    paint = p.pick("second", "accent", "skin")
    for lobe in range(lobes):
        for side in (-1, 1):
            shrink = 1 - 0.3 * lobe
            s, c = np.meshgrid(np.linspace(0, 1, 14), np.linspace(0, 1, 7), indexing="ij")
            width = chord * shrink * (1 - (1 - tip) * s**1.5) * (np.sqrt(1.0001 - s**8))
            if lobes == 2:
                width = chord * shrink * (0.35 + np.sin(np.pi * (0.1 + 0.75 * s)) * 0.8) * np.sqrt(1.0001 - s**6)
            back = (sweep + (0.35 * lobe - 0.2 * (lobes == 2))) * s * span + (c - 0.4) * width
            back = back - scallop * c * np.abs(np.sin(s * np.pi * 3)) * (s > 0.05)
            # Each strip of the wing follows the one before it: the tip lags behind the root.
            angle = np.stack([p.osc(swing, -lag * x, cycles) + 0.15 for x in np.linspace(0, 1, 14)], 1)
            step = span * shrink / 13
            out = np.cumsum(np.cos(angle), 1) * step
            up = np.cumsum(np.sin(angle), 1) * step
            back = np.broadcast_to(back, (FRAMES, 14, 7))
            points = np.stack([side * (out[..., None] + 0 * back), back, up[..., None] + 0 * back], -1)
            at = (side * fat * (0.2 if kind == "ray" else 0.6), -long * 0.1 + lobe * long * 0.4, fat * 0.3)
            p.add("wing", sheet(points), paint, body, at, flat=False)
    return paint


def monster(p: Puppet):
    """A body with eyes, tentacles, spikes and a mouth that hops or floats: octopus, jellyfish, virus."""
    p.motions.append("monster")
    hop = np.stack([0 * p.t, 0 * p.t, np.abs(p.osc(p.u(0, 0.3)))], -1)
    body = p.joint(0, (0, 0, p.u(0.4, 0.8)), translation(hop) @ rotation(Z, p.osc(p.u(0, 0.5))))
    size, power = p.rng.uniform(0.22, 0.42, 3), p.u(1.6, 6)
    p.ball("body", size, "skin", body, power=power, lumps=p.pick(0, 0, 0.1, 0.2))
    p.eyes(body, size, power, radius=p.u(0.15, 0.35), spread=p.u(0.25, 0.6), up=p.u(0, 0.6))
    count, paint = int(p.rng.integers(3, 9)), p.pick("skin", "second", "accent")
    length, thick, sag = p.u(0.4, 0.9), p.u(0.04, 0.09), p.u(-1.5, 0.2)
    for k in range(count):
        angle = TAU * (k + 0.5) / count
        root = p.joint(body, 0.75 * size * (np.cos(angle), np.sin(angle), -0.6), tilt=rotation(Z, angle))
        bones = np.array([[1, 0, sag * (0.5 + 0.2 * j)] for j in range(5)])
        bones *= length / 5 / np.linalg.norm(bones, axis=1, keepdims=True)
        angles = [p.osc(0.3, k * 2.1 - 0.8 * j) for j in range(5)]
        p.chain("tentacle", root, (0, 0, 0), bones, angles, Y, thick * np.array([1.2, 1, 0.9, 0.7, 0.5, 0.1]), paint)
    for _ in range(p.rng.integers(0, 12)):
        way = p.rng.normal(size=3) * (1, 0.7, 1) + (0, 0.3, 0.4)
        root = way / (np.abs(way / size) ** power).sum() ** (1 / power)
        p.rod("spike", root * 0.9, root * p.u(1.2, 1.7), 0.06, 0.005, "light", body, 0.2)
    if p.chance(0.5):
        mouth = p.joint(body, (0, -size[1] * 0.88, -size[2] * 0.35), scaling(np.exp(p.osc(0.5)[:, None] * (0, 0, 1))))
        p.ball("mouth", (size[0] * 0.45, 0.06, size[2] * 0.16), "dark", mouth)
    if p.chance(0.4):
        p.warps.append(squash(p, p.u(0.03, 0.15)))
