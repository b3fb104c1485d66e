# SPDX-License-Identifier: GPL-3.0-or-later
"""An asset follows what it was made from."""

import pytest

from timesplat.model.io.ply import write_ply

from ..helpers import make
from .evaluated import READ

FOLLOW = """
display, parenting = part("addon.asset.display"), part("addon.asset.parenting")
asset = part("model.io.ply").read_ply(sys.argv[1])
bpy.ops.wm.read_factory_settings(use_empty=True)
scene, told = bpy.context.scene, {}
def made(name, parent=None):
    ob = bpy.data.objects.new(name, bpy.data.meshes.new(name))
    scene.collection.objects.link(ob)
    ob.parent = parent
    return ob
original, above = made("original"), made("above")
original.parent, original.location, original.scale = above, (1, 2, 3), (2,) * 3
above.location, above.rotation_euler = (0, 0, 5), (0.3, 0.2, 0.1)
ob = display.add_asset(asset, "a", look="Points")
before = shown(ob, "position")["world"]
told["did"] = parenting.follow(ob, original)
scene.frame_set(20)
scene.frame_set(1)
told["stays"] = np.abs(np.array(before) - shown(ob, "position")["world"]).max().item()
original.location.x += 10
bpy.context.view_layer.update()
told["axis"] = [10 * x for x in above.matrix_world.col[0][:3]]
told["moves"] = (np.array(shown(ob, "position")["world"]) - before).mean(0).tolist()
keyed, held, child, bone = made("keyed"), made("held"), made("child"), made("bone")
keyed.keyframe_insert("rotation_euler", frame=1)
held.constraints.new("COPY_LOCATION")
child.parent = keyed
driven, shape = made("driven"), made("shape")
driven.driver_add("location", 0)
shape.keyframe_insert("hide_render", frame=1)
told["refused"] = [parenting.follow(ob, x) for x in (keyed, held, child, driven, ob)]
told["shape"] = parenting.follow(ob, shape)
tell(**told)
"""


def test_it_follows_an_original_that_stands_still_by_itself(blender, tmp_path):
    write_ply(tmp_path / "a.ply", make())
    told = blender(READ + FOLLOW, tmp_path / "a.ply")
    assert told["did"] and told["shape"] and told["refused"] == [False] * 5
    assert told["stays"] < 1e-5 and told["moves"] == pytest.approx(told["axis"], abs=1e-4)
