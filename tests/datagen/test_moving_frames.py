# SPDX-License-Identifier: GPL-3.0-or-later
import numpy as np
import pytest

from timesplat.datagen.moving_frames import moving_frames

TRIANGLE = np.array([[0.0, 0, 0], [2, 0, 0], [0.5, 1, 0]])


def turn(axis, angle):
    """(3,3) about x, y or z."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = [k for k in range(3) if k != axis]
    sign = -1 if axis == 1 else 1
    out = np.eye(3)
    out[i, i], out[i, j], out[j, i], out[j, j] = c, -s * sign, s * sign, c
    return out


def matrix(q):
    w, x, y, z = q
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]]
    rows += [[2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]]
    rows += [[2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
    return np.array(rows)


def test_a_triangle_s_frame_turns_with_it():
    angles = np.linspace(0, 4 * np.pi, 40)
    turns = [turn(0, 0.3 * a) @ turn(2, a) @ turn(1, 0.7 * a) for a in angles]
    q = moving_frames(np.stack([TRIANGLE @ R.T + i for i, R in enumerate(turns)])[:, None])
    assert np.allclose(q[0, 0], (1, 0, 0, 0)) and ((q[1:] * q[:-1]).sum(-1) > 0.9).all()
    for R, (one,) in zip(turns, q, strict=True):
        assert np.allclose(matrix(one), R, atol=1e-9)


def test_every_kind_of_half_turn():
    for axis in range(3):
        (one,) = moving_frames((TRIANGLE @ turn(axis, np.pi).T)[None, None])[0]
        assert np.allclose(matrix(one), turn(axis, np.pi), atol=1e-9)


def test_without_an_area_the_frame_stays():
    at = np.stack([0 * TRIANGLE, TRIANGLE @ turn(2, 1).T, TRIANGLE * (1, 0, 0), TRIANGLE])[:, None]
    q = moving_frames(np.concatenate([at, 0 * at], 1))
    first, second, third, last = q[:, 0]
    assert np.array_equal(first, second) and np.array_equal(second, third)
    assert np.allclose(matrix(second), turn(2, 1)) and np.allclose(matrix(last), np.eye(3))
    assert np.allclose(q[:, 1], (1, 0, 0, 0))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_segment_turns_no_more_than_it_must(axis):
    along = [turn(axis, a) @ (1, 0.3, 0.2) for a in (0, 0.5, 1.5, 1.5 + np.pi, 5)]
    q = moving_frames(np.stack([[np.zeros(3), v, v] for v in along])[:, None])[:, 0]
    for v, one in zip(along, q, strict=True):
        assert np.allclose(matrix(one)[:, 0], v / np.linalg.norm(v))
    for k in range(len(along) - 1):
        step = matrix(q[k + 1]) @ matrix(q[k]).T
        cosine = along[k] @ along[k + 1] / np.linalg.norm(along[0]) ** 2
        assert (np.trace(step) - 1) / 2 == pytest.approx(cosine, abs=1e-9)  # of the angle turned
