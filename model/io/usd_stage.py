# SPDX-License-Identifier: GPL-3.0-or-later
"""What reading, writing and checking USD have in common: the names in our files, and stages opened with care.
pxr is imported when one is, not before."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np

from ...datagen.sequence import InputError

USD_SUFFIXES = (".usd", ".usdc", ".usda", ".usdz")

ROOT_PATH = "/timesplat"
SPLATS_PATH = f"{ROOT_PATH}/splats"
SPLAT_TYPE = "ParticleField3DGaussianSplat"
SH_COEFFICIENTS = "radiance:sphericalHarmonicsCoefficients"
DISPLAY_COLOUR = "primvars:displayColor"
VARIANT_SET = "representation"  # of files that hold the original object too
RECONSTRUCTION, ORIGINAL = "reconstruction", "original"  # its variants


def import_pxr() -> ModuleType:
    """pxr with Gf, Sdf, Usd, UsdGeom, UsdUtils and Vt. Raises InputError where there is no USD library."""
    try:
        import pxr
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdUtils, Vt  # noqa: F401
    except ImportError:
        raise InputError(f"{sys.executable} lacks usd-core, which USD files need; install timesplat[usd].") from None
    return pxr


@contextmanager
def quiet() -> Iterator[None]:
    """Keeps USD's warnings, some lines each, off standard error; errors are raised all the same."""
    delegate = import_pxr().UsdUtils.CoalescingDiagnosticDelegate()
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
    return import_pxr().Usd.Stage.Open(str(path))


def select(stage, variant: str) -> bool:
    """Selects `variant` of every VARIANT_SET that has it, for this opened stage alone; False if none has."""
    sets = [p.GetVariantSets().GetVariantSet(VARIANT_SET) for p in stage.TraverseAll() if p.HasVariantSets()]
    sets = [s for s in sets if variant in s.GetVariantNames()]
    with import_pxr().Usd.EditContext(stage, stage.GetSessionLayer()):
        for s in sets:
            s.SetVariantSelection(variant)
    return bool(sets)


def metres_per_unit(stage, path: Path) -> float:
    """Raises InputError where it is no positive number."""
    metres = import_pxr().UsdGeom.GetStageMetersPerUnit(stage)
    if not (np.isfinite(metres) and metres > 0):
        raise InputError(f"{path}: its metersPerUnit is {metres:g}; set it to a positive number.")
    return metres


def all_prims(stage):
    """Every prim of the stage, those inside of instances too."""
    return stage.Traverse(import_pxr().Usd.TraverseInstanceProxies())
