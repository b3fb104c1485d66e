# SPDX-License-Identifier: GPL-3.0-or-later
"""A 4D Gaussian asset as USD: one prim that is a Gaussian splat to new readers and points to old ones.

The prim is a `ParticleField3DGaussianSplat` (OpenUSD 26.03). It also carries `points`, `widths`,
`primvars:displayColor` and `displayOpacity`, and the stage says in `fallbackPrimTypes` that a reader which
does not know the type shall take it as `Points`. Attributes are authored raw, so that an older pxr (the
one inside Blender) writes the same file. `primvars:gs4d:*` keep the 4D parameters, from which `read_usd`
gives the Asset back, and `gs4d:time` is the time they are in: -1 at the clip's first frame, 1 at its last, so
that a layer offset moves it with the samples. Needs numpy and pxr (usd-core). docs/pipelines.md is for those
who read the files.

What is sampled over time
    positions   two samples where that says it all; one a frame, with |t - μ_t| held within REACH·σ_t, where
                a short-lived Gaussian's line would leave the box long after it has faded, or in mode frames.
    opacities   one a frame, rounded to 1/1000: so few different values are stored as a table, which makes
                the file a third of the size. The exact ones can be had from primvars:gs4d:*.
    widths      one a frame: 0 while the Gaussian is invisible, so that a viewer of mere points shows
                only what is there.
    transform   one a frame, where the asset moves as a whole
`scales` are `Asset.soft_scale`, which has no holes at any resolution; primvars:gs4d:scale are the plain ones.
Spherical harmonics are sRGB-encoded, as in every 3DGS file; displayColor is linear, as USD wants it.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import tempfile
import zipfile
from pathlib import Path

import numpy as np

from ...datagen.sequence import InputError
from .asset import SH_C0, VISIBLE, Asset, atomic, check, linear_from_srgb, rotation_matrices
from .usd_check import check_usd
from .usd_read import (
    ORIGINAL,
    RECONSTRUCTION,
    SH,
    SPLAT,
    VARIANTS,
    metres_per_unit,
    open_stage,
    pxr,
    quiet,
    read_moving,
    read_usd,
    reading,
)

__all__ = ["MODES", "SUFFIXES", "check_usd", "read_moving", "read_usd", "write_usd"]

ROOT = "/timesplat"
PRIM = f"{ROOT}/splats"
BOX = 5.0  # how far, in normalised units, an invisible point may stray before positions are sampled per frame
REACH = 4.0  # lifetimes after which a Gaussian stands still: exp(-½·4²) rounds to an opacity of 0
EXTENT_SIGMAS = 3.0
HALF_TINY, HALF_MAX = 2.0**-14, 65504.0
MODES = ("splats", "points", "frames")
SUFFIXES = (".usd", ".usdc", ".usda", ".usdz")
PACKAGED = (".usd", ".usda", ".usdc", ".png", ".jpg", ".jpeg", ".exr", ".avif", ".m4a", ".mp3", ".wav")  # in a .usdz


def write_usd(
    path: str | Path,
    asset: Asset,
    *,
    mode: str = "splats",
    half: bool = False,
    original: str | Path | None = None,
    original_start: float | None = None,
    motion: np.ndarray | None = None,
) -> None:
    """Writes .usd/.usdc (binary), .usda (text) or .usdz (package); whole or not at all.

    mode      splats   the Gaussian splat prim, which older readers take as points
              points   plain `Points`, for pipelines that reference the file from a layer of their own
                       (fallbackPrimTypes is read from the root layer alone)
              frames   as splats, with positions at every frame, for readers that do not interpolate
    half      everything but positions and opacities in half precision (positions would lose up to 0.0005 of the
              object's half-side, opacities gain nothing; scales and lifetimes below 2^-14 are raised to it,
              lifetimes above 65504 lowered)
    original  USD file of the object that was reconstructed: the default prim gets a variant set `representation`
              with `reconstruction` (selected) and `original`, which lies over it. A .usdz takes in the original
              and the files it needs, all from the original's folder; others refer to it by its relative path.
    original_start  its time code at the clip's first frame (default: that frame)
    motion    (F,4,4) where the asset is taken at each frame of the clip, in the world, from where the clip places it;
              of the original nothing is moved
    Raises InputError: wrong suffix or mode, bad arrays, the disk, an original that cannot be used."""
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: the name must end in {', '.join(SUFFIXES)}; choose one of these.")
    if mode not in MODES:
        raise InputError(f"{mode}: no such mode; choose one of {', '.join(MODES)}.")
    check(asset, path)
    if original_start is not None and not np.isfinite(original_start):
        raise InputError(f"{original_start}: the frame at which the original starts must be a number; give one.")
    if motion is not None and not (motion.shape == (len(asset.clip.frames), 4, 4) and np.isfinite(motion).all()):
        raise InputError(f"{path}: its motion is not a finite matrix for each frame of the clip; export it again.")
    _, Sdf, _, _, UsdUtils, _ = pxr()
    stage = _stage(asset, mode, half, path, motion, variants=original is not None)
    with atomic(path) as tmp, tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, quiet():
        package = Path(folder) / "package.usdz" if path.suffix.lower() == ".usdz" else None
        inner = Path(folder) / "splats.usdc" if package else tmp
        if original is not None:
            shift = 0 if original_start is None else asset.clip.frame_start - original_start
            with reading(Path(original)):
                _add_original(stage.GetRootLayer(), Path(original), shift, path, Path(folder))
        try:
            ok = stage.GetRootLayer().Export(str(inner))
            if package:
                ok = ok and UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(inner)), str(package))
                shutil.copyfile(package, tmp)
        except RuntimeError as e:  # Tf.ErrorException is one, and is many lines long; the first says it
            said = re.search(r" : '(.+)'$", str(e), re.MULTILINE)
            raise OSError(said[1] if said else "the USD library stopped") from None
        if not ok:
            raise OSError("the USD library refused")
    if old := Sdf.Layer.Find(str(path)):  # open in this process: it would go on showing the former file
        old.Reload(force=True)


def _add_original(layer, original: Path, shift: float, path: Path, folder: Path) -> None:
    """Puts the original into the variant ORIGINAL, turned and scaled to Z-up metres and with its time codes later by
    `shift` (a reference alone would also convert them from its frame rate to ours)."""
    Gf, Sdf, _, UsdGeom, UsdUtils, Vt = pxr()
    source = open_stage(original)
    if path.exists() and path.samefile(original):
        raise InputError(f"{path}: it is the original itself; write to another file.")
    prim = source.GetDefaultPrim()
    roots = [p for p in source.GetPseudoRoot().GetChildren() if p.IsDefined() and not p.IsAbstract()]
    if not prim and len(roots) != 1:
        raise InputError(f"{original}: it has no default prim to refer to; set its defaultPrim.")
    metres = metres_per_unit(source, original)
    if path.suffix.lower() == ".usdz":
        if original.suffix.lower() == ".usdz":
            original = _unpacked(original, folder)
        home = original.parent.resolve()
        layers, files, missing = UsdUtils.ComputeAllDependencies(Sdf.AssetPath(str(original)))
        if missing:
            raise InputError(f"{original}: it refers to {missing[0]}, which is not there; find it or write a .usdc.")
        for name in [x.realPath for x in layers] + list(files):
            if not Path(name).resolve().is_relative_to(home):
                raise InputError(f"{original}: it refers to {name}, outside of its own folder; copy that beside it.")
            if not name.lower().endswith(PACKAGED):
                raise InputError(f"{original}: it refers to {name}, which has no place in a .usdz; write a .usdc.")
        where = original.resolve().as_posix()
    else:
        where = _relative(original, path)

    def op(name: str, kind, value) -> str:
        Sdf.AttributeSpec(parent, f"xformOp:{name}", kind).default = value
        return f"xformOp:{name}"

    parent = Sdf.CreatePrimInLayer(layer, f"{ROOT}{{{VARIANTS}={ORIGINAL}}}original")
    parent.specifier, parent.typeName = Sdf.SpecifierDef, "Xform"
    order = [op("scale", Sdf.ValueTypeNames.Double3, Gf.Vec3d(metres))] if metres != 1 else []
    if UsdGeom.GetStageUpAxis(source) == "Y":
        order.append(op("rotateX", Sdf.ValueTypeNames.Double, 90.0))
    kind = Sdf.ValueTypeNames.TokenArray
    Sdf.AttributeSpec(parent, "xformOpOrder", kind, Sdf.VariabilityUniform).default = Vt.TokenArray(order)
    child = Sdf.PrimSpec(parent, "object", Sdf.SpecifierDef)  # its own transform stays its own
    child.kind = "subcomponent"
    rate = source.GetTimeCodesPerSecond() / layer.timeCodesPerSecond
    root = Sdf.Path() if prim else roots[0].GetPath()
    child.referenceList.prependedItems.append(Sdf.Reference(where, root, Sdf.LayerOffset(shift, rate)))


def _relative(original: Path, path: Path) -> str:
    try:
        relative = Path(os.path.relpath(original.resolve(), path.resolve().parent)).as_posix()
    except ValueError:  # another drive
        return original.resolve().as_posix()
    return relative if relative.startswith("../") else f"./{relative}"


def _unpacked(original: Path, folder: Path) -> Path:
    """The root layer of a .usdz, unpacked: a package has no place in a package."""
    try:
        with zipfile.ZipFile(original) as z:
            if any(i.compress_type != zipfile.ZIP_STORED for i in z.infolist()):
                raise ValueError("it is compressed")
            if sum(i.file_size for i in z.infolist()) > original.stat().st_size:
                raise ValueError("its files overlap")
            z.extractall(folder / "original")  # keeps inside of the folder
            return folder / "original" / z.namelist()[0]
    except (zipfile.BadZipFile, ValueError, IndexError) as e:
        raise InputError(f"{original}: it is not a whole .usdz ({e}); export it again.") from None


def _stage(asset: Asset, mode: str, half: bool, path: Path, motion: np.ndarray | None, variants: bool):
    Sdf, Usd, Vt = (pxr()[i] for i in (1, 2, 5))
    clip = asset.clip
    positions, extent = _positions(asset, mode == "frames", path), _extent(asset)
    stage = Usd.Stage.CreateInMemory()
    root = stage.DefinePrim(ROOT, "Xform")
    stage.SetDefaultPrim(root)
    Usd.ModelAPI(root).SetKind("component")
    root.AddAppliedSchema("GeomModelAPI")
    for key, value in {
        "upAxis": "Z",
        "metersPerUnit": 1.0,
        "timeCodesPerSecond": float(clip.fps),
        "framesPerSecond": float(clip.fps),
        "startTimeCode": float(clip.frame_start),
        "endTimeCode": float(clip.frame_end),
        "documentation": "4D Gaussians by Timesplat. Spherical harmonics are sRGB-encoded as in 3DGS files, "
        "displayColor is linear; primvars:gs4d:* are the parameters in the time gs4d:time.",
    }.items():
        stage.SetMetadata(key, value)
    if mode != "points":
        stage.SetMetadata("fallbackPrimTypes", {SPLAT: Vt.TokenArray(["Points"])})
    with contextlib.ExitStack() as stack:
        if variants:
            choice = root.GetVariantSets().AddVariantSet(VARIANTS)
            for name in (RECONSTRUCTION, ORIGINAL):
                choice.AddVariant(name)
            choice.SetVariantSelection(RECONSTRUCTION)
            stack.enter_context(choice.GetVariantEditContext())
        hint = extent * clip.scale + clip.translation
        if motion is not None:  # the corners of the box wherever it goes
            corners = np.stack(np.meshgrid(*hint.T, [1.0]), -1).reshape(-1, 4)
            everywhere = (corners @ motion.transpose(0, 2, 1))[..., :3].reshape(-1, 3)
            hint = np.stack([everywhere.min(0), everywhere.max(0)])
        hint = Vt.Vec3fArray.FromNumpy(hint.astype(np.float32))
        root.CreateAttribute("extentsHint", Sdf.ValueTypeNames.Float3Array, False).Set(hint)
        _author(stage, asset, mode, half, positions, extent, motion)
    return stage


def _author(stage, asset: Asset, mode: str, half: bool, positions: dict, extent: np.ndarray, motion) -> None:
    Gf, Sdf, _, _, _, Vt = pxr()
    clip, T = asset.clip, Sdf.ValueTypeNames
    prim = stage.DefinePrim(PRIM, "Points" if mode == "points" else SPLAT)

    def put(name: str, kind, value, *, uniform=False, primvar=False) -> None:
        """value: one value, or {time code: value}."""
        variability = Sdf.VariabilityUniform if uniform else Sdf.VariabilityVarying
        attribute = prim.CreateAttribute(name, kind, False, variability)
        if primvar:
            attribute.SetMetadata("interpolation", "vertex")
        if isinstance(value, dict):
            for code, v in value.items():
                attribute.Set(v, code)
        else:
            attribute.Set(value)

    def f3(a):
        return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(a, np.float32))

    def f1(a):
        return Vt.FloatArray.FromNumpy(np.ascontiguousarray(a, np.float32))

    def small(a):  # into the range of half floats, away from zero
        return np.clip(a, HALF_TINY, HALF_MAX) if half else a

    if half:
        s3, s1, kind3, kind1 = Vt.Vec3hArray.FromNumpy, Vt.HalfArray.FromNumpy, T.Half3Array, T.HalfArray
        kind4, dtype, quats, h = T.QuathArray, np.float16, Vt.QuathArray.FromNumpy, "h"
    else:
        s3, s1, kind3, kind1 = Vt.Vec3fArray.FromNumpy, Vt.FloatArray.FromNumpy, T.Float3Array, T.FloatArray
        kind4, dtype, quats, h = T.QuatfArray, np.float32, Vt.QuatfArray.FromNumpy, ""

    def packed(to, a):
        return to(np.ascontiguousarray(a, dtype))

    put("xformOp:translate", T.Double3, Gf.Vec3d(*map(float, clip.translation)))
    put("xformOp:scale", T.Double3, Gf.Vec3d(float(clip.scale)))
    order = ["xformOp:translate", "xformOp:scale"]
    if motion is not None:  # outermost; USD's matrices are for row vectors
        samples = {float(f): Gf.Matrix4d(m.T) for f, m in zip(clip.frames, motion, strict=True)}
        put("xformOp:transform", T.Matrix4d, samples)
        order.insert(0, "xformOp:transform")
    put("xformOpOrder", T.TokenArray, Vt.TokenArray(order), uniform=True)

    positions = {c: f3(p) for c, p in positions.items()}
    if len(positions) == 1:
        (positions,) = positions.values()
    curve = {float(f): asset.at(asset.frame_to_time(f))[1] for f in clip.frames}
    faded = {c: np.round(o * 1000) / 1000 for c, o in curve.items()}
    put("points", T.Point3fArray, positions)
    put("widths", T.FloatArray, _changing(f1, _widths(asset, curve)), primvar=True)
    put("primvars:displayColor", T.Color3fArray, f3(linear_from_srgb(asset.rgb)), primvar=True)
    put("primvars:displayOpacity", T.FloatArray, _changing(f1, faded), primvar=True)
    put("extent", T.Float3Array, f3(extent))

    scales = packed(s3, small(asset.scale))
    prim.SetCustomDataByKey("timesplat:pixel", float(clip.pixel))
    rotations = packed(quats, asset.rotation[:, [1, 2, 3, 0]])  # FromNumpy takes x y z w
    put("primvars:gs4d:scale", kind3, scales, primvar=True)  # stored once where both are the same
    if mode == "points":
        put("primvars:gs4d:rotation", kind4, rotations, primvar=True)
        put("primvars:gs4d:rgb", kind3, packed(s3, asset.rgb), primvar=True)
    else:
        put("positions", T.Point3fArray, positions)
        put(f"scales{h}", kind3, packed(s3, small(asset.soft_scale())))
        put(f"orientations{h}", kind4, rotations)
        put("opacities", T.FloatArray, _changing(f1, faded))  # stored once, with displayOpacity
        put("radiance:sphericalHarmonicsDegree", T.Int, 0, uniform=True)
        put(f"{SH}{h}", kind3, packed(s3, (asset.rgb - 0.5) / SH_C0))

    velocity = np.clip(asset.velocity, -HALF_MAX, HALF_MAX) if half else asset.velocity
    put("primvars:gs4d:position", T.Float3Array, f3(asset.xyz), primvar=True)
    put("primvars:gs4d:velocity", kind3, packed(s3, velocity), primvar=True)
    put("primvars:gs4d:mu_t", kind1, packed(s1, asset.t), primvar=True)
    put("primvars:gs4d:sigma_t", kind1, packed(s1, small(asset.sigma_t)), primvar=True)
    put("primvars:gs4d:opacity", kind1, packed(s1, asset.opacity), primvar=True)
    put("gs4d:time", T.Double, {float(f): float(asset.frame_to_time(f)) for f in (clip.frame_start, clip.frame_end)})


def _positions(asset: Asset, every: bool, path: Path) -> dict[float, np.ndarray]:
    """{time code: (N,3)}: one sample if nothing moves, two if no line leaves the box, else (or if `every`)
    one a frame."""
    clip = asset.clip

    def held(time: float) -> np.ndarray:
        dt = np.clip(np.float32(time) - asset.t, -REACH * asset.sigma_t, REACH * asset.sigma_t)
        return asset.xyz + asset.velocity * dt[:, None]

    if clip.frame_start == clip.frame_end or not asset.velocity.any():
        return {float(clip.frame_start): asset.at(0.0)[0] if asset.velocity.any() else asset.xyz}
    with np.errstate(over="ignore", invalid="ignore"):
        ends = {float(f): asset.at(t)[0] for f, t in ((clip.frame_start, -1.0), (clip.frame_end, 1.0))}
        astray = [(np.abs(p) > BOX) & (p != held(t)) for p, t in zip(ends.values(), (-1, 1), strict=True)]
        samples = ends
        if every or any(a.any() for a in astray):
            samples = {float(f): held(asset.frame_to_time(f)) for f in clip.frames}
    if not all(np.isfinite(p).all() for p in samples.values()):
        raise InputError(f"{path}: velocity is so large that positions overflow; reconstruct it again.")
    return samples


def _widths(asset: Asset, curve: dict[float, np.ndarray]) -> dict[float, np.ndarray]:
    """Diameters for readers of points: twice the middle standard deviation, which covers a flat splat's
    face, rounded to 256 steps of its logarithm (few values make a small file); 0 while invisible."""
    middle = np.log(np.sort(asset.soft_scale(), axis=1)[:, 1])
    step = max((middle.max() - middle.min()) / 255, 1e-9)
    width = 2 * np.exp(np.round((middle - middle.min()) / step) * step + middle.min())
    return {code: np.where(o >= VISIBLE, width, 0).astype(np.float32) for code, o in curve.items()}


def _changing(to, samples: dict[float, np.ndarray]):
    """The samples through `to`; one plain value where all of them are the same."""
    first, *rest = samples.values()
    if all(np.array_equal(first, r) for r in rest):
        return to(first)
    return {code: to(a) for code, a in samples.items()}


def _extent(asset: Asset) -> np.ndarray:
    """(2,3) bounds of all Gaussians (three sigmas) at the frames where they are visible; of all of them at
    their own times if none ever is."""
    M = rotation_matrices(asset.rotation) * asset.soft_scale()[:, None, :]
    reach = EXTENT_SIGMAS * np.sqrt((M**2).sum(-1))
    low, high = [], []
    for frame in asset.clip.frames:
        position, opacity = asset.at(asset.frame_to_time(frame))
        seen = opacity >= VISIBLE
        if seen.any():
            low.append((position - reach)[seen].min(0))
            high.append((position + reach)[seen].max(0))
    if not low:
        return np.stack([(asset.xyz - reach).min(0), (asset.xyz + reach).max(0)])
    return np.stack([np.min(low, 0), np.max(high, 0)])
