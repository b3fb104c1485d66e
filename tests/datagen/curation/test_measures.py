# SPDX-License-Identifier: GPL-3.0-or-later
import numpy as np
import pytest

from timesplat.datagen.curation.measures import measure, motion_of, shrunk

from .drawn import SIDE, box, draw_sequence


def measured(tmp_path, paint, **options):
    return measure(draw_sequence(tmp_path / "thing" / "clip", paint, **options))


def test_motion_by_hand():
    """A pixel of three goes from white to black, another stays grey; nothing else is ever shown."""
    rgba = np.zeros((3, 2, 4, 4), np.uint8)
    rgba[:, 0, :2, 3] = 255
    rgba[:, 0, 0, :3] = np.array([255, 128, 0])[:, None]
    rgba[:, 0, 1, :3] = 90
    assert motion_of([rgba]) == pytest.approx(0.5)
    assert motion_of([rgba, rgba[:1], np.repeat(rgba[:1], 2, 0)]) == pytest.approx(0.25)
    assert np.isnan(motion_of([])) and np.isnan(motion_of([rgba[:1]]))
    assert motion_of([rgba[[0, 2, 0]]]) == pytest.approx(0.5)  # the greatest, not from the first to the last
    rgba[..., 3] = 0
    assert motion_of([rgba]) == 0


def test_a_thing_that_moves_is_good(tmp_path):
    m = measured(tmp_path, lambda t, camera: box(0.4 + 0.2 * t))
    assert m.moves and not m.still and 0.2 < m.motion < 0.4
    assert (m.border, m.empty, m.magenta) == (0, 0, 0) and m.growth == 1 and m.variety > 0.03
    assert m.size == pytest.approx(0.4, abs=0.05) and len(m.hash) == 64


def test_what_is_still_is_known_by_clip_and_settings(tmp_path):
    one = measured(tmp_path, lambda t, camera: box(), frames=1)
    assert one.still and not one.moves and np.isnan(one.motion)
    pushed = measured(tmp_path, lambda t, camera: box(0.5 + 0.1 * t), settings={"displace": True})
    assert pushed.still and not pushed.moves and pushed.motion > 0
    frozen = measured(tmp_path, lambda t, camera: box())
    assert frozen.moves and not frozen.still and frozen.motion == 0


def test_artefacts_by_hand(tmp_path):
    m = measured(tmp_path, lambda t, camera: box(t))  # half out at both ends
    assert m.border == pytest.approx(0.4 * SIDE / (4 * SIDE - 4), abs=0.02)
    m = measured(tmp_path, lambda t, camera: box(side=0.4 if t < 0.5 else 0.0), frames=4)
    assert m.empty == 0.5 and m.size > 0.3
    m = measured(tmp_path, lambda t, camera: box(side=0.05), frames=2)
    assert 0 < m.size < 0.1
    m = measured(tmp_path, lambda t, camera: box(side=0.9 if t == 1 else 0.1), frames=6)
    assert 5 < m.growth < 12
    m = measured(tmp_path, lambda t, camera: box(shade=0), frames=2)
    assert m.variety < 1e-4
    m = measured(tmp_path, lambda t, camera: box(colour=(230, 0, 230) if camera else (200, 0, 90)), frames=2)
    assert m.magenta > 0.4
    nothing = measured(tmp_path, lambda t, camera: box(side=0), frames=2)
    assert (nothing.empty, nothing.size, nothing.growth, nothing.variety, nothing.magenta) == (1, 0, 0, 0, 0)


def test_without_canonical_cameras_all_are_looked_at_and_motion_is_unknown(tmp_path):
    m = measured(tmp_path, lambda t, camera: box(0.0), cameras=("orbit",))
    assert np.isnan(m.motion) and m.hash == "" and m.border > 0.05 and m.moves


def test_shrunk_are_means_of_areas():
    picture = np.arange(30.0).reshape(5, 6, 1)
    assert np.allclose(shrunk(picture, 1, 2)[0, :, 0], [picture[:, :3].mean(), picture[:, 3:].mean()])
    assert np.allclose(shrunk(picture, 5, 6), picture)
    assert shrunk(np.ones((13, 20, 3)), 8, 9).shape == (8, 9, 3) and np.allclose(shrunk(np.ones((13, 20, 3)), 8, 9), 1)
