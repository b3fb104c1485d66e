# SPDX-License-Identifier: GPL-3.0-or-later
import bpy
import pytest

from timesplat.datagen.scene.left_out import left_out
from timesplat.datagen.scene.open import empty_session, open_asset

from ..helpers import cube


def driven(expression):
    empty_session()
    driver = cube().driver_add("location", 2).driver
    driver.type, driver.expression = "SCRIPTED", expression


def test_a_script_in_a_driver_is_said_and_does_not_run(tmp_path):
    driven(f"len(open({str(tmp_path / 'ran')!r}, 'w').name)")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    (tmp_path / "ran").unlink(missing_ok=True)  # an own file's drivers run
    asset = open_asset(tmp_path / "a.blend")
    bpy.context.scene.frame_set(5)
    assert not (tmp_path / "ran").exists()
    (warning,) = asset.warnings
    assert "scripted drivers of Cube" in warning and warning.endswith(".") and ";" in warning


def test_a_formula_is_no_script(tmp_path):
    driven("sin(frame / 6)")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    assert open_asset(tmp_path / "a.blend").warnings == []


def linking(tmp_path, library):
    """A .blend in in/ that links a cube out of another, and has a cube of its own."""
    empty_session()
    cube("linked")
    library.parent.mkdir(exist_ok=True)
    bpy.data.libraries.write(str(library), {bpy.data.objects["linked"]}, fake_user=True)
    empty_session()
    cube("own")
    with bpy.data.libraries.load(str(library), link=True) as (_, wanted):
        wanted.objects = ["linked"]
    bpy.context.collection.objects.link(wanted.objects[0])
    (tmp_path / "in").mkdir(exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "in" / "a.blend"))
    return tmp_path / "in" / "a.blend"


def test_a_linked_library(tmp_path):
    library = tmp_path / "in" / "parts.blend"
    path = linking(tmp_path, library)
    assert open_asset(path).warnings == [] and len(bpy.data.objects["linked"].data.polygons) == 6
    library.unlink()
    (warning,) = open_asset(path).warnings
    assert "parts.blend is missing" in warning and warning.endswith(".")


@pytest.mark.parametrize("root", [False, True])
def test_a_library_outside_of_the_root_is_taken_out(tmp_path, root):
    path = linking(tmp_path, tmp_path / "parts.blend")
    warnings = open_asset(path, tmp_path if root else None).warnings
    assert ("linked" in bpy.data.objects) == root == (not warnings)
    assert root or "outside" in warnings[0]


def test_an_empty_session_left_nothing_out(tmp_path):
    empty_session()
    assert left_out(tmp_path / "a.blend", tmp_path) == []
