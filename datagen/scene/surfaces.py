# SPDX-License-Identifier: GPL-3.0-or-later
"""Follows the surfaces of the open scene through a clip, as renders show them: each instance of a mesh, of hair curves
or of a point cloud whose topology stays the same.

Topology is the faces' corners. How Blender cuts them into triangles is not, for that follows the shape: quads and
n-gons that bend may be cut otherwise at every frame. The cut of an instance's first frame holds for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..sequence import Normalisation
from .gltf import LARGEST_COORDINATE
from .measure import as_rendered, shown_instances

MOST_FLOATS = 400_000_000  # coordinates kept of all vertices at all frames, 4 bytes each: 1.6 GB
# A point of a point cloud is taken for an octahedron: it has no rotation that could be followed.
_OCTAHEDRON = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], np.float32)
_OCTAHEDRON_FACES = np.array(
    [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]], np.int32
)


@dataclass(frozen=True)
class Surface:
    """One instance of a shape for as long as it is there without a break."""

    corners: np.ndarray  # (T,3) int32 vertices of each triangle; a strand's segment has its second vertex twice
    vertices: np.ndarray  # (P,V,3) float32, normalised, at P moments
    moments: np.ndarray  # (n,) int, which of them is shown at each frame of the clip from `first` on
    first: int  # frame of the clip, from 0 on
    radius: np.ndarray | None = None  # (V,) float32, normalised, of strands

    @property
    def last(self) -> int:
        return self.first + len(self.moments) - 1

    def at(self, frame: int) -> np.ndarray:
        """(V,3) float32 vertices at a frame of the clip; those of the nearest one where it is not there."""
        return self.vertices[self.moments[min(max(frame, self.first), self.last) - self.first]]


def follow_surfaces(
    frames: Sequence[float], normalisation: Normalisation, objects: list | None = None
) -> tuple[list[Surface], list[str]]:
    """The surfaces that the open scene (or these `objects` of it) shows to cameras in the clip of these scene frames,
    and the names, sorted, of the objects that are seen and cannot be followed: those whose topology changes, volumes,
    hair of particle systems, what holds coordinates that are not finite, and the largest where all vertices at all
    frames are more than MOST_FLOATS."""
    moments = list(dict.fromkeys(frames))
    follower = _Follower(normalisation, len(moments))
    for _ in as_rendered(moments, follower.read, objects):
        follower.moment += 1
    shown = [moments.index(frame) for frame in frames]
    surfaces = [s for followed in follower.found.values() for s in _without_breaks(followed, shown)]
    return surfaces, sorted(set(follower.lost.values()))


@dataclass
class _Shape:
    """What an evaluated object shows, in its own space."""

    points: np.ndarray  # (V,3) float32
    topology: tuple[np.ndarray, ...]  # equal arrays: the same vertices mean the same points of the surface
    corners: np.ndarray | None = None  # (T,3), see `Surface`; None: ask `_triangles` of the mesh
    radius: np.ndarray | None = None  # (V,) float32, of strands


@dataclass
class _Followed:
    """An instance and where its vertices were at each moment."""

    name: str
    topology: tuple[np.ndarray, ...]
    corners: np.ndarray
    radius: np.ndarray | None
    size: int  # coordinates at a moment
    vertices: dict[int, np.ndarray] = field(default_factory=dict)  # moment -> (V,3) float32, normalised


class _Follower:
    """Takes in the evaluated scene moment by moment."""

    def __init__(self, normalisation: Normalisation, moments: int) -> None:
        self.normalisation, self.moments, self.moment = normalisation, moments, 0
        self.found: dict[tuple, _Followed] = {}
        self.floats = 0  # coordinates of those found, at all moments
        self.lost: dict[tuple, str] = {}  # instance -> name of its object

    def read(self, depsgraph) -> None:
        seen: dict[tuple, int] = {}
        for instance in shown_instances(depsgraph):
            key = _key(instance)
            seen[key] = seen.get(key, 0) + 1
            key = (*key, seen[key])
            if key in self.lost:
                continue
            try:
                followed = self._read(key, instance)
            except Exception:  # whatever Blender cannot tell of an object: it is rendered all the same
                followed = False
            if not followed:
                self._lose(key, instance.object.name)
            if _has_particle_hair(instance):
                self.lost[(*key, "hair")] = instance.object.name

    def _read(self, key: tuple, instance) -> bool:
        """Whether the instance can be followed up to here, or shows no surface at all."""
        ob = instance.object
        if ob.type == "VOLUME":
            return False
        shape, known = _shape(ob), self.found.get(key)
        if shape is None:
            return True
        if known is None:
            corners = _triangles(ob.data) if shape.corners is None else shape.corners
            if not len(corners):
                return True
            known = _Followed(ob.name, shape.topology, corners, None, shape.points.size)
        elif not _same(known.topology, shape.topology):
            return False
        matrix, norm = np.array(instance.matrix_world), self.normalisation
        world = shape.points.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        if not np.abs(world).max() <= LARGEST_COORDINATE:
            return False
        if shape.radius is not None and known.radius is None:
            size = np.cbrt(abs(np.linalg.det(matrix[:3, :3])))
            known.radius = (shape.radius * size / norm.scale).astype(np.float32)
        known.vertices[self.moment] = ((world - norm.translation) / norm.scale).astype(np.float32)
        if key not in self.found:
            self.found[key] = known
            self.floats += known.size * self.moments
            self._keep_to_memory()
        return True

    def _keep_to_memory(self) -> None:
        """Gives up the largest until what was found would fit in at all moments."""
        while self.floats > MOST_FLOATS:
            largest = max(self.found, key=lambda key: self.found[key].size)
            self._lose(largest, self.found[largest].name)

    def _lose(self, key: tuple, name: str) -> None:
        self.lost[key] = name
        if key in self.found:
            self.floats -= self.found.pop(key).size * self.moments


def _key(instance) -> tuple:
    """What stays the same of an instance from frame to frame, and differs from others'."""
    ob = instance.object
    if not instance.is_instance:
        return (ob.name_full, ob.type)
    return (ob.name_full, ob.type, instance.parent.name_full if instance.parent else "", *instance.persistent_id)


def _same(a: tuple[np.ndarray, ...], b: tuple[np.ndarray, ...]) -> bool:
    return len(a) == len(b) and all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def _has_particle_hair(instance) -> bool:
    return instance.show_particles and any(
        m.type == "PARTICLE_SYSTEM"
        and m.show_render
        and m.particle_system.settings.type == "HAIR"
        and m.particle_system.settings.render_type == "PATH"
        for m in instance.object.modifiers
    )


def _without_breaks(followed: _Followed, shown: list[int]) -> list[Surface]:
    """A Surface for each run of frames at which the instance is there; shown: the moment of each frame."""
    row = {moment: i for i, moment in enumerate(followed.vertices)}
    vertices, runs, last = np.stack(list(followed.vertices.values())), [], -2
    for frame, moment in enumerate(shown):
        if moment in row:
            if frame != last + 1:
                runs.append((frame, []))
            runs[-1][1].append(row[moment])
            last = frame
    return [Surface(followed.corners, vertices, np.array(rows), first, followed.radius) for first, rows in runs]


# ---------------------------------------------------------------- one evaluated object


def _shape(ob) -> _Shape | None:
    """None for a kind that shows no surface, or an empty one."""
    read = {"MESH": _mesh, "CURVES": _strands, "POINTCLOUD": _balls}.get(ob.type)
    return read(ob.data) if read else None


def _mesh(mesh) -> _Shape | None:
    """By attributes, which are read a hundred times as fast as loops and vertices."""
    if not len(mesh.polygons):
        return None
    topology = _values(mesh.attributes[".corner_vert"].data, "value"), np.array([len(mesh.polygons)])
    return _Shape(_attribute(mesh, "position", "vector").reshape(-1, 3), topology)


def _triangles(mesh) -> np.ndarray:
    """(T,3) int32."""
    mesh.calc_loop_triangles()
    return _values(mesh.loop_triangles, "vertices").reshape(-1, 3)


def _strands(curves) -> _Shape | None:
    if not len(curves.points):
        return None
    starts, counts = _values(curves.curves, "first_point_index"), _values(curves.curves, "points_length")
    points = _attribute(curves, "position", "vector").reshape(-1, 3)
    begin = np.ones(len(points), bool)
    begin[np.cumsum(counts) - 1] = False  # a strand's last point begins no segment
    a = np.flatnonzero(begin).astype(np.int32)
    return _Shape(points, (starts, counts), np.stack([a, a + 1, a + 1], 1), _radius(curves, 0.005))


def _balls(cloud) -> _Shape | None:
    if not len(cloud.points):
        return None
    points = _attribute(cloud, "position", "vector").reshape(-1, 1, 3)
    radius = _radius(cloud, 0.01).reshape(-1, 1, 1)
    corners = _OCTAHEDRON_FACES + 6 * np.arange(len(points), dtype=np.int32)[:, None, None]
    count = np.array([len(points)])
    return _Shape((points + radius * _OCTAHEDRON).reshape(-1, 3), (count,), corners.reshape(-1, 3))


def _radius(data, default: float) -> np.ndarray:
    """(N,) float32 of a data-block's points; the default is Blender's."""
    if "radius" in data.attributes:
        return _attribute(data, "radius", "value")
    return np.full(len(data.points), default, np.float32)


def _attribute(data, name: str, value: str) -> np.ndarray:
    return _values(data.attributes[name].data, value, np.float32)


_NUMBERS = {"vector": 3, "vertices": 3}  # of each item; else 1


def _values(items, name: str, kind: type = np.int32) -> np.ndarray:
    """(n,) of all the numbers of a property of each item of a Blender collection."""
    flat = np.empty(len(items) * _NUMBERS.get(name, 1), kind)
    items.foreach_get(name, flat)
    return flat
