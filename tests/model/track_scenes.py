# SPDX-License-Identifier: GPL-3.0-or-later
"""A small scene for tests of tracks: a patterned ball that turns and goes along, with its surface points and views that
have depth."""

import math

import numpy as np
import torch

from timesplat.datagen.rigs import spherical
from timesplat.datagen.sequence import opengl_to_opencv
from timesplat.datagen.track_file import SurfaceTracks
from timesplat.model.rasterize import render
from timesplat.model.rotations import quaternion_from_matrix, quaternion_multiply
from timesplat.model.tracks import Paths, Tracks4D
from timesplat.model.views import Views

RADIUS, FRAMES, SIZE, FOCAL = 0.6, 9, 48, 52.0


def sphere_points(n: int) -> torch.Tensor:
    """(n,3) evenly spread unit vectors (Fibonacci's spiral)."""
    i = torch.arange(n) + 0.5
    z, a = 1 - 2 * i / n, i * math.pi * (3 - math.sqrt(5))
    r = (1 - z * z).sqrt()
    return torch.stack([r * a.cos(), r * a.sin(), z], -1)


def frames_on(normal: torch.Tensor) -> torch.Tensor:
    """(n,4) rotations whose third axis is the normal (n,3)."""
    x = torch.linalg.cross(normal, torch.tensor([0.3, 0.5, 0.8]).expand_as(normal))
    x = torch.nn.functional.normalize(x, dim=-1)
    return quaternion_from_matrix(torch.stack([x, torch.linalg.cross(normal, x), normal], -1))


def motion() -> tuple[torch.Tensor, torch.Tensor]:
    """Place (F,3) and rotation (F,4) of the ball at each frame."""
    s = torch.linspace(0, 1, FRAMES)
    angle = 1.2 * s
    turn = torch.stack([(angle / 2).cos(), 0 * s, 0 * s, (angle / 2).sin()], -1)
    return torch.stack([0.3 * s - 0.15, 0 * s, 0.1 * (3 * s).sin()], -1), turn


def pattern(normal: torch.Tensor) -> torch.Tensor:
    """(n,3) a colour for each point of the unit ball: bands."""
    band = (7 * normal[:, 2]).sin() * (4 * torch.atan2(normal[:, 1], normal[:, 0])).cos() > 0
    return torch.where(band[:, None], torch.tensor([0.9, 0.2, 0.1]), torch.tensor([0.1, 0.3, 0.8]))


def ball(n: int = 3000) -> Tracks4D:
    """The ball as tracks on one path of a knot a frame."""
    place, turn = motion()
    normal = sphere_points(n)
    one = torch.ones(1)
    side = RADIUS * math.sqrt(4 * math.pi / n)
    return Tracks4D(
        offset=RADIUS * normal,
        scale=torch.tensor([0.5 * side, 0.5 * side, 0.1 * side]).expand(n, 3).clone(),
        rotation=frames_on(normal),
        rgb=pattern(normal),
        opacity=torch.full((n,), 0.95),
        path=torch.zeros(n, dtype=torch.long),
        paths=Paths(-one, one, torch.tensor([FRAMES]), place, turn),
    )


def surface(n: int = 600) -> SurfaceTracks:
    """What a renderer would write of it."""
    _place, turn = motion()
    normal = sphere_points(n)
    q = quaternion_multiply(turn[None], frames_on(normal)[:, None])
    x = torch.stack([Tracks4D.at(_points(normal), 2 * f / (FRAMES - 1) - 1).xyz for f in range(FRAMES)], 1)
    whole = np.zeros(n, np.int32)
    area = np.full(n, 4 * math.pi * RADIUS**2 / n, np.float32)
    return SurfaceTracks(x.numpy(), q.numpy().astype(np.float16), whole, whole + FRAMES - 1, area)


def _points(normal: torch.Tensor) -> Tracks4D:
    tracks = ball(len(normal))
    tracks.offset = RADIUS * normal
    return tracks


def views(count: int = 18, seed: int = 0, elevation: float = 50) -> Views:
    """Random views of the ball, one a moment in turn, with depth; no motion vectors."""
    rng = np.random.default_rng(seed)
    poses = [spherical(rng.uniform(0, 360), rng.uniform(-elevation, elevation)) for _ in range(count)]
    c2w = torch.from_numpy(opengl_to_opencv(np.stack(poses))).float()
    intrinsics = torch.tensor([[FOCAL, FOCAL, SIZE / 2, SIZE / 2]]).expand(count, 4).clone()
    return shoot(c2w, intrinsics, (torch.arange(count) % FRAMES) * 2 / (FRAMES - 1) - 1)


def views_at(seen: Views, frame: int = 4) -> Views:
    """The same cameras, all at one frame, of a ball that stands still there for the whole clip."""
    place, turn = motion()
    still = ball()
    still.paths = Paths(still.paths.start, still.paths.end, torch.tensor([1]), place[frame, None], turn[frame, None])
    return shoot(seen.c2w, seen.intrinsics, seen.time, still)


def shoot(c2w, intrinsics, time, scene: Tracks4D | None = None) -> Views:
    """What cameras see of the ball, or of another one."""
    scene = scene or ball()
    rgb, alpha = render(scene, c2w, intrinsics, time, SIZE, SIZE, background=0.0)
    depth = torch.full_like(alpha, torch.inf)
    for v in range(len(time)):  # the ball's own, exactly
        centre, _ = scene.paths.at(float(time[v]))
        ray = _rays(c2w[v])
        away = c2w[v, :3, 3] - centre[0]
        b, c = (ray * away).sum(-1), away @ away - RADIUS**2
        root = b * b - (ray * ray).sum(-1) * c
        hit = (-b - root.clamp_min(0).sqrt()) / (ray * ray).sum(-1)
        depth[v] = torch.where(root > 0, hit, torch.inf)
    depth = torch.where(alpha > 0.5, depth, torch.inf)
    rgb = rgb / alpha.clamp_min(1e-4)[..., None]
    return Views(rgb, alpha, c2w, intrinsics, time, 2 / (FRAMES - 1), depth, torch.zeros(*alpha.shape, 4), surface())


def _rays(c2w: torch.Tensor) -> torch.Tensor:
    """(H,W,3) directions in the world, of planar depth 1."""
    at = (torch.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL
    y, x = torch.meshgrid(at, at, indexing="ij")
    return torch.stack([x, y, torch.ones_like(x)], -1) @ c2w[:3, :3].T


def psnr(scene, of: Views) -> float:
    """Mean over the views, over white, with the inference filters."""
    rgb, _ = render(scene, of.c2w, of.intrinsics, of.time, SIZE, SIZE, inference=True)
    return float((-10 * (rgb - of.over()).square().mean((1, 2, 3)).log10()).mean())
