# SPDX-License-Identifier: GPL-3.0-or-later
import bpy
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from timesplat.datagen import displace, rigs
from timesplat.datagen.capture import Subject, capture
from timesplat.datagen.render_setup import CaptureSettings
from timesplat.datagen.scene.measure import normalisation
from timesplat.datagen.scene.open import empty_session
from timesplat.datagen.sequence import Normalisation

BOX = np.array([[-1.0, -0.4, -0.7], [1.0, 0.4, 0.7]])


@given(st.integers(0, 2**40), st.integers(1, 24))
def test_a_line_of_small_steps_that_stays_in_its_box(seed, count):
    norm = Normalisation(2.0, (1.0, 0.0, -3.0))
    new, box, shift = displace.displacements(norm, BOX, count, seed)
    assert shift.shape == (count, 3)
    assert np.allclose(np.linalg.matrix_rank(shift - shift[0], tol=1e-9), min(count - 1, 1))
    assert np.abs(box).max() <= 1 + 1e-9
    reach = np.minimum(np.linalg.norm(BOX, axis=1).max(), rigs.RADIUS) * norm.scale / new.scale
    places = shift + (np.array(norm.translation) - new.translation) / new.scale
    assert reach + np.linalg.norm(places, axis=1).max() <= rigs.RADIUS + 1e-9  # its ball stays in that of the rigs
    world = new.scale * box + new.translation
    moved = [norm.scale * BOX + norm.translation + new.scale * s for s in shift]
    assert np.allclose(world[0], np.min([m[0] for m in moved], 0))
    assert np.allclose(world[1], np.max([m[1] for m in moved], 0))
    if count > 2:
        steps = np.linalg.norm(np.diff(shift, axis=0), axis=1)
        assert steps.min() > 0 and steps.max() <= 3.001 * steps.min() and steps.sum() <= 0.6
    again = displace.displacements(norm, BOX, count, seed)[2]
    assert np.array_equal(shift, again)


def test_moving_the_cameras_shows_what_moving_the_object_shows(tmp_path):
    empty_session()
    bpy.ops.mesh.primitive_monkey_add(size=1.5, rotation=(0.2, 0, 0.5))
    ob = bpy.context.object
    norm, box = normalisation([1])
    norm, box, shift = displace.displacements(norm, box, 3, seed=5)
    shots = [s for s in rigs.canonical([0, 1, 2]) if s.camera in ("front", "left")]
    settings = CaptureSettings(size=40, samples=64)
    by_camera = capture(shots, tmp_path / "a", Subject([1, 1, 1], norm, shift=shift), settings)
    for frame, d in enumerate(shift):
        ob.location = norm.scale * d
        ob.keyframe_insert("location", frame=frame)
    again, box_again = normalisation([0, 1, 2])
    assert again.scale <= norm.scale < 1.05 * again.scale  # which knows the vertices, not the ball around them alone
    assert np.allclose(box_again * again.scale, box * norm.scale, atol=1e-5)
    by_object = capture(shots, tmp_path / "b", Subject([0, 1, 2], norm), settings)
    for i, view in enumerate(by_camera.views):
        assert np.array_equal(view.c2w, by_object.views[i].c2w)  # the nominal camera
        a, b = (s.load_image(i).astype(float) for s in (by_camera, by_object))
        assert np.abs(a * a[..., 3:] - b * b[..., 3:]).mean() / 255 < 1
        p, q = by_camera.load_passes(i), by_object.load_passes(i)
        body = np.isfinite(p.depth) & np.isfinite(q.depth) & (a[..., 3] == 255)
        assert body.sum() > 150 and np.abs(p.depth[body] - q.depth[body]).mean() < 1e-3
        for mine, blenders, end in ((p.flow_next, q.flow_next, 2), (p.flow_prev, q.flow_prev, 0)):
            if view.frame != end:  # there the clip ends: nothing moves on
                assert np.abs(mine - blenders)[body].mean() < 0.01 and np.abs(blenders[body]).max() > 0.3
            else:
                assert np.abs(mine[body]).max() < 1e-3
