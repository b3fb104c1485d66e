# SPDX-License-Identifier: GPL-3.0-or-later
"""Tracks of surface points that a renderer followed, in the colours that the views show them in.

Each point rides on a path (`shared_paths`); its colour is the mean of what those views show where it is that see it.
What no view sees takes the colour of the nearest point that one does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ...datagen.track_file import SurfaceTracks
from ..rasterize.constants import BLUR
from ..rotations import rotation_matrix
from ..tracks import LOOKS, Tracks4D
from ..views import Views
from .shared_paths import ride


@dataclass(frozen=True)
class TrackSettings:
    """How surface points become tracks."""

    tolerance: float = 0.15  # of a path from its points, in pixels
    points_a_pixel: float = 1.0  # of surface, the size of a pixel at the object's middle
    least: int = 4000  # points …
    densest: float = 4.0  # … but no more a pixel of surface, or each is so faint that it is left out
    most: int = 100_000
    footprint: float = 0.65  # σ along the surface, in distances between points
    thickness: float = 0.1  # σ across it, the same
    least_share: float = 0.4  # of what is seen of a point must be seen of a side that has looks of its own
    apart: float = 0.15  # how far above the surface the two sides of a sheet are, in pixels
    inset: float = 0.8  # how far below the surface a track sits, in pixels: its own width reaches back out to it
    cover: float = 0.93  # opacity that the tracks have together at each place of the surface …
    opacity: float = 0.95  # … and one has at most
    depth_tolerance: float = 0.3  # pixels by which a visible point may miss the depth, if its surface is not steep


SETTINGS = TrackSettings()
LED = TrackSettings(tolerance=0.3)  # of points that motion vectors lead, to not much better than that
STEEPEST = 0.25  # cosine: what is seen under less is taken to be seen under this


def needed_points(surface: SurfaceTracks, views: Views, settings: TrackSettings = SETTINGS) -> int:
    """How many points the views' pixels need, of those that there are."""
    pixels = _pixels(surface, views)
    least = min(settings.least, settings.densest * pixels)
    wanted = min(max(settings.points_a_pixel * pixels, least), settings.most)
    return min(max(round(wanted), 1), len(surface))


def _pixels(surface: SurfaceTracks, views: Views) -> float:
    """How many pixels the surface would fill, laid out before the views."""
    return float(surface.area.sum()) / views.pixel**2


def surface_tracks(
    surface: SurfaceTracks, views: Views, count: int | None = None, settings: TrackSettings = SETTINGS
) -> Tracks4D:
    """`count` of the points of `surface`, or as many as the views' pixels need, as tracks on the CPU: one each, and two
    on a sheet that is seen from both sides. The views have depth. None where there are no points."""
    pixel = views.pixel
    whole = float(surface.area.sum())
    most = max(round(settings.densest * _pixels(surface, views)), 1)
    chosen = min(count or needed_points(surface, views, settings), most, len(surface))
    rows = ((np.arange(chosen) + 0.5) * len(surface) / chosen).astype(int) if chosen else np.zeros(0, int)
    place = torch.from_numpy(surface.position[rows])
    turn = F.normalize(torch.from_numpy(surface.rotation[rows].astype(np.float32)), dim=-1)
    window = torch.from_numpy(np.stack([surface.first, surface.last], 1)[rows]).long()
    path, offset, rotation, paths = ride(place, turn, window, settings.tolerance * pixel)
    spacing = (whole / chosen) ** 0.5 if chosen else pixel
    # Seen squarely, by how many each place is covered, as wide as the rasteriser draws them. More opacity than this
    # makes silhouettes, where one looks along the surface, too wide: three times as much cost 3 dB.
    layers = 2 * math.pi * (settings.footprint**2 + BLUR * (pixel / spacing) ** 2)
    opacity = min(settings.opacity, settings.cover / layers)
    scale = spacing * torch.tensor([settings.footprint, settings.footprint, settings.thickness])
    n = len(rows)
    points = Tracks4D(offset, scale.expand(n, 3), rotation, torch.zeros(n, 3), torch.full((n,), opacity), path, paths)
    total, weight = colours(points, views, settings.depth_tolerance)
    # A thin sheet that is seen from both sides has looks on each, which sit on it; what is closed has them below it.
    known = weight > settings.least_share * weight.sum(0)
    both = known.all(0)
    normal = rotation_matrix(rotation)[..., 2]
    parts = []
    for side, sign in enumerate((1.0, -1.0)):
        mine = known[side].nonzero()[:, 0]
        inset = torch.where(both[mine], -settings.apart, settings.inset)[:, None] * pixel * sign
        part = points[mine]
        rgb = total[side, mine] / weight[side, mine, None]
        parts.append(replace(part, rgb=rgb, offset=part.offset - inset * normal[mine]))
    seen = torch.cat([known[0].nonzero()[:, 0], known[1].nonzero()[:, 0]])
    unseen = (~known.any(0)).nonzero()[:, 0]
    tracks = _joined(parts)
    if len(seen) and len(unseen):
        parts.append(replace(points[unseen], rgb=tracks.rgb[_nearest(points, unseen, seen)]))
        tracks = _joined(parts)
    if len(tracks) > settings.most:  # of sheets with two sides
        tracks = tracks[torch.linspace(0, len(tracks) - 1, settings.most).round().long()]
    return tracks


def _joined(parts: list[Tracks4D]) -> Tracks4D:
    """Tracks of the same paths together."""
    return replace(parts[0], **{k: torch.cat([getattr(p, k) for p in parts]) for k in (*LOOKS, "path")})


def _nearest(points: Tracks4D, those: Tensor, among: Tensor, most: int = 8000) -> Tensor:
    """(n,) for each of `those` (n,) the place in `among` (m,) of the point that is nearest at the middle of the clip;
    of more than `most` an even choice is looked at."""
    here = points.at(0.0).xyz
    some = torch.linspace(0, len(among) - 1, min(len(among), most)).round().long()
    near = [torch.cdist(here[part], here[among[some]]).argmin(1) for part in those.split(4000)]
    return some[torch.cat(near)]


def colours(tracks: Tracks4D, views: Views, depth_tolerance: float) -> tuple[Tensor, Tensor]:
    """What the views with depth show of each track, from the side that its normal (the third axis) points to, and from
    the other: the sum of colours (2,N,3), and of their weights (2,N), which are greater where it is seen squarely."""
    total, weight = torch.zeros(2, len(tracks), 3), torch.zeros(2, len(tracks))
    height, width = views.size
    for t in views.time.unique().tolist():
        g = tracks.at(t)
        normal = rotation_matrix(g.rotation)[..., 2]
        for v in (views.time == t).nonzero()[:, 0].tolist():
            w2c = torch.linalg.inv(views.c2w[v])
            x = g.xyz @ w2c[:3, :3].T + w2c[:3, 3]
            fx, fy, cx, cy = views.intrinsics[v].tolist()
            z = x[:, 2].clamp_min(1e-6)
            at = torch.stack([(x[:, 0] / z * fx + cx) / width, (x[:, 1] / z * fy + cy) / height], -1) * 2 - 1
            cosine = (normal * F.normalize(views.c2w[v, :3, 3] - g.xyz, dim=-1)).sum(-1)
            facing = cosine.abs().clamp_min(STEEPEST)
            slope = (1 - facing.square()).sqrt() / facing  # of depth, for half a pixel that the point may be off
            tolerance = (depth_tolerance + 0.5 * slope) * z / fx
            depth = _sample(views.depth[v][None], at, "nearest")[0]
            seen = (at.abs() < 1).all(-1) & ((z - depth).abs() < tolerance) & (g.opacity > 0)
            a = views.alpha[v]
            shown = _sample(torch.cat([(views.rgb[v] * a[..., None]).movedim(-1, 0), a[None]]), at, "bilinear")
            for side, facing in enumerate((cosine, -cosine)):
                w = torch.where(seen & (shown[3] > 0), facing.clamp_min(0), 0.0)
                total[side] += w[:, None] * shown[:3].T
                weight[side] += w * shown[3]
    return total, weight


def _sample(image: Tensor, at: Tensor, mode: str) -> Tensor:
    """image (C,H,W) at (N,2) places, -1..1 over it -> (C,N)."""
    return F.grid_sample(image[None], at[None, None], mode=mode, align_corners=False)[0, :, 0]
