# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras as plain data: rigs (cameras x frames) and the samplers of the paper's evaluation setups.

Every function takes the list of frames of a clip and returns Shots in the order of the frames. All cameras
look at the origin of the normalised space, with Z up; azimuth 0 is the front (Blender's -Y), 90 degrees the
object's left as an artist names it who looks from the front (Blender's -X), elevation is counted from the
XY plane. numpy only. What is random is seeded: the same seed gives the same Shots on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

DISTANCE = 2.7  # of most cameras from the origin, in normalised units
FOV = 50.0  # degrees, full field of view
RADIUS = 1.1  # of the ball around the origin that holds every object, see `scene.measure.normalisation`
NEAREST = RADIUS / math.sin(math.radians(FOV) / 2)  # a camera that is nearer does not see this ball whole
COVERAGE_VIEWS = 24  # at least, of the rig `coverage`
CANONICAL = {"front": 0.0, "left": 90.0, "back": 180.0, "right": 270.0}  # camera id -> azimuth in degrees


@dataclass
class Shot:
    """One picture to take: a camera at a frame. `fov` is the full field of view of the longer image side, `shift`
    how far the picture is moved right and up in its plane, in parts of that side."""

    frame: int
    camera: str
    rig: str
    c2w: np.ndarray  # (4,4) float64, OpenGL axes, normalised space
    fov: float = FOV  # degrees
    shift: tuple[float, float] = (0.0, 0.0)


def look_at(position, target=(0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0)) -> np.ndarray:
    """(4,4) camera-to-world in OpenGL axes of a camera at `position` that looks at `target`. Where it looks
    along `up`, the image's upper edge points to +Y. Raises ValueError where position and target agree."""
    position, up = np.asarray(position, float), np.asarray(up, float)
    back = position - np.asarray(target, float)
    norm = np.linalg.norm(back)
    if not norm > 0:
        raise ValueError("a camera cannot look at the place where it stands")
    back = back / norm
    right = np.cross(up, back)
    if np.linalg.norm(right) < 1e-9:
        right = np.cross((0.0, 1.0, 0.0), back)
    right = right / np.linalg.norm(right)
    c2w = np.eye(4)
    c2w[:3] = np.stack([right, np.cross(back, right), back, position], 1)
    return c2w


def spherical(azimuth: float, elevation: float, distance: float = DISTANCE) -> np.ndarray:
    """(4,4) of a camera at azimuth and elevation in degrees that looks at the origin."""
    a, e = math.radians(azimuth), math.radians(elevation)
    direction = (-math.sin(a) * math.cos(e), -math.cos(a) * math.cos(e), math.sin(e))
    return look_at(distance * np.array(direction))


def _phase(frames: Sequence[int]) -> np.ndarray:
    """(F,) 0..1 from the first frame to the last; 0 for a single frame."""
    return np.linspace(0, 1, len(frames)) if len(frames) > 1 else np.zeros(len(frames))


# ---------------------------------------------------------------- rigs


def canonical(frames: Sequence[int], seed: int = 0) -> list[Shot]:
    """Four cameras that stand still at elevation 0: front, left, back, right."""
    poses = {name: spherical(azimuth, 0) for name, azimuth in CANONICAL.items()}
    return [Shot(f, name, "canonical", pose) for f in frames for name, pose in poses.items()]


def elevated(frames: Sequence[int], seed: int = 0) -> list[Shot]:
    """One camera that goes once around the object over the clip, 20 to 45 degrees above it; where it
    starts, how high it is and which way it turns are drawn from the seed."""
    rng = np.random.default_rng([seed, 1])
    start, elevation, turn = rng.uniform(0, 360), rng.uniform(20, 45), rng.choice([-360, 360])
    poses = [spherical(start + turn * p, elevation) for p in _phase(frames)]
    return [Shot(f, "elevated", "elevated", pose) for f, pose in zip(frames, poses, strict=True)]


def orbit(frames: Sequence[int], seed: int = 0) -> list[Shot]:
    """One camera on an orbit of its own: start, sense, half to one and a half turns, a swing of the
    elevation within [-20,50] degrees and of the distance within [NEAREST,3.5] are drawn from the seed."""
    rng = np.random.default_rng([seed, 2])
    start, turn = rng.uniform(0, 360), rng.choice([-1, 1]) * rng.uniform(180, 540)
    middle, swing = rng.uniform(0, 30), rng.uniform(0, 20)
    far, near = rng.uniform(DISTANCE, 3.5), rng.uniform(NEAREST, DISTANCE)
    phase_e, phase_d = rng.uniform(0, 2 * math.pi, 2)
    shots = []
    for f, p in zip(frames, _phase(frames), strict=True):
        elevation = middle + swing * math.sin(2 * math.pi * p + phase_e)
        distance = near + (far - near) * (0.5 + 0.5 * math.sin(2 * math.pi * p + phase_d))
        shots.append(Shot(f, "orbit", "orbit", spherical(start + turn * p, elevation, distance)))
    return shots


def random_poses(
    frames: Sequence[int],
    seed: int = 0,
    *,
    per_frame: int = 1,
    distance: tuple[float, float] = (DISTANCE, DISTANCE),
    rig: str = "random",
) -> list[Shot]:
    """`per_frame` independent poses at every frame: azimuth uniform, elevation uniform in [-30,60] degrees,
    distance uniform in the given range. The cameras are named `<rig>0`, `<rig>1`, …"""
    rng = np.random.default_rng([seed, 3, *rig.encode()])
    shots = []
    for f in frames:
        for i in range(per_frame):
            pose = spherical(rng.uniform(0, 360), rng.uniform(-30, 60), rng.uniform(*distance))
            shots.append(Shot(f, f"{rig}{i}", rig, pose))
    return shots


def rotating(frames: Sequence[int], seed: int = 0) -> list[Shot]:
    """Two cameras at every frame that go from front to back, one via the left, the other via the right."""
    shots = []
    for f, p in zip(frames, _phase(frames), strict=True):
        shots.append(Shot(f, "via_left", "rotating", spherical(180 * p, 0)))
        shots.append(Shot(f, "via_right", "rotating", spherical(-180 * p, 0)))
    return shots


def default_rig(frames: Sequence[int], seed: int = 0) -> list[Shot]:
    """The training rig: canonical, elevated and orbit; 6 cameras, 144 Shots over 24 frames."""
    shots = canonical(frames) + elevated(frames, seed) + orbit(frames, seed)
    return sorted(shots, key=lambda s: s.frame)  # stable: the cameras of a frame stay together


def mixed(frames: Sequence[int], seed: int = 0) -> list[Shot]:
    """As many views as the default rig has, from all around: the canonical cameras, and two random poses a frame."""
    return sorted(canonical(frames) + random_poses(frames, seed, per_frame=2), key=lambda s: s.frame)


def coverage(frames: Sequence[int], seed: int = 0) -> list[Shot]:
    """One view a frame, or more where there are fewer frames than COVERAGE_VIEWS: by fours around the object, in turn
    at its height, 40 degrees above and 30 below, each four turned against those before, so that tops and undersides
    are seen too."""
    each, shots = -(-COVERAGE_VIEWS // max(len(frames), 1)), []
    for i, f in enumerate(frames):
        for k in range(i * each, (i + 1) * each):
            row, side = divmod(k % COVERAGE_VIEWS, 4)
            azimuth = 90 * side + 22.5 * ((2 * row + row // 4) % 4)
            pose = spherical(azimuth, (0, 40, -30)[row % 3])
            shots.append(Shot(f, f"coverage{k % COVERAGE_VIEWS}", "coverage", pose))
    return shots


def turntable(frames: Sequence[int], seed: int = 0) -> list[Shot]:
    """For showing: one camera that goes once around the object over the clip, 20 degrees above it."""
    return [Shot(f, "turntable", "turntable", spherical(360 * i / len(frames), 20)) for i, f in enumerate(frames)]


def demo_rig(frames: Sequence[int], seed: int = 0) -> list[Shot]:
    """Alternating canonical views as input, and a turntable to show the result from."""
    return sorted(alternating(frames, seed) + turntable(frames, seed), key=lambda s: s.frame)


def targets(frames: Sequence[int], seed: int = 0, per_frame: int = 1) -> list[Shot]:
    """Held-out views for scoring: random poses of the rig "target". The rig's name is part of the random
    stream, so with the same seed they never repeat an input pose."""
    return random_poses(frames, seed, per_frame=per_frame, rig="target")


# ---------------------------------------------------------------- the paper's evaluation setups


def alternating(frames: Sequence[int], seed: int = 0) -> list[Shot]:
    """Alternating Canonical Views: one view a frame, cycling front, left, back, right."""
    names = list(CANONICAL)
    shots = [Shot(f, names[i % 4], "alternating", spherical(CANONICAL[names[i % 4]], 0)) for i, f in enumerate(frames)]
    return shots


def interpolation(frames: Sequence[int], seed: int = 0) -> list[Shot]:
    """Frame Interpolation: two opposite canonical views at every other frame from the first on (front and
    back, then left and right), nothing at the frames between; 24 views of 24 frames. (The paper does not
    say which two; opposite ones see the whole object at each moment.)"""
    shots = []
    for i, f in enumerate(frames[::2]):
        for name in (("front", "back"), ("left", "right"))[i % 2]:
            shots.append(Shot(f, name, "interpolation", spherical(CANONICAL[name], 0)))
    return shots


def two_rotating(frames: Sequence[int], seed: int = 0) -> list[Shot]:
    """Two Rotating Cameras: of `rotating`, the camera via the right at frames 0, 2, …, via the left at 1,
    3, …; one view a frame."""
    both = rotating(frames)
    return [both[2 * i + (0 if i % 2 else 1)] for i in range(len(frames))]


def random_inputs(frames: Sequence[int], seed: int = 0) -> list[Shot]:
    """Random Input Views: one random pose a frame."""
    return random_poses(frames, seed)


def single_view_video(frames: Sequence[int], seed: int = 0) -> list[Shot]:
    """A video from the front, with the four canonical views of its first frame: 27 views of 24 frames."""
    shots = canonical(frames[:1]) + [s for s in canonical(frames[1:]) if s.camera == "front"]
    return [replace(s, rig="video") for s in shots]


def evaluation(frames: Sequence[int], seed: int = 0) -> list[Shot]:
    """What every table of the paper takes its views from, rendered once: the four canonical cameras, the two
    rotating ones in turn, and four random poses a frame."""
    shots = canonical(frames) + [replace(s, rig="two_rotating") for s in two_rotating(frames)]
    return sorted(shots + random_poses(frames, seed, per_frame=4), key=lambda s: s.frame)


SETUPS: dict[str, Callable[[Sequence[int], int], list[Shot]]] = {
    "alternating": alternating,
    "interpolation": interpolation,
    "rotating": two_rotating,
    "random": random_inputs,
    "video": single_view_video,
}

RIGS: dict[str, Callable[[Sequence[int], int], list[Shot]]] = {
    "default": default_rig,
    "canonical": canonical,
    "elevated": elevated,
    "orbit": orbit,
    "mixed": mixed,
    "coverage": coverage,
    "turntable": turntable,
    "demo": demo_rig,
    "evaluation": evaluation,
    **SETUPS,
}
