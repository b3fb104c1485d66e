# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the object is: the volume that all cameras look at, found from their axes, silhouettes or points alone.

Silhouettes are cut out of a grid a window of time at a time: as many views as show the object at nearly one moment must
agree, and the volume is what any window leaves. All in the world of the cameras, OpenCV axes, positions in its units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sequence import InputError, Normalisation

SIDE = 96  # pixels of the longer side of a silhouette: a hundredth of the volume is a pixel
GRID = 40  # cells along each side of the volume
COARSE = 16  # the same while the volume's box is looked for
WINDOW = 8  # views that are enough to cut with
WINDOWS = 8  # moments of the clip that are looked at
AT_ONCE = 16  # views of a moment that are looked at
RAYS = 200  # of a mask that are looked at
STILL = 60  # views of a still scene that are looked at
MARGIN = 1.02  # the volume is as much larger than what was found


@dataclass
class Silhouettes:
    """V small masks with their cameras and moments."""

    masks: np.ndarray  # (V,h,w) bool
    c2w: np.ndarray  # (V,4,4) OpenCV axes
    intrinsics: np.ndarray  # (V,4) fx fy cx cy in pixels of the masks
    window: np.ndarray  # (V,) int: views of the same window show the same moment, nearly

    def __post_init__(self) -> None:
        m = self.masks
        rim = m[:, 0].any(1) | m[:, -1].any(1) | m[:, :, 0].any(1) | m[:, :, -1].any(1)
        self.whole = ~rim  # (V,) whether the mask does not reach the border

    def project(self, view: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """points (P,3) -> whether each is seen by a view, and whether it is in its mask. A mask that does not reach the
        border is of an object that is seen whole: such a view sees of all other places that the object is not there."""
        R, t = self.c2w[view, :3, :3], self.c2w[view, :3, 3]
        local = (points - t) @ R
        fx, fy, cx, cy = self.intrinsics[view]
        height, width = self.masks.shape[1:]
        with np.errstate(all="ignore"):
            x, y = local[:, 0] / local[:, 2] * fx + cx, local[:, 1] / local[:, 2] * fy + cy
            seen = (local[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
        inside = np.zeros(len(points), bool)
        inside[seen] = self.masks[view][y[seen].astype(int), x[seen].astype(int)]
        return seen | self.whole[view], inside


def chosen_views(frames: np.ndarray) -> list[np.ndarray]:
    """Which views (their indices) are looked at, a window each, of views at `frames` (V,)."""
    moments = np.unique(frames)
    if len(moments) == 1:
        return [np.unique(np.linspace(0, len(frames) - 1, STILL).round().astype(int))]
    if len(frames) / len(moments) >= 3:
        picked = moments[np.unique(np.linspace(0, len(moments) - 1, WINDOWS).round().astype(int))]
        groups = [np.flatnonzero(frames == m) for m in picked]
        return [g[np.unique(np.linspace(0, len(g) - 1, AT_ONCE).round().astype(int))] for g in groups]
    order = np.argsort(frames, kind="stable")
    count = max(len(order) // WINDOW, 1)
    picked = np.unique(np.linspace(0, count - 1, WINDOWS).round().astype(int))
    return [order[k * len(order) // count : (k + 1) * len(order) // count] for k in picked]


def common_point(place: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """place, direction (V,3) unit -> the point nearest to all of these rays, by least squares, and how far along each
    it is (V,); None where they are parallel."""
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    total = across.mean(0)
    if np.linalg.eigvalsh(total)[0] < 1e-6:
        return None
    centre = np.linalg.solve(total, (across @ place[:, :, None]).mean(0)[:, 0])
    return centre, ((centre - place) * direction).sum(1)


def centroid_rays(sil: Silhouettes) -> tuple[np.ndarray, np.ndarray]:
    """Places and unit directions (V,3) of the rays through the masks' middles, of the masks that show anything."""
    shown = np.flatnonzero(sil.masks.any((1, 2)))
    middle = []
    for v in shown:
        y, x = np.nonzero(sil.masks[v])
        fx, fy, cx, cy = sil.intrinsics[v]
        middle.append([(x.mean() + 0.5 - cx) / fx, (y.mean() + 0.5 - cy) / fy, 1.0])
    direction = np.einsum("vij,vj->vi", sil.c2w[shown, :3, :3], np.array(middle).reshape(-1, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return sil.c2w[shown, :3, 3], direction


@dataclass(frozen=True)
class Hull:
    """What the silhouettes leave of a box: its bounds, and a grid of cells that are occupied."""

    low: np.ndarray  # (3,)
    high: np.ndarray  # (3,)
    cells: np.ndarray  # (G,G,G) bool

    @property
    def occupied(self) -> np.ndarray:
        """(P,3) the middles of the occupied cells."""
        return _cells(self.low, self.high, len(self.cells))[self.cells.ravel()]

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Of the occupied cells."""
        points, half = self.occupied, (self.high - self.low) / len(self.cells) / 2
        return points.min(0) - half, points.max(0) + half


def _cells(low: np.ndarray, high: np.ndarray, grid: int) -> np.ndarray:
    at = (np.arange(grid) + 0.5) / grid
    x, y, z = np.meshgrid(*(at,) * 3, indexing="ij")
    return low + np.stack([x, y, z], -1).reshape(-1, 3) * (high - low)


def carve(sil: Silhouettes, low: np.ndarray, high: np.ndarray, grid: int = GRID) -> Hull:
    """What is in the silhouettes of all views of a window that see it, but one in ten, and is seen by half of them, in
    any window. Views that show nothing of the object at all are left out: it may be outside of them."""
    points = _cells(low, high, grid)
    left = np.zeros(len(points), bool)
    for w in np.unique(sil.window):
        views = [v for v in np.flatnonzero(sil.window == w) if sil.masks[v].any()]
        seen, inside = np.zeros(len(points), int), np.zeros(len(points), int)
        for v in views:
            a, b = sil.project(v, points)
            seen += a
            inside += b
        left |= (inside >= seen - seen // 10) & (seen >= max(min(2, len(views)), len(views) / 2))
    return Hull(low, high, left.reshape(grid, grid, grid))


def hull_of(sil: Silhouettes) -> Hull | None:
    """The visual hull in a box that fits it; None where the silhouettes have no place in common."""
    place, direction = centroid_rays(sil)
    met = common_point(place, direction) if len(place) > 1 else None
    if met is None or np.median(met[1]) <= 0:
        return None
    centre, along = met
    half = np.median(along) * _largest_slope(sil)
    low, high = centre - 1.5 * half, centre + 1.5 * half
    for _ in range(4):
        hull = carve(sil, low, high, COARSE)
        if not hull.cells.any():
            return None
        found = hull.bounds()
        cell = (high - low) / COARSE
        # Wider where it reaches the box's side, but never as far as the cameras are; tighter where it does not.
        wider = [
            (found[0] - low < cell) * (found[1] - found[0]) / 2,
            (high - found[1] < cell) * (found[1] - found[0]) / 2,
        ]
        low = np.maximum(found[0] - cell - wider[0], centre - np.median(along))
        high = np.minimum(found[1] + cell + wider[1], centre + np.median(along))
    hull = carve(sil, low, high)
    return hull if hull.cells.any() else None


def _largest_slope(sil: Silhouettes) -> float:
    """The median over the views of the farthest that a mask reaches from its middle, at depth 1."""
    found = []
    for mask, (fx, fy, _, _) in zip(sil.masks, sil.intrinsics, strict=True):
        y, x = np.nonzero(mask)
        if len(x):
            found.append(max((x.max() - x.min() + 1) / fx, (y.max() - y.min() + 1) / fy) / 2)
    return float(np.median(found))


@dataclass(frozen=True)
class Box:
    """What holds the object."""

    low: np.ndarray  # (3,)
    high: np.ndarray  # (3,)
    points: np.ndarray  # (P,3) on its surface and inside
    agreement: np.ndarray  # (V,) see `agreement`


def box_of(sil: Silhouettes) -> Box | None:
    """None where the silhouettes have no place in common. Of what moves while a camera goes around it they cut too much
    away: the box is as large as what the masks show at its distance."""
    hull = hull_of(sil)
    if hull is None:
        return None
    fit = agreement(sil, hull)
    low, high = hull.bounds()
    points, centre = hull.occupied, (low + high) / 2
    grow = reach(sil, centre) / (np.linalg.norm(points - centre, axis=1).max() + np.linalg.norm(high - low) / GRID)
    if grow > 1:
        low, high, points = (centre + grow * (x - centre) for x in (low, high, points))
    return Box(low, high, points, fit)


def reach(sil: Silhouettes, centre: np.ndarray) -> float:
    """How far from a point the masks' rays pass at most: of each mask all but one in fifty, of three masks in a row the
    middle one, so that a spot or a mask that is wrong does not count."""
    found = []
    for v in range(len(sil.masks)):
        place, d = _rays(sil, v)
        if len(d):
            found.append(np.percentile(np.linalg.norm(np.cross(centre - place, d), axis=1), 98))
    return float(max(np.median(found[k : k + 3]) for k in range(max(len(found) - 2, 1))))


def _rays(sil: Silhouettes, view: int) -> tuple[np.ndarray, np.ndarray]:
    """The place (3,) of a view's camera, and unit directions (R,3) of rays through some of its mask's pixels."""
    y, x = np.nonzero(sil.masks[view])
    pick = np.unique(np.linspace(0, max(len(x) - 1, 0), RAYS).round().astype(int))[: len(x)]
    fx, fy, cx, cy = sil.intrinsics[view]
    d = np.stack([(x[pick] + 0.5 - cx) / fx, (y[pick] + 0.5 - cy) / fy, np.ones(len(pick))], -1)
    d = d @ sil.c2w[view, :3, :3].T
    return sil.c2w[view, :3, 3], d / np.linalg.norm(d, axis=1, keepdims=True)


def agreement(sil: Silhouettes, hull: Hull) -> np.ndarray:
    """(V,) the share of each mask's pixels whose rays meet the hull: 1 where all silhouettes fit together; nan for
    masks that are empty."""
    out, grid = np.full(len(sil.masks), np.nan), len(hull.cells)
    span = np.linalg.norm(hull.high - hull.low) / 2
    middle = (hull.low + hull.high) / 2
    steps = np.linspace(-span, span, 2 * grid)
    for v in range(len(sil.masks)):
        place, d = _rays(sil, v)
        if not len(d):
            continue
        along = ((middle - place) * d).sum(1)[:, None] + steps
        points = place + along[..., None] * d[:, None]
        at = np.floor((points - hull.low) / (hull.high - hull.low) * grid).astype(int)
        inside = ((at >= 0) & (at < grid)).all(-1) & (along > 0)
        at = np.clip(at, 0, grid - 1)
        out[v] = (hull.cells[at[..., 0], at[..., 1], at[..., 2]] & inside).any(1).mean()
    return out


def normalisation_around(low: np.ndarray, high: np.ndarray, points: np.ndarray | None = None) -> Normalisation:
    """What leads back from the unit box to a box in the world. The longest half-side is at most 1, and nothing of
    `points` (its corners where there are none) is farther than 1.1 from the origin."""
    centre = (low + high) / 2
    reach = np.linalg.norm((points if points is not None else high[None]) - centre, axis=1).max()
    scale = MARGIN * max(float((high - low).max()) / 2, float(reach) / 1.1)
    return Normalisation(scale, (float(centre[0]), float(centre[1]), float(centre[2])))


def normalisation_of_views(place: np.ndarray, axis: np.ndarray, slope: np.ndarray, path) -> Normalisation:
    """From cameras alone, at `place` (V,3), that look along `axis` (V,3): the origin is the point nearest to all of
    their axes, and of a plane there the median camera sees 1 to the sides, up and down (whichever is less; `slope` (V,)
    is the tangent of half its smaller field of view). Raises InputError naming `path` where the axes are parallel, or
    meet behind the cameras."""
    met = common_point(place, axis)
    if met is None:
        raise InputError(f"{path}: its cameras all look the same way, so nothing tells how far away the object is; "
                         "give views from several sides.")  # fmt: skip
    centre, along = met
    if np.median(along) <= 0:
        raise InputError(f"{path}: its cameras look away from one another; give views that surround an object.")
    scale = float(np.median(np.linalg.norm(centre - place, axis=1) * slope))
    return Normalisation(scale, (float(centre[0]), float(centre[1]), float(centre[2])))


def bounds_of_points(points: np.ndarray, views: Silhouettes, reach: float, centre: np.ndarray):
    """The box of the points (P,3) that half of the views see or more and that are within `reach` of `centre`, without
    the outermost hundredth on each side; None where fewer than 20 are left."""
    near = points[np.linalg.norm(points - centre, axis=1) < reach]
    if len(near) < 20:
        return None
    count = sum(views.project(v, near)[0].astype(int) for v in range(len(views.c2w)))
    kept = near[count >= len(views.c2w) / 2]
    if len(kept) < 20:
        return None
    return np.percentile(kept, 1, 0), np.percentile(kept, 99, 0)
