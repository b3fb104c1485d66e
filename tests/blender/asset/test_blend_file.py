# SPDX-License-Identifier: GPL-3.0-or-later
"""A .blend with an asset, rendered: its splats against a small ray tracer."""

import numpy as np
import pytest

from timesplat.datagen.rigs import spherical
from timesplat.datagen.sequence import focal_from_fov, opengl_to_opencv
from timesplat.model.io.asset import linear_from_srgb, rotation_matrices
from timesplat.model.io.ply import write_ply

from ..helpers import make

RENDER = """
from timesplat.addon.asset import blend_file, sliders
blend_file.save_blend(sys.argv[1], sys.argv[2])
bpy.ops.wm.open_mainfile(filepath=sys.argv[2])
scene = bpy.context.scene
ob = next(o for o in bpy.data.objects if o.get("timesplat"))
sliders.set_input(ob.modifiers[0], "Look", "Splats")
scene.render.resolution_x = scene.render.resolution_y = 48
scene.cycles.samples, scene.cycles.filter_width, scene.cycles.use_adaptive_sampling = 32, 0.01, False
scene.render.film_transparent = True
scene.frame_set(21, subframe=0.5)
image = scene.render.image_settings
image.file_format, image.color_depth = "OPEN_EXR", "32"
scene.render.filepath = sys.argv[3]
bpy.ops.render.render(write_still=True)
tell(range=[scene.frame_start, scene.frame_end], fps=scene.render.fps / scene.render.fps_base,
     transform=scene.view_settings.view_transform)
"""


def test_splats_are_rendered_as_the_formula_says(blender, tmp_path):
    """Against a ray tracer of a few lines: linear light, front to back, α exp(-½ d²) along each ray."""
    OpenEXR = pytest.importorskip("OpenEXR")
    asset = make(60, seed=3)
    asset.sigma_t[:] = 1.0
    asset.scale[:] = np.exp(np.random.default_rng(1).uniform(-4, -1.6, asset.scale.shape))
    write_ply(tmp_path / "a.ply", asset)
    told = blender(RENDER, tmp_path / "a.ply", tmp_path / "a.blend", tmp_path / "a.exr")
    assert told["range"] == [10, 33] and abs(told["fps"] - 23.976) < 1e-4 and told["transform"] == "Standard"
    with OpenEXR.File(str(tmp_path / "a.exr")) as f:
        got = f.channels()["RGBA"].pixels

    size, c2w = 48, opengl_to_opencv(spherical(0, 0))
    position, alpha = (x.astype(float) for x in asset.at(asset.frame_to_time(21.5)))
    y, x = np.mgrid[:size, :size] + 0.5
    f = focal_from_fov(50, size)
    ray = np.stack([(x - size / 2) / f, (y - size / 2) / f, np.ones_like(x)], -1) @ c2w[:3, :3].T
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    scale = asset.soft_scale()
    reach = 3 * scale.max(1)
    offset = c2w[:3, 3] - position  # (N,3)
    M = (rotation_matrices(asset.rotation) / scale[:, None]).transpose(0, 2, 1)
    w = np.einsum("nij,yxj->nyxi", M, ray)
    u = np.einsum("nij,nj->ni", M, offset)[:, None, None]
    d2 = (np.cross(u, w) ** 2).sum(-1) / (w**2).sum(-1)
    b = np.einsum("ni,yxi->nyx", offset, ray)
    disc = b**2 - ((offset**2).sum(-1) - reach**2)[:, None, None]  # spheres are met at their front
    entry = np.where(disc > 0, -b - np.sqrt(np.maximum(disc, 0)), np.inf)
    a = np.where((disc > 0) & (alpha >= 0.05)[:, None, None], alpha[:, None, None] * np.exp(-0.5 * d2), 0)
    order = np.argsort(entry, 0)
    a = np.take_along_axis(a, order, 0)
    colour = linear_from_srgb(asset.rgb)[order]  # (N,H,W,3)
    through = np.cumprod(1 - a, 0)
    weight = a * np.concatenate([np.ones((1, size, size)), through[:-1]])
    expected = np.concatenate([(weight[..., None] * colour).sum(0), (1 - through[-1])[..., None]], -1)
    assert expected[..., 3].mean() > 0.15
    error = np.abs(got - expected)
    assert error.mean() < 2e-4 and error.max() < 0.03, (error.mean(), error.max())
