# SPDX-License-Identifier: GPL-3.0-or-later
"""What is wrong with a USD file with splats: checks of our own, and OpenUSD's."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .asset import VISIBLE
from .usd_read import ORIGINAL, RECONSTRUCTION, SH, SPLAT, open_stage, prims, reading, select


def check_usd(path: str | Path) -> list[str]:
    """Complaints about a USD file with splats or a stage that references some, none if it is good: stage metadata;
    for every splat prim at every time sample array lengths, the SH count, NaN, ranges, unit quaternions, the extent
    and that readers of points see the same; then what UsdValidation has to say, where this pxr has it, also with
    the variant `original` selected. Raises InputError if the file cannot be opened."""
    path = Path(path)
    with reading(path):
        return _check(path)


def _check(path: Path) -> list[str]:
    stage = open_stage(path)
    select(stage, RECONSTRUCTION)
    complaints = [f"the stage has no {k}" for k in ("upAxis", "metersPerUnit") if not stage.HasAuthoredMetadata(k)]
    if not stage.GetDefaultPrim():
        complaints.append("the stage has no defaultPrim")
    found = [p for p in prims(stage) if p.GetTypeName() == SPLAT or p.HasAttribute("primvars:gs4d:mu_t")]
    if not found:
        complaints.append(f"the stage has no {SPLAT} and no points with primvars:gs4d:*")
    for prim in found:
        complaints += [f"{prim.GetPath()}: {c}" for c in _check_prim(prim)]
    complaints += _validation(stage)
    if select(stage, ORIGINAL):
        if not any(p.GetTypeName() and p.GetTypeName() != "Xform" for p in prims(stage)):
            complaints.append("the variant original is empty")
        complaints += [f"variant original: {c}" for c in _validation(stage)]
    return complaints


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
        sh = {SH: ((3 if degree is None else degree) + 1) ** 2}
        for name, count in {"scales": 1, "orientations": 1, "opacities": 1, **sh}.items():
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
    if found:
        return found
    for one, other in (("positions", "points"), ("opacities", "primvars:displayOpacity")):
        if {one, other} <= set(per_point):
            pairs = zip(samples(one), samples(other), strict=False)
            same = len(prim.GetAttribute(one).GetTimeSamples()) == len(prim.GetAttribute(other).GetTimeSamples())
            if not same or any(c != d or not np.array_equal(a, b) for (c, a), (d, b) in pairs):
                found.append(f"{one} and {other} differ, so that readers of points see something else")
    extent = prim.GetAttribute("extent").Get()
    if extent is None:
        return [*found, "extent is missing"]
    low, high = np.asarray(extent)
    opacity = next((k for k in ("primvars:displayOpacity", "opacities", "opacitiesh") if k in per_point), None)
    for code in prim.GetAttribute(opacity).GetTimeSamples() or [0]:
        o, p = (np.asarray(prim.GetAttribute(k).Get(code)) for k in (opacity, base))
        if not ((p >= low) & (p <= high))[o > VISIBLE].all():
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
