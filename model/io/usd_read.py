# SPDX-License-Identifier: GPL-3.0-or-later
"""USD -> a 4D Gaussian asset: files of Timesplat's, stages that reference them, other programs' splats."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...datagen.sequence import InputError
from .asset import (
    MAX_CLIP_FRAMES,
    MAX_GAUSSIANS,
    ONE_FRAME_SIGMA,
    SH_C0,
    SMALLEST_SCALE,
    STATIC_SIGMA_T,
    Asset,
    Clip,
    LoadedAsset,
    check,
    sound_part,
    srgb_from_linear,
    wxyz_from_xyzw,
)
from .paths import Paths, continuous
from .placement import place_asset, rest_and_motion
from .usd_stage import (
    DISPLAY_COLOUR,
    RECONSTRUCTION,
    SH_COEFFICIENTS,
    SPLAT_TYPE,
    all_prims,
    import_pxr,
    metres_per_unit,
    open_stage,
    reading,
    select,
)


def read_usd(path: str | Path) -> Asset:
    """`load_usd` without the motion: where it moves as a whole the asset stands where that starts."""
    return load_usd(path).asset


def load_usd(path: str | Path) -> LoadedAsset:
    """The asset in a file that `write_usd` wrote (any mode), or in a stage that references one: its transforms,
    upAxis, metersPerUnit and retiming are applied, and the asset's clip leads to metres, Z up. Failing that,
    the splats of another program, without what depends on the direction; where they change over time, as
    Gaussians that live for one frame each, or until the next sample where frames have several. What they leave out is
    what the schema says; without coefficients displayColor counts. And where its prim or what is above it moves over
    time, that motion: (F,4,4) for each frame of the clip, in the world, from where the clip places the asset (see
    `rest_and_motion`).

    Raises InputError: no such file, not USD, no splats or several of them, a transform that is flat, arrays that
    do not belong together."""
    path = Path(path)
    with reading(path):
        return _read(path)


def _read(path: Path) -> LoadedAsset:
    stage = open_stage(path)
    select(stage, RECONSTRUCTION)
    found = [p for p in all_prims(stage) if p.HasAttribute("primvars:gs4d:mu_t")]
    ours = bool(found)
    found = found or [p for p in all_prims(stage) if p.GetTypeName() == SPLAT_TYPE]
    if not found:
        for error in stage.GetCompositionErrors():
            if lost := re.search(r"Could not open asset @(.+?)@", str(error)):
                raise InputError(f"{path}: it refers to {lost[1]}, which cannot be opened; find that file.")
        raise InputError(f"{path}: no prim is a {SPLAT_TYPE} or has primvars:gs4d:*; choose a USD file with splats.")
    if len(found) > 1:
        names = ", ".join(str(p.GetPath()) for p in found[:3]) + (", …" if len(found) > 3 else "")
        raise InputError(f"{path}: it holds {len(found)} assets ({names}); open one of their own files.")
    note = ""
    if ours:
        asset = _read_4d(path, stage, found[0])
        check(asset, path)
    else:
        asset, note = sound_part(_read_others(path, stage, found[0]), path)
    placed, motion = _in_the_world(asset, path, stage, found[0])
    return LoadedAsset(placed, "Z", note, motion)


def _values(path: Path, prim, *names: str, code=None, dtype: type = np.float32) -> np.ndarray:
    """The first of the attributes that has a value, at a time code or else at the first one."""
    value = _value(prim, *names, code=code)
    if value is None:
        raise InputError(f"{path}: {names[0]} is missing at {prim.GetPath()}; export it again.")
    return value.astype(dtype)


def _value(prim, *names: str, code=None) -> np.ndarray | None:
    """The same in the type it has, or None."""
    for name in names:
        attribute = prim.GetAttribute(name)
        at = import_pxr().Usd.TimeCode.EarliestTime() if code is None else code
        value = attribute.Get(at) if attribute else None
        if value is not None:
            return np.asarray(value)
    return None


def _clip(path: Path, stage, start: float, end: float, pixel: float = 0.0) -> Clip:
    """The whole frames around two time codes; the nearest one where they are the same."""
    if not end - start < MAX_CLIP_FRAMES:
        raise InputError(f"{path}: its frames run from {start:g} to {end:g}, that is too many; export it again.")
    first, last = int(np.floor(start + 1e-6)), int(np.ceil(end - 1e-6))
    if start == end:
        first = last = round(start)
    return Clip(stage.GetTimeCodesPerSecond(), first, last, pixel=pixel)


def _read_4d(path: Path, stage, prim) -> Asset:
    """A prim of Timesplat's, in its own space."""

    def get(*names: str) -> np.ndarray:
        return _values(path, prim, *names)

    if prim.HasAttribute("primvars:gs4d:rgb"):
        rgb = get("primvars:gs4d:rgb")
    else:
        rgb = _rgb(get(SH_COEFFICIENTS, f"{SH_COEFFICIENTS}h"))
    start, end = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    if prim.HasAttribute("gs4d:time"):
        start, *_, end = prim.GetAttribute("gs4d:time").GetTimeSamples() * 2  # one sample, where the clip is one frame
    t, velocity, sigma_t = (get(f"primvars:gs4d:{name}") for name in ("mu_t", "velocity", "sigma_t"))
    clip = _clip(path, stage, start, end, pixel=prim.GetCustomDataByKey("timesplat:pixel") or 0.0)
    tracks = _tracks(path, prim) if prim.HasAttribute("primvars:gs4d:path") else {}
    first, last = clip.frame_start, clip.frame_end
    if last > first and (first, last) != (start, end):  # retimed to fractional frames
        stretch = np.float32((end - start) / (last - first))
        shift = np.float32(2 * (start - first) / (last - first) - 1)
        t = (t + 1) * stretch + shift
        velocity, sigma_t = velocity / stretch, sigma_t if tracks else sigma_t * stretch
        if tracks:
            ends = {name: (getattr(tracks["paths"], name) + 1) * stretch + shift for name in ("start", "end")}
            tracks["paths"] = replace(tracks["paths"], **ends)
    return Asset(
        xyz=get("primvars:gs4d:position"),
        t=t,
        velocity=velocity,
        sigma_t=sigma_t,
        scale=get("primvars:gs4d:scale"),
        rotation=_unit(wxyz_from_xyzw(get("primvars:gs4d:rotation", "orientations", "orientationsh"))),
        rgb=rgb,
        opacity=get("primvars:gs4d:opacity"),
        clip=clip,
        **tracks,
    )


def _tracks(path: Path, prim) -> dict[str, Any]:
    """Asset's `path` and `paths`."""
    index, count = (_values(path, prim, name, dtype=np.int32) for name in ("primvars:gs4d:path", "gs4d:paths:knots"))
    start, end, place, turn = (_values(path, prim, f"gs4d:paths:{n}") for n in ("start", "end", "place", "rotation"))
    return {"path": index, "paths": Paths(start, end, count, place, continuous(_unit(wxyz_from_xyzw(turn)), count))}


def _unit(quaternion: np.ndarray) -> np.ndarray:
    """Of quaternions w x y z, of which zero ones do not turn."""
    with np.errstate(all="ignore"):  # what is NaN stays so
        length = np.linalg.norm(quaternion, axis=1, keepdims=True)
        return np.where(length == 0, np.array([1, 0, 0, 0], np.float32), quaternion / length)


def _rgb(sh: np.ndarray) -> np.ndarray:
    """(N,3) coefficients of the constant spherical harmonic -> (N,3) sRGB-encoded, float32."""
    return (0.5 + SH_C0 * sh.astype(np.float64)).astype(np.float32)


def _read_others(path: Path, stage, prim) -> Asset:
    """A prim of another program's, in its own space; unchecked."""
    names = ("positions", "scales", "orientations", "opacities", SH_COEFFICIENTS)
    attributes = [prim.GetAttribute(k) for n in (*names, DISPLAY_COLOUR) for k in (n, f"{n}h")]
    codes = sorted({c for a in attributes if a for c in a.GetTimeSamples()})
    clip = _clip(path, stage, codes[0], codes[-1]) if len(codes) > 1 else Clip(stage.GetTimeCodesPerSecond(), 0, 0)
    first, last = clip.frame_start, clip.frame_end
    moments, sigma_t = np.array([float(first)]), np.array([STATIC_SIGMA_T])
    if last > first:
        moments = np.union1d(clip.frames, [c for c in codes if c % 1])
        gaps = np.diff(moments, prepend=-np.inf, append=np.inf)
        sigma_t = ONE_FRAME_SIGMA * np.minimum(gaps[1:], gaps[:-1]) * 2 / (last - first)
    parts, total = [], 0
    for moment, sigma in zip(moments.tolist(), sigma_t, strict=True):
        code = moment if len(codes) > 1 else codes[0] if codes else None
        xyz = _values(path, prim, "positions", "positionsh", code=code)
        n = len(xyz)
        total += n
        if total > MAX_GAUSSIANS:
            raise InputError(
                f"{path}: it has more than {MAX_GAUSSIANS:,} Gaussians over its frames; export fewer frames."
            )
        scale, quaternion, opacity = (_value(prim, k, f"{k}h", code=code) for k in names[1:4])
        if quaternion is not None and quaternion.ndim != 2:
            raise InputError(f"{path}: {quaternion.size} orientations cannot belong to {n} splats; export it again.")
        parts.append({
            "xyz": xyz,
            "t": np.full(n, clip.frame_to_time(moment)),
            "velocity": np.zeros_like(xyz),
            "sigma_t": np.full(n, sigma),
            "scale": np.ones((n, 3)) if scale is None else np.maximum(scale, SMALLEST_SCALE),
            "rotation": np.tile([1.0, 0, 0, 0], (n, 1)) if quaternion is None else _unit(wxyz_from_xyzw(quaternion)),
            "rgb": _colours(path, prim, n, code),
            "opacity": np.ones(n) if opacity is None else opacity,
        })  # fmt: skip
    joined = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
    return Asset(**{k: a.astype(np.float32) for k, a in joined.items()}, clip=clip)


def _colours(path: Path, prim, n: int, code) -> np.ndarray:
    """(N,3) sRGB-encoded: of the coefficients, else of displayColor, else grey."""
    sh = _value(prim, SH_COEFFICIENTS, f"{SH_COEFFICIENTS}h", code=code)
    if sh is not None:
        if n == 0 or len(sh) == 0 or len(sh) % n:
            raise InputError(f"{path}: {len(sh)} SH coefficients cannot belong to {n} splats; export it again.")
        return _rgb(sh[:: len(sh) // n])
    UsdGeom, TimeCode = import_pxr().UsdGeom, import_pxr().Usd.TimeCode
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(DISPLAY_COLOUR.removeprefix("primvars:"))
    shown = primvar.ComputeFlattened(TimeCode.EarliestTime() if code is None else code) if primvar else None
    colours = np.full((1, 3), 0.5) if shown is None else srgb_from_linear(np.asarray(shown).reshape(-1, 3))
    if len(colours) not in (1, n):
        raise InputError(f"{path}: {len(colours)} colours cannot belong to {n} splats; export it again.")
    return np.broadcast_to(colours, (n, 3))


def _in_the_world(asset: Asset, path: Path, stage, prim) -> tuple[Asset, np.ndarray | None]:
    """The asset where the stage has it, in metres, Z up; and its motion from there."""
    pxr = import_pxr()
    if not prim.IsA(pxr.UsdGeom.Xformable):
        version = ".".join(map(str, pxr.Usd.GetVersion()[1:]))
        raise InputError(f"{path}: USD {version} does not know the type of {prim.GetPath()}; add fallbackPrimTypes to "
                         "this file, or reference an asset exported as points.")  # fmt: skip
    codes, above = [], prim
    while not above.IsPseudoRoot():
        if (x := pxr.UsdGeom.Xformable(above)) and x.TransformMightBeTimeVarying():
            codes += x.GetTimeSamples()
        above = above.GetParent()
    if codes and asset.clip.frame_start == asset.clip.frame_end:  # the motion alone has a length
        asset = replace(asset, clip=_clip(path, stage, min(codes), max(codes), asset.clip.pixel))
    outer = np.diag([*[metres_per_unit(stage, path)] * 3, 1.0])
    if pxr.UsdGeom.GetStageUpAxis(stage) == "Y":
        outer = outer @ [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
    cache, matrices = pxr.UsdGeom.XformCache(), []
    for frame in asset.clip.frames if codes else [asset.clip.frame_start]:
        cache.SetTime(frame)
        matrices.append(outer @ np.array(cache.GetLocalToWorldTransform(prim)).T)
    try:
        matrix, motion = rest_and_motion(np.stack(matrices))
        scale = float(matrix[0, 0])
        if scale > 0 and np.abs(matrix[:3, :3] - scale * np.eye(3)).max() < 1e-6 * scale:
            x, y, z = map(float, matrix[:3, 3])
            clip = replace(asset.clip, scale=scale, translation=(x, y, z))
            return replace(asset, clip=clip), motion
        return place_asset(asset, matrix), motion
    except InputError:
        raise InputError(f"{path}: {prim.GetPath()} is scaled to nothing; give it a scale.") from None
