# SPDX-License-Identifier: GPL-3.0-or-later
"""A 4D Gaussian asset as USD: one prim that is a Gaussian splat to new readers and points to old ones.

The prim is a `ParticleField3DGaussianSplat` (OpenUSD 26.03). It also carries `points`, `widths`,
`primvars:displayColor` and `displayOpacity`, and the stage says in `fallbackPrimTypes` that a reader which
does not know the type shall take it as `Points`. Attributes are authored raw, so that an older pxr (the
one inside Blender) writes the same file. `primvars:gs4d:*` keep the 4D parameters, from which `read_usd`
gives the Asset back, and `gs4d:time` is the time they are in: -1 at the clip's first frame, 1 at its last, so
that a layer offset moves it with the samples. Needs numpy and pxr (usd-core). docs/pipelines.md is for those
who read the files.

What is sampled over time (see usd_samples.py)
    positions   two samples where that says it all; one a frame where there are paths, in mode frames, and, with
                |t - μ_t| held within HOLD_SIGMAS·σ_t, where a short-lived Gaussian's line would leave the box long
                after it has faded.
    orientations  one a frame where a path turns
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
import re
import shutil
import tempfile
from pathlib import Path

import numpy as np

from ...datagen.sequence import InputError
from .asset import SH_C0, Asset, Clip, check, linear_from_srgb, xyzw_from_wxyz
from .atomic import atomic_write
from .paths import Paths
from .usd_original import add_original
from .usd_samples import extent_of, orientations, positions, widths
from .usd_stage import (
    ORIGINAL,
    RECONSTRUCTION,
    ROOT_PATH,
    SH_COEFFICIENTS,
    SPLAT_TYPE,
    SPLATS_PATH,
    USD_SUFFIXES,
    VARIANT_SET,
    import_pxr,
    quiet,
    reading,
)

MODES = ("splats", "points", "frames")
HALF_TINY, HALF_MAX = 2.0**-14, 65504.0


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
    if path.suffix.lower() not in USD_SUFFIXES:
        raise InputError(f"{path}: the name must end in {', '.join(USD_SUFFIXES)}; choose one of these.")
    if mode not in MODES:
        raise InputError(f"{mode}: no such mode; choose one of {', '.join(MODES)}.")
    check(asset, path)
    if original_start is not None and not np.isfinite(original_start):
        raise InputError(f"{original_start}: the frame at which the original starts must be a number; give one.")
    if motion is not None and not (motion.shape == (len(asset.clip.frames), 4, 4) and np.isfinite(motion).all()):
        raise InputError(f"{path}: its motion is not a finite matrix for each frame of the clip; export it again.")
    pxr = import_pxr()
    stage = _stage(asset, mode, half, path, motion, variants=original is not None)
    with atomic_write(path) as tmp, tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, quiet():
        package = Path(folder) / "package.usdz" if path.suffix.lower() == ".usdz" else None
        inner = Path(folder) / "splats.usdc" if package else tmp
        if original is not None:
            shift = 0 if original_start is None else asset.clip.frame_start - original_start
            with reading(Path(original)):
                add_original(stage.GetRootLayer(), Path(original), shift, path, Path(folder))
        try:
            ok = stage.GetRootLayer().Export(str(inner))
            if package:
                ok = ok and pxr.UsdUtils.CreateNewUsdzPackage(pxr.Sdf.AssetPath(str(inner)), str(package))
                shutil.copyfile(package, tmp)
        except RuntimeError as e:  # Tf.ErrorException is one, and is many lines long; the first says it
            said = re.search(r" : '(.+)'$", str(e), re.MULTILINE)
            raise OSError(said[1] if said else "the USD library stopped") from None
        if not ok:
            raise OSError("the USD library refused")
    if old := pxr.Sdf.Layer.Find(str(path)):  # open in this process: it would go on showing the former file
        old.Reload(force=True)


def _stage(asset: Asset, mode: str, half: bool, path: Path, motion: np.ndarray | None, variants: bool):
    """The whole file as a Usd.Stage in memory; the variant for the original, if there are `variants`, is empty."""
    pxr = import_pxr()
    places, extent = positions(asset, mode == "frames", path), extent_of(asset)
    stage = pxr.Usd.Stage.CreateInMemory()
    root = stage.DefinePrim(ROOT_PATH, "Xform")
    stage.SetDefaultPrim(root)
    pxr.Usd.ModelAPI(root).SetKind("component")
    root.AddAppliedSchema("GeomModelAPI")
    _set_metadata(stage, asset.clip)
    if mode != "points":
        stage.SetMetadata("fallbackPrimTypes", {SPLAT_TYPE: pxr.Vt.TokenArray(["Points"])})
    with contextlib.ExitStack() as stack:
        if variants:
            choice = root.GetVariantSets().AddVariantSet(VARIANT_SET)
            for name in (RECONSTRUCTION, ORIGINAL):
                choice.AddVariant(name)
            choice.SetVariantSelection(RECONSTRUCTION)
            stack.enter_context(choice.GetVariantEditContext())
        hint = pxr.Vt.Vec3fArray.FromNumpy(_extents_hint(extent, asset.clip, motion))
        root.CreateAttribute("extentsHint", pxr.Sdf.ValueTypeNames.Float3Array, False).Set(hint)
        _author(stage, asset, mode, half, places, extent, motion)
    return stage


def _set_metadata(stage, clip: Clip) -> None:
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


def _author(
    stage, asset: Asset, mode: str, half: bool, places: dict, extent: np.ndarray, motion: np.ndarray | None
) -> None:
    """The prim of the Gaussians; places as of `positions`, extent (2,3)."""
    prim = _Prim(stage.DefinePrim(SPLATS_PATH, "Points" if mode == "points" else SPLAT_TYPE), half)
    types = prim.types
    _author_transform(prim, asset.clip, motion)
    points = _changing(prim.float3, places)
    curve = {float(f): asset.at(asset.frame_to_time(f))[1] for f in asset.clip.frames}
    opacities = _changing(prim.float1, {code: np.round(o * 1000) / 1000 for code, o in curve.items()})

    prim.put("points", types.Point3fArray, points)
    prim.put("widths", types.FloatArray, _changing(prim.float1, widths(asset, curve)))
    prim.put("primvars:displayColor", types.Color3fArray, prim.float3(linear_from_srgb(asset.rgb)))
    prim.put("primvars:displayOpacity", types.FloatArray, opacities)
    prim.put("extent", types.Float3Array, prim.float3(extent))
    prim.prim.SetCustomDataByKey("timesplat:pixel", float(asset.clip.pixel))
    prim.put_vectors("primvars:gs4d:scale", prim.not_tiny(asset.scale))  # stored once where both are the same
    if mode == "points" or asset.paths is not None:
        prim.put_quaternions("primvars:gs4d:rotation", asset.rotation)
    if mode == "points":
        prim.put_vectors("primvars:gs4d:rgb", asset.rgb)
    else:
        prim.put("positions", types.Point3fArray, points)
        prim.put_vectors(f"scales{prim.suffix}", prim.not_tiny(asset.soft_scale()))
        prim.put_quaternions(f"orientations{prim.suffix}", orientations(asset, places))
        prim.put("opacities", types.FloatArray, opacities)  # stored once, with displayOpacity
        prim.put("radiance:sphericalHarmonicsDegree", types.Int, 0, uniform=True)
        prim.put_vectors(f"{SH_COEFFICIENTS}{prim.suffix}", (asset.rgb - 0.5) / SH_C0)
    _author_parameters(prim, asset)


def _author_transform(prim: _Prim, clip: Clip, motion: np.ndarray | None) -> None:
    pxr, types = import_pxr(), prim.types
    prim.put("xformOp:translate", types.Double3, pxr.Gf.Vec3d(*map(float, clip.translation)))
    prim.put("xformOp:scale", types.Double3, pxr.Gf.Vec3d(float(clip.scale)))
    order = ["xformOp:translate", "xformOp:scale"]
    if motion is not None:  # outermost; USD's matrices are for row vectors
        samples = {float(f): pxr.Gf.Matrix4d(m.T) for f, m in zip(clip.frames, motion, strict=True)}
        prim.put("xformOp:transform", types.Matrix4d, samples)
        order.insert(0, "xformOp:transform")
    prim.put("xformOpOrder", types.TokenArray, pxr.Vt.TokenArray(order), uniform=True)


def _author_parameters(prim: _Prim, asset: Asset) -> None:
    """What `read_usd` gives the Asset back from, but for scale, rotation and colour."""
    velocity = asset.velocity if asset.paths is None else asset.path_velocity()
    velocity = np.clip(velocity, -HALF_MAX, HALF_MAX) if prim.half else velocity
    prim.put("primvars:gs4d:position", prim.types.Float3Array, prim.float3(asset.xyz))
    prim.put_vectors("primvars:gs4d:velocity", velocity)
    prim.put_numbers("primvars:gs4d:mu_t", asset.t)
    prim.put_numbers("primvars:gs4d:sigma_t", prim.not_tiny(asset.sigma_t))
    prim.put_numbers("primvars:gs4d:opacity", asset.opacity)
    if asset.paths is not None:
        _author_paths(prim, *asset.riding())
    ends = (asset.clip.frame_start, asset.clip.frame_end)
    prim.put("gs4d:time", prim.types.Double, {float(f): float(asset.frame_to_time(f)) for f in ends})


def _author_paths(prim: _Prim, paths: Paths, path: np.ndarray) -> None:
    """Arrays of paths and knots are no primvars: those have a value for each point."""
    prim.put("primvars:gs4d:path", prim.types.IntArray, prim.int1(path))
    prim.put("gs4d:paths:start", prim.types.FloatArray, prim.float1(paths.start))
    prim.put("gs4d:paths:end", prim.types.FloatArray, prim.float1(paths.end))
    prim.put("gs4d:paths:knots", prim.types.IntArray, prim.int1(paths.count))
    prim.put("gs4d:paths:place", prim.types.Float3Array, prim.float3(paths.place))
    prim.put_quaternions("gs4d:paths:rotation", paths.rotation)


class _Prim:
    """Authors attributes of a prim raw, so that every pxr writes the same; arrays in full or half precision."""

    def __init__(self, prim, half: bool):
        pxr = import_pxr()
        types, Vt = pxr.Sdf.ValueTypeNames, pxr.Vt
        self.prim, self.half, self.types, self.Vt = prim, half, types, Vt
        self.suffix = "h" if half else ""  # of the schema's attributes
        self.dtype = np.float16 if half else np.float32
        self.variability = {True: pxr.Sdf.VariabilityUniform, False: pxr.Sdf.VariabilityVarying}
        self.numbers = (types.HalfArray, Vt.HalfArray) if half else (types.FloatArray, Vt.FloatArray)
        self.vectors = (types.Half3Array, Vt.Vec3hArray) if half else (types.Float3Array, Vt.Vec3fArray)
        self.quaternions = (types.QuathArray, Vt.QuathArray) if half else (types.QuatfArray, Vt.QuatfArray)

    def put(self, name: str, kind, value, *, uniform: bool = False) -> None:
        """value: one value, or {time code: value}."""
        attribute = self.prim.CreateAttribute(name, kind, False, self.variability[uniform])
        if name == "widths" or name.startswith("primvars:"):
            attribute.SetMetadata("interpolation", "vertex")
        if isinstance(value, dict):
            for code, v in value.items():
                attribute.Set(v, code)
        else:
            attribute.Set(value)

    def put_numbers(self, name: str, a: np.ndarray) -> None:
        self._put_array(name, self.numbers, a)

    def put_vectors(self, name: str, a: np.ndarray) -> None:
        self._put_array(name, self.vectors, a)

    def put_quaternions(self, name: str, q: np.ndarray | dict[float, np.ndarray]) -> None:
        """q (N,4) w x y z, or {time code: such}."""
        kind, array = self.quaternions

        def to(q: np.ndarray):
            return array.FromNumpy(np.ascontiguousarray(xyzw_from_wxyz(q), self.dtype))  # as it takes them

        self.put(name, kind, _changing(to, q) if isinstance(q, dict) else to(q))

    def _put_array(self, name: str, kind_and_array: tuple, a: np.ndarray) -> None:
        kind, array = kind_and_array
        self.put(name, kind, array.FromNumpy(np.ascontiguousarray(a, self.dtype)))

    def int1(self, a: np.ndarray):
        return self.Vt.IntArray.FromNumpy(np.ascontiguousarray(a, np.int32))

    def float1(self, a: np.ndarray):
        return self.Vt.FloatArray.FromNumpy(np.ascontiguousarray(a, np.float32))

    def float3(self, a: np.ndarray):
        return self.Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(a, np.float32))

    def not_tiny(self, a: np.ndarray) -> np.ndarray:
        """Positive values within the range of half floats, where those are written."""
        return np.clip(a, HALF_TINY, HALF_MAX) if self.half else a


def _changing(to, samples: dict[float, np.ndarray]):
    """The samples through `to`; one plain value where all of them are the same."""
    first, *rest = samples.values()
    if all(np.array_equal(first, r) for r in rest):
        return to(first)
    return {code: to(a) for code, a in samples.items()}


def _extents_hint(extent: np.ndarray, clip: Clip, motion: np.ndarray | None) -> np.ndarray:
    """(2,3) float32 bounds in the world: of the extent where the clip places it, or wherever its corners go."""
    hint = extent * clip.scale + clip.translation
    if motion is not None:
        corners = np.stack(np.meshgrid(*hint.T, [1.0]), -1).reshape(-1, 4)
        everywhere = (corners @ motion.transpose(0, 2, 1))[..., :3].reshape(-1, 3)
        hint = np.stack([everywhere.min(0), everywhere.max(0)])
    return hint.astype(np.float32)
