# SPDX-License-Identifier: GPL-3.0-or-later
"""The object that was reconstructed, as the other variant of an asset's USD file."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

from ...datagen.sequence import InputError
from .usd_stage import ORIGINAL, ROOT_PATH, VARIANT_SET, import_pxr, metres_per_unit, open_stage

PACKAGED = (".usd", ".usda", ".usdc", ".png", ".jpg", ".jpeg", ".exr", ".avif", ".m4a", ".mp3", ".wav")  # in a .usdz


def add_original(layer, original: Path, shift: float, path: Path, folder: Path) -> None:
    """Puts the USD file `original` into the variant ORIGINAL of a layer that will be written to `path`, turned and
    scaled to Z-up metres and with its time codes later by `shift` (a reference alone would also convert them from its
    frame rate to ours). `folder` is a temporary one, there until `path` is written. Raises InputError."""
    pxr = import_pxr()
    source = open_stage(original)
    if path.exists() and path.samefile(original):
        raise InputError(f"{path}: it is the original itself; write to another file.")
    prim = source.GetDefaultPrim()
    roots = [p for p in source.GetPseudoRoot().GetChildren() if p.IsDefined() and not p.IsAbstract()]
    if not prim and len(roots) != 1:
        raise InputError(f"{original}: it has no default prim to refer to; set its defaultPrim.")
    root = pxr.Sdf.Path() if prim else roots[0].GetPath()
    metres = metres_per_unit(source, original)
    where = _to_package(original, folder) if path.suffix.lower() == ".usdz" else _relative(original, path)

    parent = pxr.Sdf.CreatePrimInLayer(layer, f"{ROOT_PATH}{{{VARIANT_SET}={ORIGINAL}}}original")
    parent.specifier, parent.typeName = pxr.Sdf.SpecifierDef, "Xform"
    _turn_and_scale(parent, metres, pxr.UsdGeom.GetStageUpAxis(source) == "Y")
    child = pxr.Sdf.PrimSpec(parent, "object", pxr.Sdf.SpecifierDef)  # its own transform stays its own
    child.kind = "subcomponent"
    rate = source.GetTimeCodesPerSecond() / layer.timeCodesPerSecond
    child.referenceList.prependedItems.append(pxr.Sdf.Reference(where, root, pxr.Sdf.LayerOffset(shift, rate)))


def _turn_and_scale(prim, metres: float, y_up: bool) -> None:
    """Gives the prim spec the transform from its unit and up axis to Z-up metres."""
    pxr = import_pxr()
    types, order = pxr.Sdf.ValueTypeNames, []

    def op(name: str, kind, value) -> None:
        pxr.Sdf.AttributeSpec(prim, f"xformOp:{name}", kind).default = value
        order.append(f"xformOp:{name}")

    if metres != 1:
        op("scale", types.Double3, pxr.Gf.Vec3d(metres))
    if y_up:
        op("rotateX", types.Double, 90.0)
    attribute = pxr.Sdf.AttributeSpec(prim, "xformOpOrder", types.TokenArray, pxr.Sdf.VariabilityUniform)
    attribute.default = pxr.Vt.TokenArray(order)


def _to_package(original: Path, folder: Path) -> str:
    """Where a .usdz that takes in the original finds it. Raises InputError where it needs what cannot come along."""
    if original.suffix.lower() == ".usdz":
        original = _unpacked(original, folder)
    home = original.parent.resolve()
    pxr = import_pxr()
    layers, files, missing = pxr.UsdUtils.ComputeAllDependencies(pxr.Sdf.AssetPath(str(original)))
    if missing:
        raise InputError(f"{original}: it refers to {missing[0]}, which is not there; find it or write a .usdc.")
    for name in [x.realPath for x in layers] + list(files):
        if not Path(name).resolve().is_relative_to(home):
            raise InputError(f"{original}: it refers to {name}, outside of its own folder; copy that beside it.")
        if not name.lower().endswith(PACKAGED):
            raise InputError(f"{original}: it refers to {name}, which has no place in a .usdz; write a .usdc.")
    return original.resolve().as_posix()


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
