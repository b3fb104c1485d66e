# SPDX-License-Identifier: GPL-3.0-or-later
"""The families of the procedural zoo that are no animals: vehicles, machines, heaps, plants. numpy only."""

from __future__ import annotations

import numpy as np

from .puppet import TAU, Puppet, squash
from .shapes import X, Y, Z, blob, gear_outline, lumpy, rotation, scaling, sheet, torus, translation, tube


def _wheel(p, parent, at, radius, width, turns, paint="dark"):
    """A wheel about x whose hub and pattern show that it turns."""
    wheel = p.joint(parent, at, rotation(X, p.turn(turns)))
    p.rod("wheel", (-width, 0, 0), (width, 0, 0), radius, None, paint, wheel, 0.15)
    spokes = p.rng.integers(3, 7)
    for k in range(spokes):
        tip = radius * 0.8 * np.array([0, np.cos(TAU * k / spokes), np.sin(TAU * k / spokes)])
        for side in (-1, 1):
            rim = np.array([side * width * 1.12, 0, 0])
            p.rod("spoke", rim, rim + tip, radius * 0.12, None, "light", wheel, 0.3)


def vehicle(p: Puppet):
    """A car, lorry, tank, plane, helicopter or boat with the parts that turn on it."""
    kind = p.pick("car", "car", "tank", "plane", "helicopter", "boat")
    p.motions.append(f"{kind} moves")
    half = wide, long, tall = p.u(0.2, 0.3), p.u(0.42, 0.6), p.u(0.1, 0.2)
    shake = np.stack([0 * p.t, 0 * p.t, p.osc(p.u(0.005, 0.04), 0, 2)], -1)
    roll = rotation(Y, p.osc(p.u(0.02, 0.25 if kind in ("boat", "plane", "helicopter") else 0.05), 1))
    body = p.joint(0, (0, 0, tall * 1.6), translation(shake) @ roll @ rotation(X, p.osc(p.u(0, 0.1))))
    power = p.pick(3, 5, 9)
    turns = p.u(0.5, 2.5)
    if kind in ("plane", "helicopter"):
        return _aircraft(p, kind, body, half)
    p.ball("hull", (wide, long, tall), "skin", body, (0, 0, tall * 0.4), power)
    if kind == "boat":
        return _keel_and_sail(p, body, half)
    if kind == "tank":
        _turret(p, body, half, power)
        turns *= 0.6
    else:
        _cabin(p, body, half, power)
    radius, lights = tall * p.u(0.7, 1.1), p.pick("light", "accent")
    axles = np.linspace(-0.7, 0.7, p.pick(2, 2, 3) if kind == "car" else 4) * long
    for side in (-1, 1):
        lamp = (side * wide * 0.6, -long * 0.98, tall * 0.5)
        p.ball("lamp", tall * 0.2, lights, body, lamp)
        for y in axles:
            _wheel(p, 0, (side * wide * 1.05, y, radius), radius, wide * 0.2, turns)


def _aircraft(p: Puppet, kind: str, body: int, half: tuple):
    """The fuselage of a plane or a helicopter, with its wings or skids and the rotor."""
    wide, long, tall = half
    profile = np.array([0.45, 0.95, 1, 0.8, 0.5, p.u(0.15, 0.3)]) * tall
    y = np.linspace(-long, long, 6)
    p.add("fuselage", tube(np.stack([0 * y, y, 0 * y], -1), profile, Z, p.sides + 4), "skin", body)
    p.ball("cockpit", (tall * 0.6, tall * 1.1, tall * 0.5), "black", body, (0, -long * 0.35, tall * 0.75))
    p.ball("fin", (0.015, 0.07, p.u(0.1, 0.16)), "accent", body, (0, long * 0.95, 0.1), 3)
    p.ball("stabiliser", (p.u(0.15, 0.25), 0.06, 0.015), "second", body, (0, long * 0.95, 0.02), 4)
    if kind == "plane":
        for deck in range(p.pick(1, 1, 2)):
            height = deck * tall * 1.9 - tall * 0.4
            wing = (p.u(0.5, 0.9), p.u(0.08, 0.16), 0.02)
            p.ball("wing", wing, "second", body, (0, -long * 0.2, height), 4)
        hub = p.joint(body, (0, -long - tall * 0.5, 0), rotation(Y, p.turn(p.u(2, 4))))
        return _rotor(p, hub, p.u(0.2, 0.3), p.pick(2, 3, 4), 0.035, Y)
    hub = p.joint(body, (0, -long * 0.2, tall * 1.5), rotation(Z, p.turn(p.u(1.5, 4))))
    p.rod("mast", (0, -long * 0.2, tall * 0.5), (0, -long * 0.2, tall * 1.5), 0.025, None, "metal", body)
    for side in (-1, 1):
        skid = np.array([side * wide * 0.6, -0.1, -tall * 1.5])
        p.rod("skid", skid - 0.4 * long * Y, skid + 0.4 * long * Y, 0.02, None, "dark", body)
        p.rod("strut", (side * tall * 0.5, -0.1, -tall * 0.5), skid, 0.015, None, "dark", body)
    return _rotor(p, hub, p.u(0.45, 0.7), p.pick(2, 3, 4), 0.035, Z)


def _keel_and_sail(p: Puppet, body: int, half: tuple):
    wide, long, tall = half
    p.ball("keel", (wide * 0.7, long * 0.9, tall), "second", body, (0, 0, -tall * 0.2), 3)
    p.rod("mast", (0, 0, 0), (0, 0, 0.9), 0.025, 0.015, "dark", body)
    u, v = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9), indexing="ij")
    ripple = np.stack([np.sin(4 * u - TAU * p.tempo * t) for t in p.t])
    belly = 0.12 * np.sin(np.pi * u) * np.sin(np.pi * v) + 0.05 * u * p.energy * ripple
    sail = np.stack([belly, 0 * belly + u * (1 - v * 0.8) * 0.5, 0 * belly + 0.25 + v * 0.6], -1)
    p.add("sail", sheet(sail), "accent", body, flat=False)


def _turret(p: Puppet, body: int, half: tuple, power: float):
    """A turret that swings, with a barrel that nods."""
    wide, _, tall = half
    turret = p.joint(body, (0, 0, tall * 1.4), rotation(Z, p.osc(p.u(0.4, 1.4), p.u(0, 6))))
    p.ball("turret", (wide * 0.7, wide * 0.8, tall * 0.7), "second", turret, (0, 0, tall * 0.4), power)
    barrel = p.joint(turret, (0, -wide * 0.5, tall * 0.5), rotation(X, -0.15 + p.osc(0.25, 2)))
    p.rod("barrel", (0, 0, 0), (0, -p.u(0.35, 0.7), 0), 0.035, None, p.pick("dark", "metal"), barrel, 0.2)


def _cabin(p: Puppet, body: int, half: tuple, power: float):
    """The cabin of a car, or the cab and the load of a lorry."""
    wide, long, tall = half
    if p.chance(0.5):
        cabin, glass = (wide * 0.9, long * p.u(0.25, 0.55), tall * 0.9), p.pick("black", "light", "second")
        p.ball("cabin", cabin, glass, body, (0, p.u(-0.1, 0.2) * long, tall * 1.7), power)
    else:
        p.ball("cab", (wide * 0.95, long * 0.3, tall), "second", body, (0, -long * 0.6, tall * 1.8), power)
        load = (wide * 1.05, long * 0.55, tall * p.u(1, 2))
        p.ball("load", load, p.pick("accent", "light"), body, (0, long * 0.4, tall * 2), power)


def _rotor(p, hub, radius, blades, width, axis):
    p.ball("hub", width * 1.4, "metal", hub)
    for k in range(blades):
        spin = rotation(axis, TAU * k / blades)
        reach = spin[:3, :3] @ X * radius * 0.5
        shape = blob((radius * 0.5, width if axis is Z else 0.012, 0.012 if axis is Z else width), 4, 4)
        p.add("blade", shape, p.pick("accent", "dark", "light"), hub, reach, spin)


def machine(p: Puppet):
    """Gears, a windmill, a carousel or a robot arm: rigid parts about fixed axes."""
    kind = p.pick("gears", "windmill", "carousel", "robot arm")
    p.motions.append(kind)
    {"gears": _gears, "windmill": _windmill, "carousel": _carousel, "robot arm": _robot_arm}[kind](p)


def _gears(p: Puppet):
    """A row of cogwheels, each of which turns against the one before it."""
    x, turns, sign, paint = 0.0, p.u(0.15, 0.8), 1, ["skin", "accent", "second", "metal"]
    last = 0.0
    for k in range(p.rng.integers(2, 5)):
        r = p.u(0.15, 0.4)
        x += (r + last) * 0.93 if k else 0
        wheel = p.joint(0, (x, 0, p.u(-0.05, 0.05)), rotation(Y, p.turn(sign * turns * 0.3 / r)))
        thick = p.u(0.04, 0.12)
        teeth = gear_outline(int(r * 36), 0.2)
        p.rod("gear", -thick * Y, thick * Y, r, None, paint[k], wheel, 0.1, teeth)
        p.rod("axle", (0, -0.2, 0), (0, 0.2, 0), r * 0.25, None, "dark", wheel, 0.2)
        for j in range(4):
            at = r * 0.55 * np.array([np.cos(j * TAU / 4), 0, np.sin(j * TAU / 4)])
            p.ball("bolt", r * 0.1, "light", wheel, at - (0, thick, 0))
        last, sign = r, -sign


def _windmill(p: Puppet):
    tower = p.u(0.6, 1.0)
    p.rod("tower", (0, 0, 0), (0, 0, tower), p.u(0.15, 0.28), p.u(0.08, 0.15), "skin", 0, 0.2)
    p.rod("roof", (0, 0, tower), (0, 0, tower + 0.2), 0.2, 0.01, "second", 0, 0.1)
    p.ball("door", (0.06, 0.05, 0.12), "dark", 0, (0, -0.22, 0.12), 4)
    hub = p.joint(0, (0, -0.22, tower), rotation(Y, p.turn(p.u(0.2, 2.0))))
    _rotor(p, hub, p.u(0.35, 0.6), p.pick(3, 4, 5, 6), p.u(0.04, 0.1), Y)


def _carousel(p: Puppet):
    """Seats that go up and down as they go around."""
    p.rod("base", (0, 0, 0), (0, 0, 0.08), 0.6, None, "second", 0, 0.1)
    p.rod("roof", (0, 0, 0.75), (0, 0, 1.0), 0.65, 0.03, "accent", 0, 0.1)
    p.rod("post", (0, 0, 0), (0, 0, 0.8), 0.06, None, "light")
    spin, count = p.joint(0, (0, 0, 0), rotation(Z, p.turn(p.u(0.2, 0.9)))), p.rng.integers(3, 8)
    for k in range(count):
        rise = np.stack([0 * p.t, 0 * p.t, p.osc(0.12, 2 * k)], -1)
        angle = TAU * k / count
        seat = p.joint(spin, (0.45 * np.cos(angle), 0.45 * np.sin(angle), 0.4), translation(rise))
        p.rod("pole", (0, 0, -0.15), (0, 0, 0.3), 0.015, None, "metal", seat)
        p.ball("seat", p.u(0.07, 0.13), p.pick("skin", "light", "accent"), seat, power=p.u(1.2, 6))


def _robot_arm(p: Puppet):
    """Some arms in a row on a base that turns, with a claw at the end."""
    p.rod("base", (0, 0, 0), (0, 0, 0.12), p.u(0.2, 0.35), 0.18, "dark", 0, 0.1)
    yaw = p.joint(0, (0, 0, 0.12), rotation(Z, p.osc(p.u(0.4, 1.3), p.u(0, 6))))
    at, parent = np.zeros(3), yaw
    for k in range(p.rng.integers(2, 5)):
        arm, swing = p.u(0.25, 0.5), p.osc(p.u(0.2, 0.7), p.u(0, 6))
        parent = p.joint(parent, at, rotation(X, p.u(-0.7, 0.9) * (1 if k else 0.3) + swing))
        p.ball("knuckle", 0.09, "metal", parent)
        p.rod("arm", (0, 0, 0), (0, 0, arm), 0.065, 0.05, p.pick("skin", "second", "accent"), parent, 0.3)
        at = np.array([0, 0, arm])
    for side in (-1, 1):
        claw = p.joint(parent, at, rotation(Y, side * (0.4 + p.osc(0.3, 0, 2))))
        p.ball("claw", (0.03, 0.05, 0.1), "dark", claw, (0, 0, 0.1), 4)


def morph(p: Puppet):
    """A blob that flows between shapes, squashes and stretches, with or without a face."""
    p.motions.append("morph")
    faces = blob((1, 1, 1), 2, p.n * 2)[1]
    shapes = []
    for _ in range(p.rng.integers(2, 4)):
        size, power = p.rng.uniform(0.3, 0.6, 3), p.pick(1.2, 2, 2, 3, 8)
        shape = lumpy(blob(size, power, p.n * 2)[0], p.rng, p.pick(0.05, 0.15, 0.3), p.u(2, 6))
        shapes.append(shape)
    phase = TAU * p.tempo * p.t
    weight = np.stack([1 + p.energy * np.sin(phase + TAU * k / len(shapes)) for k in range(len(shapes))], 1)
    weight = np.maximum(weight, 0) / np.maximum(weight, 0).sum(1, keepdims=True)
    p.add("blob", (np.einsum("fk,kvc->fvc", weight, np.stack(shapes)), faces))
    if p.chance(0.6):
        p.eyes(0, shapes[0].max(0) * 0.95, 2, radius=p.u(0.12, 0.3), spread=p.u(0.2, 0.6), up=p.u(0.0, 0.6))
    for _ in range(p.rng.integers(0, 6)):
        way = p.rng.normal(size=3)
        orbit = p.joint(0, (0, 0, 0), rotation(Z, p.turn(p.pick(-1, 1) * p.u(0.1, 0.6))))
        p.ball("drop", p.u(0.05, 0.14), p.pick("skin", "accent"), orbit, way / np.linalg.norm(way) * p.u(0.5, 0.8))
    p.warps.append(squash(p, p.u(0.05, 0.35)))


def stack(p: Puppet):
    """Primitives in a heap, a tower or a ring that spin, slide, bounce, pulse and orbit."""
    p.motions.append("primitives")
    layout, count = p.pick("tower", "ring", "heap"), int(p.rng.integers(2, 9))
    still, z = p.chance(0.15), 0.0
    for k in range(count):
        r = p.u(0.1, 0.28)
        angle = TAU * k / count
        at = {"tower": (0, 0, z + r), "ring": (0.6 * np.cos(angle), 0.6 * np.sin(angle), r)}.get(
            layout, (*p.rng.uniform(-0.5, 0.5, 2), p.u(0, 0.8))
        )
        z += 2 * r
        way, phase, speed = p.rng.normal(size=3) + 0.5 * Z, p.u(0, 6), p.pick(0.5, 1, 1)
        move = p.pick("spin", "slide", "bounce", "pulse", "orbit")
        if still or (layout == "tower" and k == 0):
            motion = None
        elif move == "spin":
            motion = rotation(way, p.turn(p.u(0.2, 1.5)))
        elif move == "slide":
            motion = translation(p.osc(p.u(0.1, 0.4), phase, speed)[:, None] * way / np.linalg.norm(way))
        elif move == "bounce":
            motion = translation(np.abs(p.osc(p.u(0.2, 0.5), phase, speed))[:, None] * Z)
        elif move == "pulse":
            motion = scaling(np.exp(p.osc(p.u(0.1, 0.4), phase))[:, None] * np.ones(3))
        else:
            motion = rotation(Z, p.turn(p.u(0.2, 0.8))) @ translation(np.array([p.u(0.1, 0.3), 0, 0]))
        joint = p.joint(0, at, motion, rotation(way, p.u(0, 3) if layout == "heap" else 0.0))
        paint = p.pick("skin", "second", "accent", "light", "dark", "metal")
        shape = p.pick("ball", "box", "cone", "ring", "star", "drum", "rock", "wild")
        if shape in ("ball", "box", "rock", "wild"):
            power = {"ball": 2, "box": 9, "rock": 2.5, "wild": p.u(0.8, 6)}[shape]
            p.ball(shape, p.rng.uniform(0.6, 1.1, 3) * r, paint, joint, power=power, lumps=0.25 * (shape == "rock"))
        elif shape == "ring":
            p.add("ring", torus(r * 0.8, r * p.u(0.15, 0.4), 8 + 2 * p.sides, p.sides), paint, joint)
        else:
            top = {"cone": 0.01, "drum": 1.0}.get(shape, p.u(0.5, 1)) * r
            star = gear_outline(p.pick(3, 4, 5, 6), p.u(0.3, 0.6)) if shape == "star" else None
            p.rod(shape, (0, 0, -r * p.u(0.3, 1)), (0, 0, r * 0.9), r, top, paint, joint, 0.1, star)


def plant(p: Puppet):
    """A tree, flowers, grass, coral or a flag: stems that bend, cloth that waves."""
    kind = p.pick("tree", "flower", "grass", "flag", "coral")
    p.motions.append(f"{kind} sways")
    if kind == "flag":
        p.rod("pole", (0, 0, 0), (0, 0, 1.3), 0.025, 0.02, "metal")
        p.ball("knob", 0.05, "accent", 0, (0, 0, 1.32))
        u, v = np.meshgrid(np.linspace(0, 1, 24), np.linspace(0, 1, 14), indexing="ij")
        deep, k, slope, sag = p.u(0.05, 0.15), p.u(4, 9), p.u(-2, 2), p.u(0, 0.3)
        wave = np.stack([np.sin(k * u + slope * v - TAU * p.tempo * t) for t in p.t])
        wave = wave * deep * u**0.7 * p.energy
        wide, tall = p.u(0.6, 1.1), p.u(0.35, 0.6)
        cloth = np.stack([0 * wave + u * wide, wave, 1.25 - tall * v - sag * u + 0.3 * wave], -1)
        p.add("cloth", sheet(cloth), p.pick("skin", "accent", "second"), flat=False)
        return
    low, high = {"tree": (1, 2), "flower": (1, 5), "grass": (8, 20), "coral": (4, 9)}[kind]
    count = p.rng.integers(low, high)
    if kind != "tree" and p.chance(0.6):
        p.rod("pot", (0, 0, -0.25), (0, 0, 0.05), 0.18, 0.28, p.pick("accent", "second"), 0, 0.1)
    for _ in range(count):
        tall, angle, spread = p.u(0.5, 1.1), p.u(0, TAU), p.u(0, 0.5) if count > 1 else 0
        root = (np.array([np.cos(angle), np.sin(angle), 0])) * p.u(0, 0.2) * (count > 1)
        turn = p.joint(0, root, tilt=rotation(Z, angle) @ rotation(Y, spread))
        thick = {"tree": p.u(0.06, 0.12), "coral": p.u(0.05, 0.1), "grass": p.u(0.025, 0.05)}.get(kind, 0.025)
        phase, sway = p.u(0, 6), p.u(0.08, 0.25)
        bones = np.tile([0, 0, tall / 4], (4, 1)) + p.rng.normal(size=(4, 3)) * (0.03, 0, 0)
        angles = [p.osc(sway, phase - 0.6 * k) + p.u(-0.1, 0.1) for k in range(4)]
        radii = thick * np.array([1.2, 1, 0.8, 0.7, 0.1 if kind in ("grass", "coral") else 0.6])
        paint = "dark" if kind == "tree" else p.pick("skin", "second")
        tip = p.chain("stem", turn, (0, 0, 0), bones, angles, Y, radii, paint)
        if kind == "tree":
            for _ in range(p.rng.integers(1, 7)):
                size, at, lumps = p.rng.uniform(0.15, 0.4, 3), p.rng.normal(size=3) * 0.15, p.pick(0, 0.1, 0.2)
                p.ball("crown", size, p.pick("skin", "skin", "accent"), tip, at, p.u(1.5, 3), lumps=lumps)
        elif kind == "flower":
            petals, long = int(p.rng.integers(4, 10)), p.u(0.1, 0.22)
            p.ball("heart", (0.07, 0.07, 0.05), "light", tip)
            for k in range(petals):
                bloom = p.joint(tip, (0, 0, 0), rotation(Y, -0.3 + p.osc(0.4, phase)), rotation(Z, TAU * k / petals))
                p.ball("petal", (long, long * 0.45, 0.02), "accent", bloom, (long * 1.1, 0, 0))
        elif kind == "coral" and p.chance(0.5):
            p.ball("bulb", thick * p.u(1, 2.2), "accent", tip)
