# SPDX-License-Identifier: GPL-3.0-or-later
"""A Sequence: images of an object with the camera and the moment of each, as a folder anyone can read.

`transforms.json`, `images/`, `passes/`. What others wrote comes by `readers`; `writers` make of it what other programs
read as it is. numpy only: neither bpy nor torch is needed here.

Conventions
    world       right-handed, Z up; positions are normalised: the object's box over the whole clip is centred at
                the origin, its longest half-side is at most 1, and no vertex is farther than 1.1. `Normalisation` leads
                back.
    cameras     on disk 4x4 camera-to-world, OpenGL axes (x right, y up, looks along -z);
                `opengl_to_opencv` is the one place where the axes are turned.
    time        on disk 0..1 over the clip (D-NeRF's); for the model `model_time`: -1..1, a single frame 0.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from .errors import InputError
from .passes import Passes, read_passes
from .track_file import SurfaceTracks, read_tracks
from .whole_folders import whole_folder

FORMAT = "timesplat-sequence-1"
FARTHEST = 3  # model time of a view: a clip's length before it, or after it
HELD_OUT = {"val": "val", "test": "target"}  # splits whose views are no inputs, by the rig that says so


@dataclass(frozen=True)
class Normalisation:
    """world = scale * normalised + translation (uniform scale > 0, translation in world units)."""

    scale: float = 1.0
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def to_world(self, c2w: np.ndarray) -> np.ndarray:
        """c2w (…,4,4) in normalised space -> the same camera in world space (rotation unchanged)."""
        out = np.array(c2w, dtype=np.float64)
        out[..., :3, 3] = out[..., :3, 3] * self.scale + np.asarray(self.translation)
        return out

    def from_world(self, c2w: np.ndarray) -> np.ndarray:
        """Inverse of `to_world`."""
        out = np.array(c2w, dtype=np.float64)
        out[..., :3, 3] = (out[..., :3, 3] - np.asarray(self.translation)) / self.scale
        return out


@dataclass
class View:
    """One image: a camera at a moment."""

    frame: float  # frame number in the scene; whole ones are int, as in all that we render
    camera: str  # camera id: views that share it were taken by one (possibly moving) camera
    rig: str  # name of the rig it belongs to
    c2w: np.ndarray  # (4,4) float64, OpenGL axes, normalised space, orthonormal rotation
    fx: float  # focal lengths and principal point in pixels, pixel centres at +0.5, y down
    fy: float
    cx: float
    cy: float
    image: str = ""  # path below the Sequence's folder: RGBA, straight alpha, sRGB, 8 bit
    passes: str | None = None  # EXR with depth and motion vectors, or None

    @property
    def held_out(self) -> bool:
        """Whether it is for scoring alone, so that nothing may be learnt from it."""
        return self.rig in HELD_OUT.values()


@dataclass
class Sequence:
    """All views of one clip. `frame_start..frame_end` (inclusive) is the clip; it maps to time 0..1."""

    width: int
    height: int
    fps: float
    frame_start: int
    frame_end: int
    normalisation: Normalisation = field(default_factory=Normalisation)
    aabb: list = field(default_factory=lambda: [[-1, -1, -1], [1, 1, 1]])  # over all frames, normalised
    provenance: dict = field(default_factory=dict)  # asset, sha256, licence, tool versions, seed, …
    views: list[View] = field(default_factory=list)
    tracks: str | None = None  # path below the folder: surface points followed through the clip, see `track_file`
    untracked: list[str] = field(default_factory=list)  # what is seen and has none, by the objects' names
    root: Path | None = None  # the folder it was read from
    remedy: str = "render the Sequence again"  # what to do where a file of it is missing or damaged
    picture: Callable[[View], np.ndarray] | None = None  # how a view's picture is read where its file is not yet RGBA
    hull: Callable[[int], np.ndarray | None] | None = (
        None  # where in a view without mask the object can be, (H,W) 0..255
    )

    def unit_time(self, frame: float) -> float:
        """0..1 over the clip; 0 where the clip is one frame."""
        return (frame - self.frame_start) / max(self.frame_end - self.frame_start, 1)

    def model_time(self, frame: float) -> float:
        """-1..1 over the clip; 0 where the clip is one frame."""
        return 2 * self.unit_time(frame) - 1 if self.frame_end > self.frame_start else 0.0

    @property
    def pixel_size(self) -> float:
        """The median over the views of a pixel's size at the origin, in normalised units."""
        return float(np.median([np.linalg.norm(v.c2w[:3, 3]) / v.fx for v in self.views]))

    def times(self, indices=None) -> np.ndarray:
        """(V,) float32 model times of the views (or of those at `indices`)."""
        views = self.views if indices is None else [self.views[i] for i in indices]
        return np.array([self.model_time(v.frame) for v in views], np.float32)

    def cameras(self, indices=None) -> tuple[np.ndarray, np.ndarray]:
        """c2w (V,4,4) float32 in OpenCV axes, and intrinsics (V,4) float32 fx fy cx cy in pixels."""
        views = self.views if indices is None else [self.views[i] for i in indices]
        c2w = opengl_to_opencv(np.stack([v.c2w for v in views]))
        return c2w.astype(np.float32), np.array([[v.fx, v.fy, v.cx, v.cy] for v in views], np.float32)

    @property
    def folder(self) -> Path:
        """Where it was read from. Raises ValueError for one that is not on disk."""
        if self.root is None:
            raise ValueError("this Sequence is not on disk yet")
        return self.root

    def select(self, *, camera: str | None = None, rig: str | None = None, frame: float | None = None) -> list[int]:
        """Indices of the views that match every argument given."""
        return [
            i
            for i, v in enumerate(self.views)
            if (camera is None or v.camera == camera)
            and (rig is None or v.rig == rig)
            and (frame is None or v.frame == frame)
        ]

    def inputs(self) -> list[int]:
        """All views that are not held out, in the order of `views`. Raises InputError where there are none."""
        found = [i for i, v in enumerate(self.views) if not v.held_out]
        if not found:
            raise InputError(f"{self.root}: all of its views are held out; render some more.")
        return found

    def load_image(self, index: int) -> np.ndarray:
        """(H,W,4) uint8 RGBA, straight alpha, sRGB-encoded. Raises InputError naming the file."""
        if self.picture is not None:
            return self.picture(self.views[index])
        from PIL import Image

        path = self.folder / self.views[index].image
        try:
            with Image.open(path) as im:
                rgba = np.asarray(im.convert("RGBA"))
        except FileNotFoundError:
            raise InputError(f"{path}: the image is missing; {self.remedy}.") from None
        except Exception as e:
            raise InputError(f"{path}: the image cannot be read ({e}); {self.remedy}.") from None
        if rgba.shape != (self.height, self.width, 4):
            raise InputError(
                f"{path}: the image is {rgba.shape[1]}x{rgba.shape[0]} but those of the Sequence are "
                f"{self.width}x{self.height}; {self.remedy}."
            )
        return rgba

    def load_passes(self, index: int) -> Passes:
        """Depth and motion of a view. Raises InputError where the view has none or the file is damaged."""
        view = self.views[index]
        if view.passes is None:
            raise InputError(
                f"{self.root}: view {view.image} has no depth pass; render with passes, or use a method "
                "that needs none (rgb)."
            )
        return read_passes(self.folder / view.passes, (self.height, self.width))

    def load_tracks(self) -> SurfaceTracks:
        """The surface points followed through the clip. Raises InputError where there are none or the file is
        damaged."""
        if self.tracks is None:
            raise InputError(f"{self.root}: it holds no surface tracks; render it again with --tracks auto.")
        path = self.folder / self.tracks
        try:
            return read_tracks(path, self.frame_end - self.frame_start + 1)
        except (OSError, ValueError) as e:
            raise InputError(f"{path}: the tracks cannot be read ({e}); render the Sequence again.") from None


def opengl_to_opencv(c2w: np.ndarray) -> np.ndarray:
    """c2w (…,4,4): OpenGL camera axes (y up, looks along -z) -> OpenCV (y down, looks along +z), or back."""
    return c2w * np.array([1.0, -1.0, -1.0, 1.0])


def focal_from_fov(fov_degrees: float, size: int) -> float:
    """Focal length in pixels of a square image of `size` pixels with the given full field of view."""
    return 0.5 * size / math.tan(math.radians(fov_degrees) / 2)


# ---------------------------------------------------------------- the folder


def write_sequence(seq: Sequence, folder: Path, fill: Callable[[Path], None]) -> Sequence:
    """Writes a Sequence so that it appears whole or not at all.

    `fill(tmp)` puts the images and passes below the temporary folder and sets each view's `image` (and
    `passes`) to its relative path; then transforms.json is written and the folder moved into place,
    replacing an older Sequence (and nothing else: InputError). Returns it as read back. On any error nothing
    stays behind.
    """
    folder = Path(folder)
    with whole_folder(folder, "transforms.json", "a Sequence") as tmp:
        fill(tmp)
        (tmp / "transforms.json").write_text(json.dumps(sequence_to_json(seq), indent=1))
    return read_sequence(folder)


def sequence_to_json(seq: Sequence) -> dict:
    """What `transforms.json` says of it."""
    frames = []
    for v in seq.views:
        f = {
            "file_path": v.image,
            "transform_matrix": np.asarray(v.c2w, float).tolist(),
            "fl_x": v.fx,
            "fl_y": v.fy,
            "cx": v.cx,
            "cy": v.cy,
            "time": seq.unit_time(v.frame),
            "seconds": (v.frame - seq.frame_start) / seq.fps,
            "frame": v.frame,
            "camera": v.camera,
            "rig": v.rig,
        }
        if v.passes:
            f["exr_path"] = v.passes
        frames.append(f)
    return {
        "format": FORMAT,
        "camera_model": "OPENCV",
        "w": seq.width,
        "h": seq.height,
        "fps": seq.fps,
        "frame_start": seq.frame_start,
        "frame_end": seq.frame_end,
        "normalisation": asdict(seq.normalisation),
        "aabb": np.asarray(seq.aabb, float).tolist(),
        "provenance": seq.provenance,
        **({"tracks_path": seq.tracks} if seq.tracks else {}),
        **({"untracked": seq.untracked} if seq.untracked else {}),
        "frames": frames,
    }


def distinct(names: list[str]) -> list[str]:
    """The names for files; -2, -3 and so on follow one that was there before, also where capitals count for nothing."""
    found: list[str] = []
    taken: set[str] = set()
    for name in names:
        new, n = name, 2
        while new.lower() in taken:
            new, n = f"{name}-{n}", n + 1
        taken.add(new.lower())
        found.append(new)
    return found


def read_sequence(folder: Path) -> Sequence:
    """Reads and checks `folder/transforms.json`; images are read later, but that they exist is checked now.

    Raises InputError naming the file and the fault: missing or damaged JSON, a missing image, a camera
    that is not a rigid finite transform, a focal length or size that is not positive.
    """
    folder = Path(folder)
    path = folder / "transforms.json"
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a folder that `timesplat render` wrote.")
    with read_from(path):
        seq = sequence_from_json(json.loads(path.read_text(encoding="utf-8")), folder)
    check_sequence(seq, path)
    return seq


def sequence_from_json(d: dict, root: Path) -> Sequence:
    """What `sequence_to_json` made, or others' that is like it; nothing is checked (see `check_sequence`). root: what
    paths in it are below. Raises KeyError, TypeError, ValueError for what is missing or not of its type."""
    norm = d.get("normalisation", {})
    x, y, z = norm.get("translation", (0, 0, 0))
    frames = [frame_number(f["frame"]) for f in d["frames"]]
    seq = Sequence(
        width=int(d["w"]),
        height=int(d["h"]),
        fps=float(d.get("fps", 24.0)),
        frame_start=int(d.get("frame_start", math.floor(min(frames, default=0)))),
        frame_end=int(d.get("frame_end", math.ceil(max(frames, default=0)))),
        normalisation=Normalisation(float(norm.get("scale", 1.0)), (float(x), float(y), float(z))),
        aabb=d.get("aabb", [[-1, -1, -1], [1, 1, 1]]),
        provenance=d.get("provenance", {}),
        tracks=d.get("tracks_path"),
        untracked=[str(name) for name in d.get("untracked", [])],
        root=root,
    )
    for frame, f in zip(frames, d["frames"], strict=True):
        fx, fy = focal_lengths(d | f, seq.width)
        seq.views.append(
            View(
                frame=frame,
                camera=str(f.get("camera", "0")),
                rig=str(f.get("rig", "")),
                c2w=np.array(f["transform_matrix"], dtype=np.float64),
                fx=fx,
                fy=fy,
                cx=float(f.get("cx", d.get("cx", seq.width / 2))),
                cy=float(f.get("cy", d.get("cy", seq.height / 2))),
                image=str(f["file_path"]),
                passes=f.get("exr_path"),
            )
        )
    return seq


@contextlib.contextmanager
def read_from(path: Path, remedy: str = Sequence.remedy) -> Iterator[None]:
    """What goes wrong inside while the JSON file `path` is taken apart is raised as an InputError."""
    try:
        yield
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError) as e:
        what = f"the entry {e} is missing" if isinstance(e, KeyError) else f"it is damaged ({e})"
        raise InputError(f"{path}: {what}; {remedy}.") from None


def frame_number(value: float) -> float:
    """A frame's number, int where it is whole. Raises ValueError for what is no finite number."""
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"the frame {value} is not finite")
    return int(number) if number.is_integer() else number


def focal_lengths(camera: dict, width: int) -> tuple[float, float]:
    """fx, fy in pixels of a `width` pixels wide picture: as `fl_x` and `fl_y` say, or else the angle `camera_angle_x`
    in radians, with square pixels. Raises KeyError where there is neither."""
    if "fl_x" in camera:
        return float(camera["fl_x"]), float(camera.get("fl_y", camera["fl_x"]))
    if "camera_angle_x" not in camera:
        raise KeyError("camera_angle_x")
    fx = focal_from_fov(math.degrees(float(camera["camera_angle_x"])), width)
    return fx, float(camera.get("fl_y", fx))


def check_sequence(seq: Sequence, path: Path) -> None:
    """Raises InputError naming the file `path`, which describes the Sequence in its folder, and the fault: see
    `read_sequence`."""
    if seq.width < 1 or seq.height < 1 or seq.fps <= 0 or seq.frame_end < seq.frame_start or not seq.views:
        raise InputError(f"{path}: size, fps, frame range or views are empty or negative; {seq.remedy}.")
    s = seq.normalisation
    if not (s.scale > 0 and np.isfinite([s.scale, *s.translation]).all()):
        raise InputError(f"{path}: the normalisation is not a finite positive scale; {seq.remedy}.")
    folder = seq.root or path.parent
    root = folder.resolve()
    if seq.tracks:
        _check_file(seq, path, folder, root, seq.tracks)
    for v in seq.views:
        name = v.image or "?"
        R = v.c2w[:3, :3] if v.c2w.shape == (4, 4) else None
        if R is None or not np.isfinite(v.c2w).all():
            raise InputError(f"{path}: the camera of {name} is not a finite 4x4 matrix; correct it.")
        if np.abs(R.T @ R - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
            raise InputError(f"{path}: the camera of {name} is singular or not a rotation; correct it.")
        if not (v.fx > 0 and v.fy > 0 and np.isfinite([v.fx, v.fy, v.cx, v.cy]).all()):
            raise InputError(f"{path}: the focal length of {name} is not positive; correct it.")
        if abs(seq.model_time(v.frame)) > FARTHEST:
            clip = f"{seq.frame_start} to {seq.frame_end}"
            raise InputError(f"{path}: {name} is of frame {v.frame}, far outside of the clip, {clip}; correct it.")
        # Of others' pictures, frames of videos among them, their reader has made sure.
        for rel in filter(None, (v.image, v.passes) if seq.picture is None else ()):
            _check_file(seq, path, folder, root, rel)


def _check_file(seq: Sequence, path: Path, folder: Path, root: Path, relative: str) -> None:
    """Raises InputError unless the file is there, and below the Sequence's folder, `root` when resolved."""
    full = (folder / relative).resolve()
    if not full.is_relative_to(root):
        raise InputError(f"{path}: {relative} points outside of the Sequence's folder; correct it.")
    if not full.is_file():
        raise InputError(f"{full}: the file is missing; {seq.remedy}.")
