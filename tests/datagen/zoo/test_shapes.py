# SPDX-License-Identifier: GPL-3.0-or-later
from itertools import pairwise

import numpy as np
import pytest

from timesplat.datagen.zoo import shapes


def test_shapes_face_outwards():
    def volume(shape):
        points, faces = shape
        corners = [(face[0], a, b) for face in faces for a, b in pairwise(face[1:])]
        a, b, c = (points[[corner[k] for corner in corners]] for k in range(3))
        return np.einsum("ni,ni->", a, np.cross(b, c)) / 6

    assert volume(shapes.blob((1, 2, 3), 2, 16)) == pytest.approx(4 / 3 * np.pi * 6, rel=0.02)
    assert volume(shapes.torus(1, 0.3, 48, 24)) == pytest.approx(2 * np.pi**2 * 0.09, rel=0.03)
    capsule = shapes.tube([(0, 0, 0), (0, 1, 0)], [0.5, 0.5], sides=48)
    assert volume(capsule) == pytest.approx(np.pi * 0.25 + np.pi / 6, rel=0.05)
