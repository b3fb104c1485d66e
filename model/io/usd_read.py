# SPDX-License-Identifier: GPL-3.0-or-later
"""USD -> a 4D Gaussian asset: files of Timesplat's, stages that reference them, other programs' splats."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...datagen.sequence import InputError
from .asset import LONGEST, SH_C0, STATIC_SIGMA_T, Asset, Clip, check
from .slices import apart, placed
from .splat_files import MOST, SHARE

SPLAT = "ParticleField3DGaussianSplat"
SH = "radiance:sphericalHarmonicsCoefficients"
VARIANTS = "representation"  # the variant set of files that hold the original object too
RECONSTRUCTION, ORIGINAL = "reconstruction", "original"


def pxr():
    """-> Gf, Sdf, Usd, UsdGeom, UsdUtils, Vt. Raises InputError where there is no USD library."""
    try:
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdUtils, Vt
    except ImportError:
        raise InputError(f"{sys.executable} lacks usd-core, which USD files need; install timesplat[usd].") from None
    return Gf, Sdf, Usd, UsdGeom, UsdUtils, Vt


@contextmanager
def quiet() -> Iterator[None]:
    """Keeps USD's warnings, some lines each, off standard error; errors are raised all the same."""
    delegate = pxr()[4].CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        delegate.TakeUncoalescedDiagnostics()
        del delegate


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """`quiet`, and an InputError for what USD and numpy raise over damaged files."""
    with quiet():
        try:
            yield
        except InputError:
            raise
        except (RuntimeError, ValueError, TypeError, IndexError, OverflowError, MemoryError):
            raise InputError(f"{path}: it is damaged or not a USD file; export it again.") from None


def open_stage(path: Path):
    """The Usd.Stage of a file, inside of `reading`. Raises InputError: no such file."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the name.")
    return pxr()[2].Stage.Open(str(path))


def select(stage, variant: str) -> bool:
    """Selects `variant` of every set VARIANTS that has it, for this opened stage alone; False if none has."""
    Usd = pxr()[2]
    sets = [p.GetVariantSets().GetVariantSet(VARIANTS) for p in stage.TraverseAll() if p.HasVariantSets()]
    sets = [s for s in sets if variant in s.GetVariantNames()]
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        for s in sets:
            s.SetVariantSelection(variant)
    return bool(sets)


def metres_per_unit(stage, path: Path) -> float:
    """Raises InputError where it is no positive number."""
    metres = pxr()[3].GetStageMetersPerUnit(stage)
    if not (np.isfinite(metres) and metres > 0):
        raise InputError(f"{path}: its metersPerUnit is {metres:g}; set it to a positive number.")
    return metres


def prims(stage):
    """Every prim of the stage, those inside of instances too."""
    return stage.Traverse(pxr()[2].TraverseInstanceProxies())


def read_usd(path: str | Path) -> Asset:
    """`read_moving` without the motion: where it moves as a whole the asset stands where that starts."""
    return read_moving(path)[0]


def read_moving(path: str | Path) -> tuple[Asset, np.ndarray | None]:
    """The asset in a file that `write_usd` wrote (any mode), or in a stage that references one: its transforms,
    upAxis, metersPerUnit and retiming are applied, and the asset's clip leads to metres, Z up. Failing that,
    the splats of another program, without what depends on the direction; where they change over time, as
    Gaussians that live for one frame each. And where its prim or what is above it moves over time, that motion:
    (F,4,4) for each frame of the clip, in the world, from where the clip places the asset (see `apart`).

    Raises InputError: no such file, not USD, no splats or several of them, a transform that is flat, arrays that
    do not belong together."""
    path = Path(path)
    with reading(path):
        return _read(path)


def _read(path: Path) -> tuple[Asset, np.ndarray | None]:
    stage = open_stage(path)
    select(stage, RECONSTRUCTION)
    found = [p for p in prims(stage) if p.HasAttribute("primvars:gs4d:mu_t")]
    ours = bool(found)
    found = found or [p for p in prims(stage) if p.GetTypeName() == SPLAT]
    if not found:
        for error in stage.GetCompositionErrors():
            if lost := re.search(r"Could not open asset @(.+?)@", str(error)):
                raise InputError(f"{path}: it refers to {lost[1]}, which cannot be opened; find that file.")
        raise InputError(f"{path}: no prim is a {SPLAT} or has primvars:gs4d:*; choose a USD file with splats.")
    if len(found) > 1:
        names = ", ".join(str(p.GetPath()) for p in found[:3]) + (", …" if len(found) > 3 else "")
        raise InputError(f"{path}: it holds {len(found)} assets ({names}); open one of their own files.")
    asset = _read_4d(path, stage, found[0]) if ours else _read_others(path, stage, found[0])
    check(asset, path)
    return _placed(asset, path, stage, found[0])


def _get(path: Path, prim, *names: str, code=None) -> np.ndarray:
    """The first of the attributes that has a value, as float32, at a time code or else at the first one."""
    for name in names:
        attribute = prim.GetAttribute(name)
        value = attribute.Get(pxr()[2].TimeCode.EarliestTime() if code is None else code) if attribute else None
        if value is not None:
            return np.asarray(value).astype(np.float32)
    raise InputError(f"{path}: {names[0]} is missing at {prim.GetPath()}; export it again.")


def _clip(path: Path, stage, start: float, end: float, pixel: float = 0.0) -> Clip:
    """The whole frames around two time codes; the nearest one where they are the same."""
    if not end - start < LONGEST:
        raise InputError(f"{path}: its frames run from {start:g} to {end:g}, that is too many; export it again.")
    first, last = int(np.floor(start + 1e-6)), int(np.ceil(end - 1e-6))
    if start == end:
        first = last = round(start)
    return Clip(stage.GetTimeCodesPerSecond(), first, last, pixel=pixel)


def _read_4d(path: Path, stage, prim) -> Asset:
    def get(*names: str) -> np.ndarray:
        return _get(path, prim, *names)

    rgb = prim.HasAttribute("primvars:gs4d:rgb")
    rgb = get("primvars:gs4d:rgb") if rgb else 0.5 + SH_C0 * get(SH, f"{SH}h").astype(np.float64)
    rotation = get("orientations", "orientationsh", "primvars:gs4d:rotation")[:, [3, 0, 1, 2]]
    rotation = _unit(rotation)
    start, end = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    if prim.HasAttribute("gs4d:time"):
        start, *_, end = prim.GetAttribute("gs4d:time").GetTimeSamples() * 2  # one sample, where the clip is one frame
    t, velocity, sigma_t = (get(f"primvars:gs4d:{name}") for name in ("mu_t", "velocity", "sigma_t"))
    clip = _clip(path, stage, start, end, pixel=prim.GetCustomDataByKey("timesplat:pixel") or 0.0)
    first, last = clip.frame_start, clip.frame_end
    if last > first and (first, last) != (start, end):  # retimed to fractional frames
        stretch = np.float32((end - start) / (last - first))
        t = (t + 1) * stretch + np.float32(2 * (start - first) / (last - first) - 1)
        velocity, sigma_t = velocity / stretch, sigma_t * stretch
    return Asset(
        xyz=get("primvars:gs4d:position"),
        t=t,
        velocity=velocity,
        sigma_t=sigma_t,
        scale=get("primvars:gs4d:scale"),
        rotation=rotation,
        rgb=rgb.astype(np.float32),
        opacity=get("primvars:gs4d:opacity"),
        clip=clip,
    )


def _unit(quaternion: np.ndarray) -> np.ndarray:
    with np.errstate(all="ignore"):  # `check` names what is damaged
        return quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)


def _read_others(path: Path, stage, prim) -> Asset:
    names = ("positions", "scales", "orientations", "opacities", SH)
    attributes = [prim.GetAttribute(k) for n in names for k in (n, f"{n}h")]
    codes = sorted({c for a in attributes if a for c in a.GetTimeSamples()})
    clip = _clip(path, stage, codes[0], codes[-1]) if len(codes) > 1 else Clip(stage.GetTimeCodesPerSecond(), 0, 0)
    first, last = clip.frame_start, clip.frame_end
    parts, total = [], 0
    for frame in clip.frames:
        code = frame if len(codes) > 1 else codes[0] if codes else None
        xyz, scale, quaternion, opacity, sh = (_get(path, prim, n, f"{n}h", code=code) for n in names)
        n = len(xyz)
        total += n
        if total > MOST:
            raise InputError(f"{path}: it has more than {MOST:,} Gaussians over its frames; export fewer frames.")
        if n == 0 or len(sh) == 0 or len(sh) % n or quaternion.ndim != 2:
            raise InputError(f"{path}: {len(sh)} SH coefficients cannot belong to {n} splats; export it again.")
        rotation = _unit(quaternion)[:, [3, 0, 1, 2]]
        parts.append({
            "xyz": xyz,
            "t": np.full(n, clip.frame_to_time(frame), np.float32),
            "velocity": np.zeros_like(xyz),
            "sigma_t": np.full(n, SHARE * 2 / (last - first) if last > first else STATIC_SIGMA_T, np.float32),
            "scale": np.maximum(scale, np.float32(1e-9)),
            "rotation": rotation,
            "rgb": (0.5 + SH_C0 * sh[:: len(sh) // n].astype(np.float64)).astype(np.float32),
            "opacity": opacity,
        })  # fmt: skip
    return Asset(**{k: np.concatenate([p[k] for p in parts]) for k in parts[0]}, clip=clip)


def _placed(asset: Asset, path: Path, stage, prim) -> tuple[Asset, np.ndarray | None]:
    """The asset where the stage has it, in metres, Z up; and its motion from there."""
    _, _, Usd, UsdGeom, _, _ = pxr()
    if not prim.IsA(UsdGeom.Xformable):
        version = ".".join(map(str, Usd.GetVersion()[1:]))
        raise InputError(f"{path}: USD {version} does not know the type of {prim.GetPath()}; add fallbackPrimTypes to "
                         "this file, or reference an asset exported as points.")  # fmt: skip
    codes, above = [], prim
    while not above.IsPseudoRoot():
        if (x := UsdGeom.Xformable(above)) and x.TransformMightBeTimeVarying():
            codes += x.GetTimeSamples()
        above = above.GetParent()
    if codes and asset.clip.frame_start == asset.clip.frame_end:  # the motion alone has a length
        asset = replace(asset, clip=_clip(path, stage, min(codes), max(codes), asset.clip.pixel))
    outer = np.diag([*[metres_per_unit(stage, path)] * 3, 1.0])
    if UsdGeom.GetStageUpAxis(stage) == "Y":
        outer = outer @ [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
    cache, matrices = UsdGeom.XformCache(), []
    for frame in asset.clip.frames if codes else [asset.clip.frame_start]:
        cache.SetTime(frame)
        matrices.append(outer @ np.array(cache.GetLocalToWorldTransform(prim)).T)
    try:
        matrix, motion = apart(np.stack(matrices))
        scale = float(matrix[0, 0])
        if scale > 0 and np.abs(matrix[:3, :3] - scale * np.eye(3)).max() < 1e-6 * scale:
            clip = replace(asset.clip, scale=scale, translation=tuple(map(float, matrix[:3, 3])))
            return replace(asset, clip=clip), motion
        return placed(asset, matrix), motion
    except InputError:
        raise InputError(f"{path}: {prim.GetPath()} is scaled to nothing; give it a scale.") from None
