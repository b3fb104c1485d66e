# SPDX-License-Identifier: GPL-3.0-or-later
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from timesplat.datagen import rigs

FRAMES = list(range(24))
finite = st.floats(-100, 100).map(lambda x: round(x, 3))


@given(st.tuples(finite, finite, finite), st.tuples(finite, finite, finite))
def test_look_at_is_rigid_and_looks_there(position, target):
    position, target = np.array(position), np.array(target)
    if np.linalg.norm(position - target) < 1e-3:
        return
    c2w = rigs.look_at(position, target)
    R = c2w[:3, :3]
    assert np.allclose(R.T @ R, np.eye(3), atol=1e-9) and np.linalg.det(R) > 0
    ahead = R.T @ (target - position)
    assert np.allclose(ahead[:2], 0, atol=1e-6) and ahead[2] < 0
    assert R[2, 1] >= -1e-9  # the image's up never points down
    assert np.array_equal(c2w[3], [0, 0, 0, 1])


def test_look_at_itself_is_refused():
    with pytest.raises(ValueError, match="cannot look"):
        rigs.look_at((1, 2, 3), (1, 2, 3))


def test_canonical_views_stand_where_their_names_say():
    at = {s.camera: s.c2w[:3, 3] for s in rigs.canonical([0])}
    assert np.allclose(at["front"], [0, -2.7, 0]) and np.allclose(at["back"], [0, 2.7, 0])
    assert np.allclose(at["left"], [-2.7, 0, 0]) and np.allclose(at["right"], [2.7, 0, 0])


def test_the_default_rig_is_six_cameras_at_every_frame():
    shots = rigs.default_rig(FRAMES, seed=3)
    assert len(shots) == 144
    assert [s.frame for s in shots] == sorted(s.frame for s in shots)
    for f in FRAMES:
        assert len({s.camera for s in shots if s.frame == f}) == 6
    elevated = np.array([s.c2w[:3, 3] for s in shots if s.rig == "elevated"])
    assert (elevated[:, 2] > 0.9).all() and np.ptp(elevated[:, 0]) > 3


@pytest.mark.parametrize("name", rigs.RIGS)
def test_every_rig_is_seeded_and_within_bounds(name):
    for frames in (FRAMES, [0]):
        a, b = rigs.RIGS[name](frames, 5), rigs.RIGS[name](frames, 5)
        assert a and all(np.array_equal(x.c2w, y.c2w) for x, y in zip(a, b, strict=True))
        for s in a:
            assert s.frame in frames and s.rig and rigs.NEAREST - 1e-9 < np.linalg.norm(s.c2w[:3, 3]) < 3.6
    if name in ("random", "elevated", "orbit", "default"):
        c = rigs.RIGS[name](FRAMES, 6)
        assert not all(np.allclose(x.c2w, y.c2w) for x, y in zip(rigs.RIGS[name](FRAMES, 5), c, strict=True))


def test_setups_are_those_of_the_paper():
    made = {name: f(FRAMES, 0) for name, f in rigs.SETUPS.items()}
    assert {k: len(v) for k, v in made.items()} == {
        "alternating": 24,
        "interpolation": 24,
        "rotating": 24,
        "random": 24,
        "video": 27,
    }
    assert [s.camera for s in made["alternating"][:5]] == ["front", "left", "back", "right", "front"]
    assert {s.frame for s in made["interpolation"]} == set(range(0, 24, 2))
    rotating = made["rotating"]
    assert {s.camera for s in rotating[::2]} == {"via_right"} and {s.camera for s in rotating[1::2]} == {"via_left"}
    assert np.allclose(rotating[0].c2w[:3, 3], [0, -2.7, 0])  # from the front …
    assert np.allclose(rotating[-1].c2w[:3, 3], [0, 2.7, 0])  # … to the back
    assert rotating[12].c2w[0, 3] > 0 > rotating[11].c2w[0, 3]  # right has +X, left has -X
    assert [s.frame for s in made["video"]] == [0, 0, 0, 0, *range(1, 24)]


@given(st.integers(0, 2**32))
def test_targets_are_held_out(seed):
    held = rigs.targets(FRAMES[:6], seed, 2)
    inputs = rigs.random_inputs(FRAMES[:6], seed)
    assert len(held) == 12 and {s.rig for s in held} == {"target"}
    assert len({(s.camera, s.frame) for s in held}) == 12
    for h in held:
        elevation = np.degrees(np.arcsin(h.c2w[2, 3] / 2.7))
        assert -30.001 <= elevation <= 60.001
        assert all(not np.allclose(h.c2w, s.c2w) for s in inputs)
