"""Sequences of two balls that the tests of writers share, and what makes a camera right."""

from dataclasses import replace

import numpy as np
import pytest

from timesplat.datagen.readers.lenses import Lens
from timesplat.datagen.sequence import Sequence, View, opengl_to_opencv, write_sequence

from ..readers.worlds import BALLS, MOTION, RADIUS, photograph, save, shots

SQUARE = Lens(24, 24, 26.0, 26.0, 12.0, 12.0)
COLOURS = np.array([[220, 60, 40], [40, 90, 230]])


def make(folder, lens=SQUARE, held={4: "val", 5: "target", 6: "target"}, cameras=7, moments=3):  # noqa: B006
    """A Sequence on disk: cameras that stand still, of which some are `held` out, at each moment."""
    seq = Sequence(lens.width, lens.height, 30.0, 0, moments - 1, provenance={"asset": "balls"})
    taken = {}
    for k, s in enumerate(shots(cameras, lens=lens)):
        for m in range(moments):
            one = replace(s, time=m / max(moments - 1, 1))
            view = View(m, f"cam{k}", held.get(k, "canonical"), s.c2w, lens.fx, lens.fy, lens.cx, lens.cy)
            view.image = f"images/{k}-{m}.png"
            taken[view.image] = photograph(one)
            seq.views.append(view)

    def fill(tmp):
        for name, picture in taken.items():
            save(tmp / name, picture)

    return write_sequence(seq, folder, fill)


@pytest.fixture(scope="session")
def seq(tmp_path_factory):
    return make(tmp_path_factory.mktemp("balls") / "seq")


def looks_right(picture, K, c2w, time):
    """Whether a camera that a parser understood sees the balls where its picture (H,W,3 or 4) shows them: the ball that
    is nearest has its colour in the pixel of its middle. K (fx, fy, cx, cy), c2w (4,4) OpenGL axes."""
    c2w = opengl_to_opencv(np.asarray(c2w, float))
    local = (BALLS + MOTION * time - c2w[:3, 3]) @ c2w[:3, :3]
    n = int(local[:, 2].argmin())
    fx, fy, cx, cy = K
    x, y = local[n, 0] / local[n, 2] * fx + cx, local[n, 1] / local[n, 2] * fy + cy
    near = np.asarray(picture, float)[int(y) - 1 : int(y) + 2, int(x) - 1 : int(x) + 2, :3]
    assert RADIUS and np.abs(near - COLOURS[n]).max() < 60, (x, y, near.reshape(-1, 3)[4], COLOURS[n])
    return True
