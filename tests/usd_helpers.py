# SPDX-License-Identifier: GPL-3.0-or-later
"""USD files for tests, and Python in a process of its own."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr")
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from timesplat.model.io.usd_stage import SPLAT_TYPE, SPLATS_PATH


def run_child(code: str, *args, cwd=None) -> str:
    """Runs Python in a process of its own; returns what it printed after "RESULT"."""
    command = [sys.executable, "-c", code, *map(str, args)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=600, cwd=cwd)
    line = next((x for x in run.stdout.splitlines() if x.startswith("RESULT")), None)
    assert run.returncode == 0 and line, run.stdout + run.stderr
    return line.removeprefix("RESULT")


def open_splats(path):
    stage = Usd.Stage.Open(str(path))
    return stage, stage.GetPrimAtPath(SPLATS_PATH)


def write_foreign(path, *, frames=(None,), half=False, degree=1, **leave_out):
    """A splat file as another program might write it: three splats, SH of a degree, Y up, 10 cm to the unit."""
    h, r = "h" * half, np.random.default_rng(1)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdGeom.SetStageMetersPerUnit(stage, 0.1)
    prim = stage.DefinePrim("/scan", SPLAT_TYPE)
    three, four = (Vt.Vec3hArray, Vt.QuathArray) if half else (Vt.Vec3fArray, Vt.QuatfArray)
    kinds = Sdf.ValueTypeNames
    at = {f: r.uniform(-1, 1, (3, 3)).astype(np.float32) for f in frames}
    for frame, xyz in at.items():
        code = Usd.TimeCode.Default() if frame is None else frame
        prim.CreateAttribute("positions", kinds.Point3fArray).Set(Vt.Vec3fArray.FromNumpy(xyz), code)
    scale, sh = np.array([[1, 2, 3]] * 3) / 100, r.normal(0, 0.3, (3 * (degree + 1) ** 2, 3))
    dtype = np.float16 if half else np.float32
    values = {
        "scales": (kinds.Half3Array if half else kinds.Float3Array, three.FromNumpy(scale.astype(dtype))),
        "orientations": (
            kinds.QuathArray if half else kinds.QuatfArray,
            four.FromNumpy(np.tile([0, 0, 0, 2], (3, 1)).astype(dtype)),
        ),
        "opacities": (
            kinds.HalfArray if half else kinds.FloatArray,
            (Vt.HalfArray if half else Vt.FloatArray).FromNumpy(np.array([0.5, 0.75, 1], dtype)),
        ),
        "radiance:sphericalHarmonicsCoefficients": (
            kinds.Half3Array if half else kinds.Float3Array,
            three.FromNumpy(sh.astype(dtype)),
        ),
    }
    for name, (kind, value) in values.items():
        if name not in leave_out:
            prim.CreateAttribute(name + h, kind).Set(value)
    stage.Save()
    return at, sh


def make_original(folder: Path, *, up="Y", metres=0.01, rate=30.0) -> Path:
    """A textured cube in centimetres, Y up, at 30 frames a second, that moves from x = 0 to 23 cm in 23 frames."""
    from PIL import Image

    (folder / "textures").mkdir(exist_ok=True)
    Image.new("RGB", (4, 4), (255, 0, 0)).save(folder / "textures" / "red.png")
    path = folder / "scene.usda"
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.SetStageMetersPerUnit(stage, metres)
    stage.SetTimeCodesPerSecond(rate)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(23)
    root = UsdGeom.Xform.Define(stage, "/world")
    stage.SetDefaultPrim(root.GetPrim())
    root.AddTranslateOp().Set(Gf.Vec3d(0, 7, 0))
    mesh = UsdGeom.Mesh.Define(stage, "/world/mesh")
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    mesh.CreateExtentAttr([(0, 0, 0), (1, 1, 0)])
    mesh.CreateSubdivisionSchemeAttr("none")
    move = mesh.AddTranslateOp()
    for frame in (0, 23):
        move.Set(Gf.Vec3d(frame, 0, 0), frame)
    material = UsdShade.Material.Define(stage, "/world/red")
    surface = UsdShade.Shader.Define(stage, "/world/red/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    image = UsdShade.Shader.Define(stage, "/world/red/image")
    image.CreateIdAttr("UsdUVTexture")
    image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set("./textures/red.png")
    out = image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(out)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    stage.Save()
    return path
