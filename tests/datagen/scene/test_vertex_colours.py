# SPDX-License-Identifier: GPL-3.0-or-later
import bpy
import numpy as np
import pytest

from timesplat.datagen.rigs import canonical
from timesplat.datagen.scene.open import empty_session, open_asset

from ..helpers import cube
from ..test_capture import CaptureSettings, Normalisation, Subject, capture


def coloured(path, *, base=None, colour=(1.0, 0.0, 0.0, 1.0)):
    """A file of a cube with one colour at all corners, and a material of the base colour if one is given."""
    empty_session()
    ob = cube()
    attribute = ob.data.color_attributes.new("Col", "FLOAT_COLOR", "POINT" if path.suffix == ".obj" else "CORNER")
    for item in attribute.data:
        item.color = colour
    if base:
        material = bpy.data.materials.new("m")
        material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = base
        ob.data.materials.append(material)
    if path.suffix == ".obj":
        bpy.ops.wm.obj_export(filepath=str(path), export_colors=True)
    elif path.suffix == ".fbx":
        bpy.ops.export_scene.fbx(filepath=str(path))
    else:
        bpy.ops.wm.usd_export(filepath=str(path))
    return path


def colour_seen(path, tmp_path):
    """The mean colour of the front's pixels, 0..1."""
    asset = open_asset(path)
    assert not asset.warnings
    settings = CaptureSettings(size=16, samples=4, passes=False, tracks=None)
    seq = capture(canonical([0])[:1], tmp_path / "seq", Subject([1], Normalisation(1.6)), settings)
    rgba = seq.load_image(0) / 255
    return rgba[rgba[..., 3] == 1][:, :3].mean(0)


@pytest.mark.parametrize("suffix", ["obj", "fbx", "usdc"])
@pytest.mark.parametrize("base", [None, (0.8, 0.8, 0.8, 1)])
def test_colours_show(tmp_path, suffix, base):
    red, green, blue = colour_seen(coloured(tmp_path / f"a.{suffix}", base=base), tmp_path)
    assert red > 0.5 and max(green, blue) < 0.4


@pytest.mark.parametrize("suffix", ["obj", "fbx", "usdc"])
def test_a_colour_of_the_material_is_meant(tmp_path, suffix):
    red, green, blue = colour_seen(coloured(tmp_path / f"a.{suffix}", base=(0, 0, 1, 1)), tmp_path)
    assert blue > 0.5 and max(red, green) < 0.4


def test_white_says_nothing(tmp_path):
    open_asset(coloured(tmp_path / "a.fbx", colour=(1, 1, 1, 1), base=(0.5, 0.5, 0.5, 1)))
    assert not any(n.type == "VERTEX_COLOR" for m in bpy.data.materials for n in m.node_tree.nodes)


def test_one_colour_for_all_of_a_usd(tmp_path):
    """displayColor, as an object without a material has it in USD."""
    (tmp_path / "a.usda").write_text(
        '#usda 1.0\n(metersPerUnit = 1\nupAxis = "Z")\ndef Mesh "m" {\n int[] faceVertexCounts = [4]\n'
        " int[] faceVertexIndices = [0, 1, 2, 3]\n"
        " point3f[] points = [(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)]\n"
        ' color3f[] primvars:displayColor = [(0, 1, 0)] (interpolation = "constant")\n}\n'
    )
    red, green, blue = colour_seen(tmp_path / "a.usda", tmp_path)
    assert green > 0.5 and max(red, blue) < 0.4


def test_two_objects_of_one_mesh_share_the_material(tmp_path):
    empty_session()
    path = coloured(tmp_path / "a.obj")
    open_asset(path)
    (material,) = {slot.material for ob in bpy.data.objects for slot in ob.material_slots}
    assert np.isclose(bpy.data.objects[0].data.color_attributes[0].data[0].color[0], 1) and material.users
