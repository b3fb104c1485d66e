# SPDX-License-Identifier: GPL-3.0-or-later
"""The families of the procedural zoo that go on legs, and the heads and tails of all animals. numpy only.

A family builds one object on a `Puppet`, about 1 long or high, and appends to `p.motions` what it makes it
do. Sizes are drawn wide, because a reconstruction model should see more than what exists.
"""

from __future__ import annotations

import numpy as np

from .puppet import FRAMES, TAU, Puppet
from .shapes import X, Y, Z, blob, lumpy, rotation, sheet, torus, translation, tube


def walker(p: Puppet):
    """An animal on two to eight legs: pets made of boxes, or organic ones of tubes."""
    p.motions.append("walk cycle")
    pairs = int(p.rng.choice([1, 2, 3, 4], p=[0.15, 0.65, 0.1, 0.1]))
    toy, insect = p.chance(0.3), pairs > 2
    leg = p.u(0.12, 0.3) if toy or insect else p.u(0.25, 0.75)
    width, height = p.u(0.12, 0.22), p.u(0.12, 0.24)
    length = p.u(0.28, 0.38) if toy else p.u(0.2, 0.35) if pairs == 1 else p.u(0.35, 0.6)
    if toy:
        width, height = p.u(0.22, 0.32), p.u(0.2, 0.3)
    bob = np.stack([0 * p.t, 0 * p.t, p.osc(p.u(0, 0.06), 0.5, 2)], -1)
    body = p.joint(0, (0, 0, leg + height * 0.8), translation(bob) @ rotation(X, p.osc(p.u(0, 0.15), p.u(0, 6))))
    if toy:
        p.ball("body", (width, length, height), joint=body, power=p.u(3, 9))
    elif insect and p.chance(0.6):
        for k in range(p.rng.integers(2, 4)):
            p.ball(
                "body", np.array([width, length * 0.5, height]) * p.u(0.6, 1.1), joint=body, at=(0, 0.5 * k * length, 0)
            )
    else:
        y = np.linspace(-length, length, 6)
        bulge = np.array([0.6, 1, 1, 0.9, 0.95, 0.6]) * p.rng.uniform(0.75, 1.15, 6)
        points = np.stack([0 * y, y, p.u(-0.12, 0.12) * y + height * p.u(-0.2, 0.3) * np.cos(y / length * 1.6)], -1)
        p.add("body", tube(points, np.stack([width * bulge, height * bulge], -1), Z, p.sides + 4), joint=body)
    _legs(p, body, pairs, leg + height * 0.8, width, length, insect)
    size = p.u(0.2, 0.34) if toy else p.u(0.1, 0.18)
    if insect or toy:
        neck = p.joint(body, (0, -length - size * p.u(0, 0.5), p.u(0, 0.6) * height), nod(p))
    else:
        reach, rise = p.u(0.05, 0.25), p.u(-0.03, 0.5)
        bones = np.array([[0, -reach, rise], [0, -reach, rise]]) * 0.6
        nods = [p.osc(0.15, p.u(0, 6)), p.osc(0.15, p.u(0, 6))]
        radii = np.array([height * 0.75, size * 0.75, size * 0.6])
        neck = p.chain("neck", body, (0, -length * 0.85, height * 0.3), bones, nods, X, radii)
    head(p, neck, size, box=toy and p.chance(0.6))
    if p.chance(0.8):
        tail(p, body, (0, length * 0.95, height * 0.3), p.u(0.15, 0.9), p.u(0.03, 0.08))
    extra = p.rng.uniform()
    if extra < 0.2:
        _spikes(p, body, length, height)
    elif extra < 0.3:
        p.ball("pack", (width * 0.8, length * 0.4, height * 0.6), "second", body, (0, 0, height), p.u(2, 8))


def _legs(p, body, pairs, drop, width, length, splayed):
    radius = p.u(0.03, 0.075)
    gait, stride, knee = p.pick(0.5, 0.5, 0.25, 0.0), p.u(0.35, 0.75), p.u(0.1, 0.9)
    soft, paint = p.chance(0.6), p.pick("skin", "skin", "second", "dark")
    foot = p.pick("skin", "dark", "second")
    shape, slope, long, toes = radius * np.array([p.u(1.2, 1.9), 1, 0.85]), p.u(0, 0.08), p.u(1, 2.4), p.pick(2, 5)
    out, up = p.u(0.25, 0.4), drop * p.u(0.3, 1.0)
    rows = np.linspace(-0.75, 0.75, pairs) * length if pairs > 1 else [0.0]
    for row, y in enumerate(rows):
        for side in (-1, 1):
            phase = TAU * (gait * row + (0.5 if side > 0 else 0.0))
            bend = knee * p.energy * 0.5 * (1 + np.sin(TAU * p.tempo * p.t + phase + 1.6))
            if splayed:
                # Insect legs rise to the knee and come down outside; they row about the vertical.
                hip = p.joint(body, (side * width * 0.7, y, 0), rotation(Z, p.osc(stride * 0.7, phase)))
                bones = [(side * out, y * 0.4, up), (side * out * 0.8, y * 0.4, -up - drop * 0.97)]
                lift = side * p.osc(0.2, phase + 1.6)
                thin = radius * np.array([1, 0.7, 0.3])
                p.chain("leg", hip, (0, 0, 0), bones, [lift, 0 * lift], Y, thin, paint, False)
                continue
            front = 1 if row < pairs / 2 else -1
            slant = slope * front
            bones = [(0, -slant, -drop * 0.5), (0, slant, -drop * 0.5 + radius)]
            angles = [p.osc(stride, phase), -bend if pairs == 1 else bend * front]
            at = (side * max(width * 0.75, radius), y, 0)
            tip = p.chain("leg", body, at, bones, angles, X, shape, paint, soft)
            sole = radius * np.array([1.1, long, 1])
            p.ball("foot", sole, foot, tip, (0, -radius * (long - 1) * 0.7, 0), toes)


def nod(p: Puppet) -> np.ndarray:
    """The motion of a head on its neck."""
    swing = rotation(X, p.osc(p.u(0, 0.25), p.u(0, 6), p.pick(1, 2)))
    return swing @ rotation(Z, p.osc(p.u(0, 0.4), p.u(0, 6), 0.5))


def head(p: Puppet, joint: int, size: float, box: bool = False, human: bool = False):
    """A head about its joint, looking along -Y: eyes, and some of ears, horns, snout, jaw, hat, hair."""
    power = p.u(4, 9) if box else p.u(1.9, 2.8)
    half = size * np.array([p.u(0.8, 1.1), p.u(0.8, 1.1), p.u(0.8, 1.15)])
    skin = p.pick("flesh", "flesh", "skin") if human else p.pick("skin", "skin", "skin", "second")
    p.ball("head", half, skin, joint, (0, 0, 0), power)
    p.eyes(joint, half, power, radius=p.u(0.1, 0.28), spread=p.u(0.3, 0.7), up=p.u(0, 0.6))
    _muzzle(p, joint, size, half, power, skin, human)
    _ears(p, joint, size, half, skin, human)
    _headgear(p, joint, size, half, power, human)


def _muzzle(p: Puppet, joint: int, size: float, half: np.ndarray, power: float, skin: str, human: bool):
    """A snout, a beak, a nose or nothing."""
    front, top = np.array([0, -half[1], 0]), np.array([0, 0, half[2]])
    muzzle = p.rng.uniform()
    if human:
        muzzle = 0.9 if p.chance(0.4) else 1.0
    if muzzle < 0.4:
        r = size * p.u(0.3, 0.6)
        at = front * 0.8 - top * p.u(0.1, 0.5)
        long = size * p.u(0.2, 1.2)
        p.ball("snout", (r, r * 0.5 + long, r * p.u(0.6, 1)), p.pick(skin, "light", "second"), joint, at, power)
        p.ball("nose", size * p.u(0.1, 0.2), "black", joint, at + np.array([0, -r * 0.5 - long, r * 0.3]))
        if p.chance(0.4):
            jaw = p.joint(joint, at - (0, 0, r * 0.6), rotation(X, np.abs(p.osc(0.5))))
            p.ball("jaw", (r * 0.9, r * 0.5 + long, r * 0.25), skin, jaw, (0, -r * 0.3, -r * 0.1), power)
    elif muzzle < 0.65:
        for up in (1, -1):
            beak = p.joint(joint, front * 0.85 - top * 0.15, rotation(X, up * np.abs(p.osc(0.3))))
            p.rod("beak", (0, 0, 0), (0, -size * p.u(0.5, 1.2), -size * 0.1), size * 0.3, 0, "accent", beak, 0.2)
    elif muzzle < 0.95:
        p.ball("nose", size * p.u(0.08, 0.25), p.pick("black", "accent", skin), joint, front * 1.05 - top * 0.1)


def _ears(p: Puppet, joint: int, size: float, half: np.ndarray, skin: str, human: bool):
    """Pointed or round ears, horns or nothing."""
    ears = p.rng.uniform() if not human else 1.0
    tilt, long, curl, horn = p.u(0.1, 0.9), size * p.u(0.3, 1.4), p.u(0.6, 1.6), p.pick("light", "dark")
    for side in (-1, 1):
        at = (side * half[0] * 0.6, 0, half[2] * 0.75)
        twitch = rotation(Y, side * (tilt + p.osc(0.3, 0, 2)))
        if ears < 0.3:
            p.rod("ear", (0, 0, 0), (0, 0, long), size * 0.3, 0.01, skin, p.joint(joint, at, twitch), 0.2)
        elif ears < 0.5:
            ear = p.joint(joint, at, twitch)
            p.ball("ear", (size * 0.25, size * 0.1, long * 0.6), "second", ear, (0, 0, long * 0.4))
        elif ears < 0.65:
            bones = size * np.array([(side * 0.4, 0, 0.3), (side * 0.2, -0.2, 0.4), (0, -0.3, 0.3)]) * curl
            p.chain("horn", joint, at, bones, [0 * p.t] * 3, X, size * np.array([0.18, 0.13, 0.08, 0.01]), horn)


def _headgear(p: Puppet, joint: int, size: float, half: np.ndarray, power: float, human: bool):
    """Hair, a helmet, a hat, a mane or nothing."""
    top = np.array([0, 0, half[2]])
    hat = p.rng.uniform()
    hair = p.pick("second", "dark", "accent")
    if human and hat < 0.45:
        p.ball("hair", half * (1.08, 1.05, 0.75), hair, joint, half * (0, 0.15, 0.42), power, lumps=p.pick(0, 0.15))
    elif human and hat < 0.6:
        p.ball("helmet", half * (1.15, 1.15, 0.9), "metal", joint, half * (0, 0.2, 0.35), power)
    elif hat < (0.85 if human else 0.12):
        p.rod("brim", top * 0.75, top * 0.85, size * 1.25, None, "accent", joint, 0.1)
        p.rod("hat", top * 0.8, top * p.u(1.2, 2.2), size * 0.8, size * p.u(0.05, 0.8), "accent", joint, 0.1)
    elif not human and hat < 0.22:
        ring, faces = torus(size * 0.85, size * 0.4, 16, 8)
        mane = lumpy(ring, p.rng, 0.1, 1.6 / size), faces
        p.add("mane", mane, "second", joint, half * (0, 0.3, 0), rotation(X, np.pi / 2))


def tail(p: Puppet, joint: int, at, length: float, radius: float, bones: int = 5):
    """A tail that wags sideways or up and down as a travelling wave, thin or bushy."""
    rise, axis = p.u(-0.6, 0.9), p.pick(Z, X)
    steps = np.stack([np.zeros(bones), np.ones(bones), np.linspace(rise, rise * p.u(-1, 1), bones)], -1)
    steps *= length / bones
    wag, lag = p.u(0.1, 0.35), p.u(0.3, 1.0)
    angles = [p.osc(wag, -lag * k) for k in range(bones)]
    shape = p.pick(np.linspace(1, 0.15, bones + 1), np.array([0.6, 1, 1.5, 2, 1.6, 0.2])[: bones + 1])
    paint = p.pick("skin", "skin", "second")
    # The bones always go backwards, so that neither axis lies along one.
    return p.chain("tail", joint, at, steps, angles, axis, radius * shape, paint)


def _spikes(p, joint, length, height):
    for y in np.linspace(-0.8, 0.9, p.rng.integers(4, 9)) * length:
        tall = height * p.u(0.4, 1.2)
        top = (0, y + tall * 0.3, height * 0.8 + tall)
        p.rod("spike", (0, y, height * 0.7), top, tall * 0.3, 0, "second", joint, 0.1)


def humanoid(p: Puppet):
    """A figure on two legs: realistic, chibi, robot or a thing with thin limbs; walks, waves, dances, fights."""
    act = p.pick("walk", "walk", "run", "wave", "jump", "punch", "dance", "idle")
    p.motions.append(act)
    chibi, robot = p.chance(0.4), p.chance(0.3)
    thing = not robot and p.chance(0.2)
    leg = p.u(0.2, 0.3) if chibi else p.u(0.42, 0.55)
    torso, broad = p.u(0.22, 0.36), p.u(0.13, 0.24)
    arm, r = leg * p.u(0.7, 0.95), p.u(0.035, 0.065) * (1.2 if chibi else 1)
    pace = {"run": 1.3, "walk": 0.8, "dance": 0.5, "jump": 0.35}.get(act, 0.12)
    beat = TAU * p.tempo * p.t
    lift = 0.35 * np.maximum(np.sin(beat), 0) if act == "jump" else (0.02 + 0.03 * pace) * np.sin(2 * beat)
    sway = p.osc(0.3 if act == "dance" else 0.06)
    move = translation(np.stack([0.2 * sway, 0 * sway, lift * p.energy], -1)) @ rotation(Z, sway)
    lean = rotation(X, np.full(FRAMES, p.u(-0.05, 0.35 if act == "run" else 0.1)))
    hips = p.joint(0, (0, 0, leg), move @ lean)
    twist = rotation(Z, p.osc(0.25 * pace, 0.3)) @ rotation(Y, p.osc(0.35 if act == "dance" else 0.03, 0, 2))
    chest = p.joint(hips, (0, 0, 0.05), twist)
    soft = not robot and p.chance(0.7)
    clothes, trousers = p.pick("skin", "accent"), p.pick("second", "dark", "skin")
    _torso(p, chest, torso, broad, clothes, thing, robot)
    shoe, splay, fist, glove = p.pick(2, 4), p.u(0.1, 0.35), r * p.u(0.95, 1.4), p.pick("flesh", "light")
    # Turning about X by a positive angle takes what hangs down backwards: knees bend so, elbows do not.
    for side in (-1, 1):
        phase = 0.0 if side < 0 or act == "jump" else np.pi
        step = p.osc(pace * 0.75, phase)
        knee = 0.6 * pace * p.energy * (1 + np.sin(beat + phase - 1.0))
        bones = [(0, -0.02 * leg, -leg * 0.5), (0, 0.02 * leg, -leg * 0.5 + r)]
        hip = (side * broad * 0.55, 0, 0.02)
        foot = p.chain("leg", hips, hip, bones, [step, knee], X, [r * 1.35, r * 1.05, r * 0.9], trousers, soft)
        p.ball("shoe", (r * 1.1, r * 1.9, r), "dark", foot, (0, -r * 0.8, 0), shoe)
        raised = act == "wave" and side > 0
        swing = -step * (0.6 if act == "run" else 0.8) - 0.1
        spread = side * (splay + (0.9 * np.abs(p.osc()) if act in ("jump", "dance") else 0))
        elbow = -0.3 - 0.5 * pace - p.osc(0.2, phase)
        if raised:
            swing, spread, elbow = 0 * beat, side * 2.3, p.osc(0.6, 0, 2)
        elif act == "punch":
            hit = np.maximum(np.sin(beat + phase), 0) * p.energy
            swing, elbow = -0.5 - 1.0 * hit, -1.7 * np.clip(1 - hit, 0, 1)
        out = rotation(Y, -spread * np.ones(FRAMES))
        high = torso * (0.6 if thing else 0.92)
        shoulder = p.joint(chest, (side * broad * (1.3 if thing else 1.0), 0, high), out)
        bones = [(0, 0, -arm * 0.5), (0, 0, -arm * 0.5)]
        radii = r * (0.6 if thing else 0.85) * np.array([1.25, 1, 0.8])
        axis = Y if raised else X
        hand = p.chain("arm", shoulder, (0, 0, 0), bones, [swing, elbow], axis, radii, clothes, soft)
        p.ball("hand", fist, glove, hand, (0, 0, -r * 0.4))
        if side > 0 and p.chance(0.3):
            grip = p.joint(hand, (0, 0, -r * 0.4), tilt=rotation(X, p.u(0.8, 1.9)))
            p.rod("handle", (0, 0, r), (0, 0, -0.5), 0.018, None, "second", grip)
            p.ball("tool", (p.u(0.02, 0.1), 0.02, p.u(0.08, 0.25)), "metal", grip, (0, 0, -0.5), p.u(1, 6))
    if not thing:
        size = p.u(0.2, 0.3) if chibi else p.u(0.1, 0.14)
        head(p, p.joint(chest, (0, 0, torso + size * 0.95), nod(p)), size, robot, human=not robot and p.chance(0.8))
    if p.chance(0.2):
        cape(p, chest, (0, broad * 0.8, torso * 0.9), broad * 1.8, leg + torso * p.u(0.3, 0.8))
    elif p.chance(0.25):
        p.ball("backpack", (broad * 0.8, 0.1, torso * 0.4), "second", chest, (0, broad * 0.8, torso * 0.55), p.u(2, 6))


def _torso(p: Puppet, chest: int, torso: float, broad: float, clothes: str, thing: bool, robot: bool):
    """The body of a thing with its eyes, a box, or a tube with a waist."""
    if thing:
        body = np.array([broad * 1.4, broad * 1.3, torso * 0.8])
        bulk, faces = blob(body, p.u(1.6, 5), p.n)
        bulk *= 1 + p.u(-0.4, 0.4) * bulk[:, 2:] / torso
        p.add("body", (lumpy(bulk, p.rng, p.pick(0, 0.06)), faces), "skin", chest, (0, 0, torso * 0.6))
        p.eyes(chest, body, 2, (0, 0, torso * 0.6), p.u(0.15, 0.25), p.u(0.3, 0.6), p.u(0.0, 0.4))
    elif robot or p.chance(0.3):
        p.ball("torso", (broad, broad * 0.65, torso * 0.55), clothes, chest, (0, 0, torso * 0.5), p.u(3, 9))
    else:
        girth = broad * np.array([p.u(0.7, 1.1), p.u(0.6, 1.0), 1.0, p.u(0.7, 1.0)])
        spine = np.stack([np.zeros(4), np.zeros(4), np.linspace(0, torso, 4)], -1)
        p.add("torso", tube(spine, np.stack([girth, girth * 0.62], -1), Y, p.sides + 2, 0.6), clothes, chest)


def cape(p: Puppet, joint: int, at, width: float, length: float):
    """A sheet that hangs down behind and ripples."""
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(0, 1, 12), indexing="ij")
    billow = p.u(0.1, 0.4)
    ripple = [v * billow + 0.12 * v * np.sin(3 * v + 5 * u - TAU * p.tempo * t) * p.energy for t in p.t]
    flat = width * u * (0.7 + 0.5 * v), -length * v
    p.add("cape", sheet(np.stack([np.stack([flat[0], length * r, flat[1]], -1) for r in ripple])), "accent", joint, at)
