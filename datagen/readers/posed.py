# SPDX-License-Identifier: GPL-3.0-or-later
"""What every layout of others' data says, in one form, and how it becomes a Sequence.

A reader fills a `PosedScene` with what its files hold. `assemble` does the rest, the same for all of them: moments,
cameras in one convention, sizes, backgrounds, and the volume, found and not assumed. What it did is said in
`provenance["read"]`, a list of sentences.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..sequence import InputError, Sequence, View, check_sequence
from .hulls import MaskHulls
from .lenses import Lens
from .options import AXES, ReadOptions
from .pictures import Pictures, Source, background_of, scaled_to, size_of
from .placing import place
from .times import clip_of, of_names
from .videos import video_of

REMEDY = "correct it, or get the data set again"


@dataclass
class Posed:
    """A picture with its camera, as a layout says it."""

    image: str  # path below the scene's folder, which is there
    matrix: np.ndarray  # (4,4) in the layout's convention
    lens: Lens
    time: float | None = None
    frame: float | None = None
    camera: str | None = None
    rig: str = "train"
    mask: str | None = None
    video_frame: int | None = None  # which one, where the image is a video; `image` is then PATH#FRAME

    @property
    def file(self) -> str:
        """The path below the scene's folder of what holds it."""
        return self.image if self.video_frame is None else self.image.rpartition("#")[0]


@dataclass
class PosedScene:
    """All that the files of a folder say."""

    folder: Path
    path: Path  # the file that complaints are about
    layout: str
    pictures: list[Posed]
    axes: str = "opengl"
    fps: float | None = None
    frame_range: tuple[int | None, int | None] = (None, None)
    points: np.ndarray | None = None  # (P,3) that are known of the scene, in the cameras' world
    counted: bool = False  # whether frames are numbers that the reader gave; if all are the same, it is one moment
    upright: bool | None = None  # whether EXIF's rotation is carried out; None: as the stated sizes say
    notes: list[str] = field(default_factory=list)
    provenance: dict = field(default_factory=dict)


def assemble(scene: PosedScene, options: ReadOptions) -> Sequence:
    """The scene as a Sequence, whose pictures are read when they are asked for. Raises InputError naming the file and
    the fault, see the tests of what is refused."""
    return placed(arrange(scene, options), scene, options)


def placed(seq: Sequence, scene: PosedScene, options: ReadOptions, masks: np.ndarray | None = None) -> Sequence:
    """The same of a scene that is arranged. masks: `placing.small_masks`, where they are known. Raises InputError."""
    place(seq, scene.points, options, scene.path, masks)
    if any(p.mask for p in scene.pictures) and not all(p.mask for p in scene.pictures):
        assert isinstance(seq.picture, Pictures)
        seq.hull = MaskHulls(seq, seq.picture)
    return seq


def at_rate(scene: PosedScene, fps: float | None) -> PosedScene:
    """The scene at so many moments a second. Of videos frames are left out, the same of all; pictures have no rate of
    their own that could be changed: theirs is what is said. Raises InputError for more than a video has."""
    if fps is None or fps == scene.fps:
        return scene
    if scene.fps is None or all(p.video_frame is None for p in scene.pictures):
        return replace(scene, fps=fps)
    if fps > scene.fps:
        raise InputError(f"--fps {fps:g}: the videos have {scene.fps:g} frames a second; give no more.")
    last = max(p.video_frame or 0 for p in scene.pictures)
    count = int((last + 0.5) * fps / scene.fps) + 1
    moment = {round(m * scene.fps / fps): m for m in range(count)}
    kept = [replace(p, frame=float(moment[p.video_frame])) for p in scene.pictures if p.video_frame in moment]
    return replace(scene, fps=fps, pictures=kept, notes=[*scene.notes, f"{fps:g} of {scene.fps:g} frames a second"])


def arrange(scene: PosedScene, options: ReadOptions) -> Sequence:
    """The same in the cameras' own world, before it is known where the object is. Raises InputError."""
    scene = at_rate(scene, options.fps)
    if not scene.pictures:
        raise InputError(f"{scene.path}: it has no pictures; {REMEDY}.")
    sources, has_alpha, masked = _sources(scene)
    if options.scene:
        sources = {name: replace(s, mask=None) for name, s in sources.items()}
        pictures = Pictures(sources, None, False, REMEDY, whole=True)
        behind = "the whole scene is reconstructed, what lies far outside of the volume too, as --scene says"
    else:
        background, behind = background_of(list(sources.values()), masked, has_alpha, options.background, REMEDY)
        pictures = Pictures(sources, background, has_alpha or masked, REMEDY)
    told = [f"{scene.layout}: {len(scene.pictures)} pictures", *scene.notes, *_lens_notes(sources, pictures), behind]

    names, cameras = [p.image for p in scene.pictures], [p.camera for p in scene.pictures]
    times, frames = [p.time for p in scene.pictures], [p.frame for p in scene.pictures]
    if scene.counted and len(set(frames)) == 1:
        frames = [None] * len(frames)
    by_name = options.times is not None or (not scene.counted and all(x is None for x in (*times, *frames)))
    if by_name:
        times = [None] * len(names)
        frames, named = of_names(names, options.times)
        cameras = [a or b for a, b in zip(cameras, named, strict=True)]
    clip = clip_of(names, times, frames, scene.fps, scene.frame_range, scene.path)
    told.append(f"moments: {clip.told}" + (" in the file names" if by_name and clip.end > clip.start else ""))

    seq = Sequence(pictures.width, pictures.height, clip.fps, clip.start, clip.end, root=scene.folder, remedy=REMEDY)
    seq.picture = pictures
    read = AXES[options.axes or scene.axes]
    ids = _cameras(scene, cameras)
    for p, frame, camera in zip(scene.pictures, clip.frames, ids, strict=True):
        fx, fy, cx, cy = pictures.intrinsics(p.image)
        c2w = _checked(p, scene, read)
        seq.views.append(View(frame, camera, p.rig, c2w, fx, fy, cx, cy, p.image))
    check_sequence(seq, scene.path)
    seq.provenance = {"asset": scene.folder.absolute().name, "format": scene.layout, **scene.provenance, "read": told}
    return seq


def _sources(scene: PosedScene) -> tuple[dict[str, Source], bool, bool]:
    """Every picture's file, mask and lens at the size it has; whether any has alpha, and whether any a mask."""
    sources: dict[str, Source] = {}
    has_alpha = False
    root = scene.folder.resolve()
    for p in scene.pictures:
        for name in filter(None, (p.file, p.mask)):
            if not (root / name).resolve().is_relative_to(root):
                raise InputError(f"{scene.path}: {name} points outside of the folder; correct it.")
        image = scene.folder / p.file
        stated = (p.lens.width, p.lens.height)
        if p.video_frame is None:
            size, turned, alpha = size_of(image, True, REMEDY)
        else:
            video = video_of(image)
            size, turned, alpha = (video.width, video.height), False, False
        upright = scene.upright if scene.upright is not None else not (turned and size == stated[::-1] != stated)
        if turned and not upright:
            size = size[::-1]
        lens = scaled_to(p.lens, size)
        if lens is None:
            raise InputError(
                f"{image}: the image is {size[0]}x{size[1]}, stated are {stated[0]}x{stated[1]}; {REMEDY}."
            )
        if lens is not p.lens:
            note = f"pictures are {size[0]}x{size[1]}, not {stated[0]}x{stated[1]} as stated: lenses are scaled to them"
            scene.notes += [] if note in scene.notes else [note]
        mask = scene.folder / p.mask if p.mask else None
        if mask:
            found, _, _ = size_of(mask, upright, REMEDY)
            if found != size:
                raise InputError(
                    f"{mask}: the mask is {found[0]}x{found[1]}, its picture {size[0]}x{size[1]}; give masks of the "
                    "pictures' size."
                )
        has_alpha |= alpha
        sources[p.image] = Source(image, mask, lens, upright, p.video_frame)
    return sources, has_alpha, any(s.mask for s in sources.values())


def _lens_notes(sources: dict[str, Source], pictures: Pictures) -> list[str]:
    out = []
    bent = [s.lens for s in sources.values() if not s.lens.straight]
    if bent:
        kind = "fisheye" if bent[0].fisheye else "lens"
        out.append(f"{kind} distortion of {len(bent)} pictures is undone")
    other = sum((s.lens.width, s.lens.height) != (pictures.width, pictures.height) for s in sources.values())
    if other:
        out.append(f"{other} pictures of other sizes are brought to {pictures.width}x{pictures.height}")
    return out


def _cameras(scene: PosedScene, told: list[str | None]) -> list[str]:
    """A name for each picture's camera; where nothing names them, pictures of the same pose and lens share one."""
    if all(told):
        return [str(t) for t in told]
    seen: dict[tuple, str] = {}
    out = []
    for p in scene.pictures:
        key = (p.lens, *np.round(p.matrix, 9).ravel())
        out.append(seen.setdefault(key, f"{len(seen):03d}"))
    return out


def _checked(p: Posed, scene: PosedScene, read) -> np.ndarray:
    """The camera-to-world matrix (4,4), OpenGL axes, of a picture. Raises InputError where it is none."""
    m = p.matrix
    if not np.isfinite(m).all():
        raise InputError(f"{scene.path}: the camera of {p.image} is not a finite matrix; correct it.")
    if abs(np.linalg.det(m[:3, :3])) < 1e-9:
        raise InputError(f"{scene.path}: the camera of {p.image} is singular or not a rotation; correct it.")
    c2w = read(m)
    if np.linalg.det(c2w[:3, :3]) < 0:
        raise InputError(f"{scene.path}: the camera of {p.image} is left-handed; pass --axes left-handed.")
    return np.asarray(c2w, np.float64)
