# SPDX-License-Identifier: GPL-3.0-or-later
"""The balls in every layout and convention, each read and fitted with the same few steps: the same Gaussians come out.

Compared are pictures of the fits from the first one's cameras, in the world that all share. Where a reading changes no
pixel, only how cameras are written, they are the same but for rounding, which a fit makes larger; where it does, by
lenses, JPEG or sizes, they differ by what is lost there.
"""

from dataclasses import replace

import numpy as np
import pytest

from timesplat.datagen.readers import open_sequence
from timesplat.datagen.readers.lenses import Lens
from timesplat.datagen.readers.options import ReadOptions
from timesplat.datagen.sequence import opengl_to_opencv

from .worlds import PLAIN, photograph, save, shots, write_colmap, write_pictures, write_transforms

pytest.importorskip("torch")

import torch

from timesplat.evaluation.scoring import draw
from timesplat.model.methods import ReconstructOptions
from timesplat.model.reconstruct import reconstruct_views
from timesplat.model.views import load_views

COUNT, STEPS = 16, 40
ROUNDING, LOST = 28.0, 25.0  # dB of pictures of the fits: 29.6 and 27 at the least were seen, or no difference at all


def plain(folder, taken):
    write_pictures(folder, taken)
    write_transforms(folder, taken)


def axes(folder, taken):
    write_pictures(folder, taken)
    turned = lambda k, s: {"transform_matrix": np.linalg.inv(opengl_to_opencv(s.c2w)).tolist()}  # noqa: E731
    write_transforms(folder, taken, frame=turned)
    return ReadOptions(axes="w2c-opencv")


def large_and_far(folder, taken):
    moved = shots(COUNT, scale=4.0, offset=10.0)
    write_pictures(folder, moved, 4.0, 10.0)
    write_transforms(folder, moved)


def colmap(folder, taken):
    write_pictures(folder, taken)
    write_colmap(folder, taken, [f"{k:04d}.png" for k in range(COUNT)], binary=True)
    return ReadOptions(times=r"(\d+)\.png")


def seconds(folder, taken):
    write_pictures(folder, taken)
    write_transforms(folder, taken, frame=lambda k, s: {"time": 7 + k / 25})


def d_nerf(folder, taken):
    write_pictures(folder, taken, name="train/{k:04d}.png")
    write_transforms(folder, taken, frame=lambda k, s: {"file_path": f"./train/{k:04d}"})
    (folder / "transforms.json").rename(folder / "transforms_train.json")


def through_a_lens(folder, taken):
    bent = [replace(s, lens=replace(s.lens, radial=(0.25, 0.05, 0.0, 0.0))) for s in taken]
    write_pictures(folder, bent)
    write_transforms(folder, bent, k1=0.25, k2=0.05)


def jpeg_on_white(folder, taken):
    write_pictures(folder, taken, name="images/{k:04d}.jpg", white=True, quality=92)
    write_transforms(folder, taken, frame=lambda k, s: {"file_path": f"images/{k:04d}.jpg"})


def mixed_sizes(folder, taken):
    double = Lens(2 * PLAIN.width, 2 * PLAIN.height, *(2 * x for x in (PLAIN.fx, PLAIN.fy, PLAIN.cx, PLAIN.cy)))
    mixed = [replace(s, lens=double) if k % 3 == 2 else s for k, s in enumerate(taken)]
    write_pictures(folder, mixed)
    keys = {"w": "width", "h": "height", "fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}
    write_transforms(folder, mixed, frame=lambda k, s: {key: getattr(s.lens, n) for key, n in keys.items()})


def masks(folder, taken):
    for k, s in enumerate(taken):
        rgba = photograph(s)
        save(folder / f"images/{k:04d}.png", rgba[..., :3])
        save(folder / f"masks/{k:04d}.png", rgba[..., 3])
    write_transforms(folder, taken, frame=lambda k, s: {"mask_path": f"masks/{k:04d}.png"})


WAYS = {axes: ROUNDING, large_and_far: ROUNDING, colmap: ROUNDING, seconds: ROUNDING, masks: ROUNDING}
WAYS |= {d_nerf: LOST, through_a_lens: LOST, jpeg_on_white: LOST, mixed_sizes: LOST}


def fitted(way, folder, taken):
    """The Sequence that a way to write comes to, its views, and what is fitted to them."""
    seq = open_sequence(folder, way(folder, taken) or ReadOptions())
    views = load_views(seq, range(COUNT))
    torch.manual_seed(0)
    return seq, views, reconstruct_views(views, "deform", ReconstructOptions(steps=STEPS))


def shown(fit, first, scale=1.0, offset=0.0):
    """Pictures (V,H,W,3) of a fit from the cameras of the first Sequence, whose world is moved."""
    seq, _, scene = fit
    c2w = first[0].normalisation.to_world(np.stack([v.c2w for v in first[0].views]))
    c2w[:, :3, 3] = scale * c2w[:, :3, 3] + offset
    c2w = torch.from_numpy(opengl_to_opencv(seq.normalisation.from_world(c2w)).astype(np.float32))
    return draw(scene, replace(first[1], c2w=c2w))[0]


@pytest.fixture(scope="module")
def taken():
    return shots(COUNT)


@pytest.fixture(scope="module")
def first(taken, tmp_path_factory):
    return fitted(plain, tmp_path_factory.mktemp("plain"), taken)


def decibels(a, b):
    return -10 * torch.log10((a - b).square().mean()).item()


@pytest.mark.parametrize("way", WAYS, ids=lambda w: w.__name__)
def test_the_same_gaussians_come_out(tmp_path, taken, first, way):
    fit = fitted(way, tmp_path, taken)
    mine, other = shown(first, first), shown(fit, first, *((4.0, 10.0) if way is large_and_far else ()))
    assert decibels(mine, first[1].over()) > 14, "they are of the balls"
    assert decibels(mine, other) > WAYS[way]
    if WAYS[way] == ROUNDING:
        joined = way is large_and_far  # what joins late differs by rounding there
        assert joined or len(fit[2]) == len(first[2])
