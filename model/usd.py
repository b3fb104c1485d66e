# SPDX-License-Identifier: GPL-3.0-or-later
"""A 4D Gaussian asset as USD: one prim that is a Gaussian splat to new readers and points to old ones.

The prim is a `ParticleField3DGaussianSplat` (OpenUSD 26.03). It also carries `points`, `widths`,
`primvars:displayColor` and `displayOpacity`, and the stage says in `fallbackPrimTypes` that a reader which
does not know the type shall take it as `Points`. Attributes are authored raw, so that an older pxr (the
one inside Blender) writes the same file. `primvars:gs4d:*` keep the 4D parameters, from which `read_usd`
gives the Asset back. Needs numpy and pxr (usd-core).

What is sampled over time
    positions   two samples where that says it all; one a frame, with |t - μ_t| held within REACH·σ_t, where
                a short-lived Gaussian's line would leave the box long after it has faded, or in mode frames.
    opacities   one a frame, rounded to 1/1000: so few different values are stored as a table, which makes
                the file a third of the size. The exact ones can be had from primvars:gs4d:*.
    widths      one a frame: 0 while the Gaussian is invisible, so that a viewer of mere points shows
                only what is there.
`scales` are `Asset.soft_scale`, which has no holes at any resolution; primvars:gs4d:scale are the plain ones.
Spherical harmonics are sRGB-encoded, as in every 3DGS file; displayColor is linear, as USD wants it.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

from ..datagen.sequence import InputError
from .asset import SH_C0, VISIBLE, Asset, Clip, atomic, check, linear_from_srgb, rotation_matrices

SPLAT = "ParticleField3DGaussianSplat"
PRIM = "/timesplat/splats"
BOX = 5.0  # how far, in normalised units, an invisible point may stray before positions are sampled per frame
REACH = 4.0  # lifetimes after which a Gaussian stands still: exp(-½·4²) rounds to an opacity of 0
EXTENT_SIGMAS = 3.0
HALF_TINY, HALF_MAX = 2.0**-14, 65504.0
MODES = ("splats", "points", "frames")
SUFFIXES = (".usd", ".usdc", ".usda", ".usdz")


def _pxr():
    try:
        from pxr import Gf, Sdf, Usd, UsdUtils, Vt
    except ImportError:
        raise InputError(
            f"{sys.executable} lacks the package usd-core, which USD files need; install it, or timesplat[usd], there."
        ) from None
    return Gf, Sdf, Usd, UsdUtils, Vt


# ---------------------------------------------------------------- writing


def write_usd(path: str | Path, asset: Asset, *, mode: str = "splats", half: bool = False) -> None:
    """Writes .usd/.usdc (binary), .usda (text) or .usdz (package); whole or not at all.

    mode   splats   the Gaussian splat prim, which older readers take as points
           points   plain `Points`, for pipelines that reference the file from a layer of their own
                    (fallbackPrimTypes is read from the root layer alone)
           frames   as splats, with positions at every frame, for readers that do not interpolate
    half   everything but positions and opacities in half precision (positions would lose up to 0.0005 of the
           object's half-side, opacities gain nothing; scales and lifetimes below 2^-14 are raised to it,
           lifetimes above 65504 lowered)
    Raises InputError: wrong suffix or mode, bad arrays, the disk."""
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: the name must end in {', '.join(SUFFIXES)}; choose one of these.")
    if mode not in MODES:
        raise InputError(f"{mode}: no such mode; choose one of {', '.join(MODES)}.")
    check(asset, path)
    _, Sdf, _, UsdUtils, _ = _pxr()
    stage = _stage(asset, mode, half, path)
    with atomic(path) as tmp, tempfile.TemporaryDirectory() as folder:
        inner = Path(folder) / "splats.usdc" if path.suffix.lower() == ".usdz" else tmp
        try:
            ok = stage.GetRootLayer().Export(str(inner))
            if inner is not tmp:
                package = Path(folder) / "splats.usdz"
                ok = ok and UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(inner)), str(package))
                shutil.copyfile(package, tmp)
        except RuntimeError as e:  # Tf.ErrorException is one, and is many lines long
            raise OSError(str(e).strip().splitlines()[-1]) from None
        if not ok:
            raise OSError("the USD library refused")
    if old := Sdf.Layer.Find(str(path)):  # open in this process: it would go on showing the former file
        old.Reload(force=True)


def _stage(asset: Asset, mode: str, half: bool, path: Path):
    Gf, Sdf, Usd, _, Vt = _pxr()
    clip, T = asset.clip, Sdf.ValueTypeNames
    stage = Usd.Stage.CreateInMemory()
    root = stage.DefinePrim("/timesplat", "Xform")
    stage.SetDefaultPrim(root)
    Usd.ModelAPI(root).SetKind("component")
    for key, value in {
        "upAxis": "Z",
        "metersPerUnit": 1.0,
        "timeCodesPerSecond": float(clip.fps),
        "framesPerSecond": float(clip.fps),
        "startTimeCode": float(clip.frame_start),
        "endTimeCode": float(clip.frame_end),
        "documentation": "4D Gaussians by Timesplat. Spherical harmonics are sRGB-encoded as in 3DGS files, "
        "displayColor is linear; primvars:gs4d:* are the parameters in time -1..1 over the clip.",
    }.items():
        stage.SetMetadata(key, value)
    if mode != "points":
        stage.SetMetadata("fallbackPrimTypes", {SPLAT: Vt.TokenArray(["Points"])})
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
    order = Vt.TokenArray(["xformOp:translate", "xformOp:scale"])
    put("xformOpOrder", T.TokenArray, order, uniform=True)

    positions = {c: f3(p) for c, p in _positions(asset, mode == "frames", path).items()}
    positions = positions if len(positions) > 1 else next(iter(positions.values()))
    curve = {float(f): asset.at(asset.frame_to_time(f))[1] for f in clip.frames}
    faded = {c: np.round(o * 1000) / 1000 for c, o in curve.items()}
    put("points", T.Point3fArray, positions)
    put("widths", T.FloatArray, _changing(f1, _widths(asset, curve)), primvar=True)
    put("primvars:displayColor", T.Color3fArray, f3(linear_from_srgb(asset.rgb)), primvar=True)
    put("primvars:displayOpacity", T.FloatArray, _changing(f1, faded), primvar=True)
    put("extent", T.Float3Array, f3(_extent(asset)))

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
        put(f"radiance:sphericalHarmonicsCoefficients{h}", kind3, packed(s3, (asset.rgb - 0.5) / SH_C0))

    velocity = np.clip(asset.velocity, -HALF_MAX, HALF_MAX) if half else asset.velocity
    put("primvars:gs4d:position", T.Float3Array, f3(asset.xyz), primvar=True)
    put("primvars:gs4d:velocity", kind3, packed(s3, velocity), primvar=True)
    put("primvars:gs4d:mu_t", kind1, packed(s1, asset.t), primvar=True)
    put("primvars:gs4d:sigma_t", kind1, packed(s1, small(asset.sigma_t)), primvar=True)
    put("primvars:gs4d:opacity", kind1, packed(s1, asset.opacity), primvar=True)
    return stage


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


# ---------------------------------------------------------------- reading


def _open(path: Path):
    Usd = _pxr()[2]
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the name.")
    try:
        return Usd.Stage.Open(str(path))
    except RuntimeError:
        raise InputError(f"{path}: it is damaged or not a USD file; export it again.") from None


def read_usd(path: str | Path) -> Asset:
    """The asset in a file that `write_usd` wrote (any mode), from the first prim with primvars:gs4d:*.
    Raises InputError: no such file, not USD, no such prim, arrays that do not belong together."""
    path = Path(path)
    stage = _open(path)
    prim = next((p for p in stage.Traverse() if p.HasAttribute("primvars:gs4d:mu_t")), None)
    if prim is None:
        raise InputError(f"{path}: no prim has primvars:gs4d:*; only USD written by Timesplat can be read.")

    def get(*names: str) -> np.ndarray:
        for name in names:
            value = prim.GetAttribute(name).Get() if prim.HasAttribute(name) else None
            if value is not None:
                return np.asarray(value).astype(np.float32)
        raise InputError(f"{path}: {names[0]} is missing at {prim.GetPath()}; export it again.")

    sh = "radiance:sphericalHarmonicsCoefficients"
    if prim.HasAttribute("primvars:gs4d:rgb"):
        rgb = get("primvars:gs4d:rgb")
    else:
        rgb = (0.5 + SH_C0 * get(sh, f"{sh}h").astype(np.float64)).astype(np.float32)
    try:
        rotation = get("orientations", "orientationsh", "primvars:gs4d:rotation")[:, [3, 0, 1, 2]]
        rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
        clip = Clip(
            fps=stage.GetTimeCodesPerSecond(),
            frame_start=round(stage.GetStartTimeCode()),
            frame_end=round(stage.GetEndTimeCode()),
            scale=prim.GetAttribute("xformOp:scale").Get()[0],
            translation=tuple(prim.GetAttribute("xformOp:translate").Get()),
            pixel=float(prim.GetCustomDataByKey("timesplat:pixel") or 0),
        )
    except (TypeError, ValueError, IndexError, RuntimeError):
        raise InputError(f"{path}: orientations or xformOps are damaged; export it again.") from None
    asset = Asset(
        xyz=get("primvars:gs4d:position"),
        t=get("primvars:gs4d:mu_t"),
        velocity=get("primvars:gs4d:velocity"),
        sigma_t=get("primvars:gs4d:sigma_t"),
        scale=get("primvars:gs4d:scale"),
        rotation=rotation,
        rgb=rgb,
        opacity=get("primvars:gs4d:opacity"),
        clip=clip,
    )
    check(asset, path)
    return asset


# ---------------------------------------------------------------- checking


def check_usd(path: str | Path) -> list[str]:
    """Complaints about a USD file with splats, none if it is good: stage metadata, and for every splat prim
    at every time sample array lengths, the SH count, NaN, ranges, unit quaternions and the extent; then
    what UsdValidation has to say, where this pxr has it. Raises InputError if it cannot be opened."""
    path = Path(path)
    stage = _open(path)
    complaints = [f"the stage has no {k}" for k in ("upAxis", "metersPerUnit") if not stage.HasAuthoredMetadata(k)]
    if not stage.GetDefaultPrim():
        complaints.append("the stage has no defaultPrim")
    prims = [p for p in stage.TraverseAll() if p.GetTypeName() == SPLAT or p.HasAttribute("primvars:gs4d:mu_t")]
    if not prims:
        complaints.append(f"the stage has no {SPLAT} and no points with primvars:gs4d:*")
    for prim in prims:
        complaints += [f"{prim.GetPath()}: {c}" for c in _check_prim(prim)]
    return complaints + _validation(stage)


def _check_prim(prim) -> list[str]:
    base = "positions" if prim.GetTypeName() == SPLAT else "points"
    found: list[str] = []

    def samples(name: str):
        """(time code or None, array) of every sample."""
        attribute = prim.GetAttribute(name)
        for code in attribute.GetTimeSamples() or [None]:
            value = attribute.Get() if code is None else attribute.Get(code)
            yield code, np.zeros(0) if value is None else np.asarray(value)

    n = len(next(samples(base))[1])
    if n == 0:
        return [f"{base} is empty"]
    per_point = {base: 1, "points": 1, "widths": 1, "primvars:displayColor": 1, "primvars:displayOpacity": 1}
    if base == "positions":
        degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get()
        sh = {"radiance:sphericalHarmonicsCoefficients": (3 if degree is None else degree) + 1}
        for name, count in {"scales": 1, "orientations": 1, "opacities": 1, **{k: v**2 for k, v in sh.items()}}.items():
            kinds = [k for k in (name, f"{name}h") if prim.GetAttribute(k).HasAuthoredValue()]
            if len(kinds) != 1:
                found.append(f"{name} must be there once, as float or as half")
            per_point |= dict.fromkeys(kinds, count)
        if not prim.GetStage().HasAuthoredMetadata("fallbackPrimTypes"):
            found.append("the stage has no fallbackPrimTypes, so that older readers show nothing")
    per_point |= {a.GetName(): 1 for a in prim.GetAttributes() if a.GetName().startswith("primvars:gs4d:")}
    for name, count in per_point.items():
        for code, a in samples(name):
            where = name if code is None else f"{name} at {code:g}"
            if len(a) != n * count:
                found.append(f"{where} has {len(a)} values for {n} Gaussians, {n * count} belong there")
            elif not np.isfinite(a).all():
                found.append(f"{where} holds NaN or infinity")
            elif "pacit" in name and (a.min() < 0 or a.max() > 1):
                found.append(f"{where} leaves 0..1")
            elif ("scale" in name or "sigma" in name) and a.min() <= 0:
                found.append(f"{where} is not positive")
            elif ("orientation" in name or "rotation" in name) and (
                np.abs(np.linalg.norm(a.astype(np.float64), axis=1) - 1).max() > 2e-3  # half precision's
            ):
                found.append(f"{where} holds quaternions that are not of unit length")
    extent = prim.GetAttribute("extent").Get()
    if extent is None:
        return [*found, "extent is missing"]
    low, high = np.asarray(extent)
    opacity = next((k for k in ("primvars:displayOpacity", "opacities", "opacitiesh") if k in per_point), None)
    for code in prim.GetAttribute(opacity).GetTimeSamples() or [0]:
        o, p = (np.asarray(prim.GetAttribute(k).Get(code)) for k in (opacity, base))
        if not found and not ((p >= low) & (p <= high))[o > VISIBLE].all():
            found.append(f"visible Gaussians leave the extent at {code:g}")
    return found


def _validation(stage) -> list[str]:
    try:
        from pxr import UsdValidation
    except ImportError:
        return []
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    return [f"UsdValidation: {e.GetErrorAsString()}" for e in errors]
