# SPDX-License-Identifier: GPL-3.0-or-later
"""What is wrong with a USD file with splats: checks of our own, and OpenUSD's."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from .asset import VISIBLE
from .usd_stage import (
    ORIGINAL,
    RECONSTRUCTION,
    SH_COEFFICIENTS,
    SPLAT_TYPE,
    all_prims,
    open_stage,
    reading,
    select,
)


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
    found = [p for p in all_prims(stage) if p.GetTypeName() == SPLAT_TYPE or p.HasAttribute("primvars:gs4d:mu_t")]
    if not found:
        complaints.append(f"the stage has no {SPLAT_TYPE} and no points with primvars:gs4d:*")
    for prim in found:
        complaints += [f"{prim.GetPath()}: {c}" for c in _check_prim(prim)]
    complaints += _validation(stage)
    if select(stage, ORIGINAL):
        if not any(p.GetTypeName() and p.GetTypeName() != "Xform" for p in all_prims(stage)):
            complaints.append("the variant original is empty")
        complaints += [f"variant original: {c}" for c in _validation(stage)]
    return complaints


def _check_prim(prim) -> list[str]:
    base = "positions" if prim.GetTypeName() == SPLAT_TYPE else "points"
    count = len(next(_samples(prim, base))[1])
    if count == 0:
        return [f"{base} is empty"]
    per_point = {base: 1, "points": 1, "widths": 1, "primvars:displayColor": 1, "primvars:displayOpacity": 1}
    found = []
    if base == "positions":
        degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get()
        sh = {SH_COEFFICIENTS: ((3 if degree is None else degree) + 1) ** 2}
        for name, each in {"scales": 1, "orientations": 1, "opacities": 1, **sh}.items():
            kinds = [k for k in (name, f"{name}h") if prim.GetAttribute(k).HasAuthoredValue()]
            if len(kinds) != 1:
                found.append(f"{name} must be there once, as float or as half")
            per_point |= dict.fromkeys(kinds, each)
        if not prim.GetStage().HasAuthoredMetadata("fallbackPrimTypes"):
            found.append("the stage has no fallbackPrimTypes, so that older readers show nothing")
    per_point |= {a.GetName(): 1 for a in prim.GetAttributes() if a.GetName().startswith("primvars:gs4d:")}
    for name, each in per_point.items():
        found += _check_array(prim, name, count, each)
    if found:
        return found
    return _check_twins(prim, set(per_point)) + _check_extent(prim, base, set(per_point))


def _samples(prim, name: str) -> Iterator[tuple[float | None, np.ndarray]]:
    """(time code or None, array) of every sample of an attribute."""
    attribute = prim.GetAttribute(name)
    for code in attribute.GetTimeSamples() or [None]:
        value = attribute.Get() if code is None else attribute.Get(code)
        yield code, np.zeros(0) if value is None else np.asarray(value)


def _check_array(prim, name: str, count: int, each: int) -> list[str]:
    """What is wrong with the samples of an attribute that has `each` values for each of `count` Gaussians."""
    found = []
    for code, a in _samples(prim, name):
        where = name if code is None else f"{name} at {code:g}"
        if len(a) != count * each:
            found.append(f"{where} has {len(a)} values for {count} Gaussians, {count * each} belong there")
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
    return found


def _check_twins(prim, names: set[str]) -> list[str]:
    """Whether readers of points see what readers of splats see."""
    found = []
    for one, other in (("positions", "points"), ("opacities", "primvars:displayOpacity")):
        if {one, other} <= names:
            pairs = zip(_samples(prim, one), _samples(prim, other), strict=False)
            same = len(prim.GetAttribute(one).GetTimeSamples()) == len(prim.GetAttribute(other).GetTimeSamples())
            if not same or any(c != d or not np.array_equal(a, b) for (c, a), (d, b) in pairs):
                found.append(f"{one} and {other} differ, so that readers of points see something else")
    return found


def _check_extent(prim, base: str, names: set[str]) -> list[str]:
    extent = prim.GetAttribute("extent").Get()
    if extent is None:
        return ["extent is missing"]
    found = []
    low, high = np.asarray(extent)
    opacity = next((k for k in ("primvars:displayOpacity", "opacities", "opacitiesh") if k in names), None)
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
