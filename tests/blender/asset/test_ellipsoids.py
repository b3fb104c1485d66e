# SPDX-License-Identifier: GPL-3.0-or-later
"""The look Ellipsoids against numpy: one mesh of solids that lie on the ellipsoids of what is to be seen."""

import numpy as np
import pytest

from timesplat.model.io.asset import linear_from_srgb, rotation_matrices
from timesplat.model.io.ply import read_ply, write_ply

from ..helpers import make, make_tracked

SHOWN = """
display, sliders = part("addon.asset.display"), part("addon.asset.sliders")
asset = part("model.io.ply").read_ply(sys.argv[1])
bpy.ops.wm.read_factory_settings(use_empty=True)
ob = display.add_asset(asset, "a", look=sys.argv[2], cut=0.05)
sliders.set_input(sliders.asset_modifier(ob), "Point Size", 2.0)
scene, out = bpy.context.scene, {}
for frame in (10.0, 21.5, 33.0):
    scene.frame_set(int(frame), subframe=frame % 1)
    for i in bpy.context.evaluated_depsgraph_get().object_instances:
        if i.object.type != "MESH" or not len(i.object.data.polygons):
            continue
        mesh = i.object.data
        places = np.empty((len(mesh.vertices), 3), np.float32)
        mesh.vertices.foreach_get("co", places.ravel())
        colors = np.empty((len(places), 4), np.float32)
        mesh.attributes["gs_color"].data.foreach_get("color", colors.ravel())
        out[frame] = [places.tolist(), colors[:, :3].tolist()]
        told = [mesh.attributes.active_color_name, mesh.materials[0].name, len(mesh.polygons),
                [a.name for a in mesh.attributes if a.name.startswith(("gs_", "radius"))]]
tell(out=out, mesh=told, objects=[o.name for o in scene.objects])
"""


@pytest.mark.parametrize("tracked", [False, True])
def test_solids_lie_on_the_ellipsoids(blender, tmp_path, tracked):
    write_ply(tmp_path / "a.ply", make_tracked() if tracked else make())
    asset = read_ply(tmp_path / "a.ply")
    told = blender(SHOWN, tmp_path / "a.ply", "Ellipsoids")
    colour, material, faces, attributes = told["mesh"]
    assert colour == "gs_color" and material.endswith("Points") and set(attributes) <= {"gs_color", "radius"}
    assert told["objects"] == ["a"], "neither the solid nor the paths are in the scene"
    for frame, (places, colors) in told["out"].items():
        time = asset.frame_to_time(float(frame))
        position, opacity = asset.at(time)
        seen = opacity >= 0.05
        if tracked:
            seen &= asset.paths.there(time)[asset.path]
        solids = np.array(places).reshape(-1, 8, 3)
        assert 20 < len(solids) == seen.sum() < len(asset) and faces % 12 == 0
        sigma, R = asset.soft_scale()[seen], rotation_matrices(asset.rotation_at(time)[seen])
        local = np.einsum("nji,nvj->nvi", R, solids - position[seen, None]) / sigma[:, None]
        radius = 2 * np.sqrt(np.clip(1 - np.log(opacity[seen]) / np.log(0.05), 0, None))
        np.testing.assert_allclose(np.linalg.norm(local, axis=2), np.repeat(radius[:, None], 8, 1), atol=5e-3)
        shortest = np.take_along_axis(np.abs(local[:, 6:]), sigma.argmin(1)[:, None, None], 2)[..., 0]
        np.testing.assert_allclose(shortest, np.repeat(radius[:, None], 2, 1), atol=5e-3)
        expected = np.repeat(linear_from_srgb(asset.rgb)[seen], 8, 0)
        np.testing.assert_allclose(colors, expected, atol=1e-6)


def test_the_viewport_shows_solids_by_itself(blender, tmp_path):
    """bpy evaluates for the viewport, where the node Is Viewport is true."""
    write_ply(tmp_path / "a.ply", make())
    assert len(blender(SHOWN, tmp_path / "a.ply", "Automatic")["out"]) == 3
