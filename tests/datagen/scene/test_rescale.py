# SPDX-License-Identifier: GPL-3.0-or-later
import bpy
import numpy as np
import pytest

from timesplat.datagen.scene.measure import normalisation
from timesplat.datagen.scene.open import empty_session
from timesplat.datagen.scene.rescale import rescaled

from ..helpers import cube, key


@pytest.mark.parametrize("factor", [1e7, 1e-7])
def test_everything_grows_about_the_origin_and_comes_back(factor):
    empty_session()
    ob, child = cube("A", (3, 0, 0)), cube("B", (3, 0, 2))
    child.parent = ob
    key(ob, "location", {1: (3, 0, 0), 5: (7, 0, 0)})
    before, box = normalisation([1, 5])
    with rescaled(factor):
        norm, box_then = normalisation([1, 5])
        assert np.allclose([norm.scale, *norm.translation], factor * np.array([before.scale, *before.translation]))
        assert np.allclose(box, box_then, atol=1e-5)
    assert normalisation([1, 5])[0] == before and ob.parent is None
    assert [o.name for o in bpy.data.objects] == ["A", "B"]
