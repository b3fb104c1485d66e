# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians of any numbers through slicing, drawing, refinement and export: refused by name, or pictures and gradients
that are finite, and right where float64 can tell."""

import functools
import random
import tempfile
from pathlib import Path

import numpy as np
import torch

from timesplat.datagen.rigs import spherical
from timesplat.datagen.sequence import InputError, focal_from_fov, opengl_to_opencv
from timesplat.model.fitting.parameters import RATES, Parameters, activate, raw_parameters
from timesplat.model.gaussians import FIELDS, Gaussians4D
from timesplat.model.io.asset import Clip, check
from timesplat.model.io.files import read_asset, write_asset
from timesplat.model.rasterize import render

from .damage import is_a_sentence, no_hang, suite

SIZE = 20
EXTREME = (0.0, -0.0, 1e-45, 1e-39, 1e-30, 1e-20, 1e-8, 1e8, 1e15, 1e20, 1e30, 3e38)
NOT_FINITE = (float("nan"), float("inf"), -float("inf"))


def cameras(r: random.Random):
    """c2w (2,4,4), intrinsics (2,4), time (2): one that sees the middle, one that may see nothing of it."""
    c2w = np.stack([spherical(r.uniform(0, 360), r.uniform(-60, 60)), spherical(0, 0, r.choice((2.7, 0.02, 50.0)))])
    if r.random() < 0.2:  # everything is behind
        c2w[:, :3, 1:3] *= -1
    focal = focal_from_fov(r.choice((50.0, 5.0, 120.0)), SIZE)
    K = torch.tensor([[focal, focal, SIZE / 2, SIZE / 2]] * 2, dtype=torch.float32)
    return torch.from_numpy(opengl_to_opencv(c2w)).float(), K, torch.tensor([r.uniform(-1, 1), r.uniform(-1, 1)])


def cloud(r: random.Random, n: int) -> Gaussians4D:
    """n sound Gaussians, small and large, fast and slow, of short and long lives."""
    g = torch.Generator().manual_seed(r.randrange(2**31))
    many = lambda *shape: torch.randn(*shape, generator=g)  # noqa: E731
    return Gaussians4D(
        xyz=0.5 * many(n, 3), t=0.5 * many(n), velocity=r.choice((0.0, 0.2, 3.0)) * many(n, 3),
        sigma_t=(r.choice((-4.0, -1.0, 3.0)) + many(n)).exp(),
        scale=(r.choice((-5.0, -2.5, 0.0)) + many(n, 3)).exp(),
        rotation=torch.nn.functional.normalize(many(n, 4), dim=-1), rgb=torch.rand(n, 3, generator=g),
        opacity=torch.rand(n, generator=g),
    )  # fmt: skip


def spoil(g: Gaussians4D, r: random.Random, values) -> str:
    """Puts one of the values at some places of one field; returns its name."""
    name = r.choice(FIELDS)
    field = getattr(g, name)
    flat = field.view(-1)
    value = r.choice(values) * (r.choice((1, -1)) if name in ("xyz", "t", "velocity", "rotation", "rgb") else 1)
    for _ in range(r.choice((1, 2, len(flat)))):
        flat[r.randrange(len(flat))] = value
    if name == "opacity":
        field.clamp_(max=1)
    return name


@functools.cache
def compiled() -> None:
    """Draws something once, forwards and back, so that no case is taken for one that hangs while it is compiled."""
    r = random.Random(0)
    g = cloud(r, 3)
    g.xyz.requires_grad_()
    with torch.enable_grad():
        draw(g, cameras(r))[0].sum().backward()


def draw(g: Gaussians4D, seen, backend="cpu", dtype=torch.float32):
    return render(g.to(dtype), *seen, SIZE, SIZE, backend=backend)


# ---------------------------------------------------------------- drawing


def check_drawing(seed: int) -> None:
    """Sound Gaussians are drawn as float64 draws them; extreme ones finitely; what is not finite is named."""
    r = random.Random(seed)
    g, seen, kind = cloud(r, r.choice((1, 3, 12))), cameras(r), r.choice(("sound", "extreme", "not finite", "screen"))
    name = ""
    if kind == "extreme":
        for _ in range(r.choice((1, 3))):
            name = spoil(g, r, EXTREME)
    elif kind == "not finite":
        name = spoil(g, r, NOT_FINITE)
    elif kind == "screen":
        g.scale[0], g.opacity[0], g.sigma_t[0] = r.choice((5.0, 1e3, 1e6)), r.choice((0.3, 1.0)), 1e4
    compiled()
    bad = [k for k in FIELDS if not getattr(g, k).isfinite().all()]
    with no_hang():
        try:
            rgb, alpha = draw(g, seen)
        except ValueError as e:
            assert bad and any(k in str(e) for k in bad), (name, e)
            return
    assert not bad, f"{bad} was drawn"
    assert rgb.isfinite().all() and alpha.isfinite().all(), name
    assert alpha.min() >= -1e-5 and alpha.max() <= 1 + 1e-5
    if kind == "sound":
        right, covered = draw(g, seen, "reference", torch.float64)
        # places where a faint Gaussian ends, or a pixel is full, may fall to either side of a threshold
        assert (rgb - right).abs().max() < 0.02 and (alpha - covered).abs().max() < 0.02
        assert (rgb - right).abs().mean() < 1e-3


def test_what_is_further_away_than_float32_tells():
    check_drawing(120993)


test_drawing, test_drawing_by_the_thousand = suite(check_drawing, 100)


# ---------------------------------------------------------------- a step of a fit


def check_step(seed: int) -> None:
    """From extreme Gaussians a step leads to finite ones: gradients are finite, or count for nothing."""
    r = random.Random(seed)
    g, seen = cloud(r, r.choice((1, 4, 12))), cameras(r)
    for _ in range(r.choice((0, 1, 2))):
        spoil(g, r, EXTREME)
    raw = raw_parameters(g)
    compiled()
    bound = 1e15  # a fit's own numbers never are beyond
    parameters = Parameters({k: v.clamp(-bound, bound) for k, v in raw.items()}, RATES)
    with no_hang(), torch.enable_grad():
        now = activate(parameters.values)
        rgb, alpha = render(now, *seen, SIZE, SIZE)
        assert rgb.isfinite().all()
        ((rgb - 0.5).abs().mean() + alpha.mean()).backward()
    for k, v in parameters.values.items():
        assert v.grad is None or v.grad.isfinite().all(), f"the gradient of {k} is not finite"
    parameters.step(0.5)
    assert all(v.isfinite().all() for v in parameters.values.values())


test_steps, test_steps_by_the_thousand = suite(check_step, 60)


# ---------------------------------------------------------------- to files


def check_export(seed: int) -> None:
    """What is not sound is refused and nothing is left half-written; what is sound comes back the same."""
    r = random.Random(seed)
    g = cloud(r, 5)
    for _ in range(r.choice((0, 1, 2))):
        spoil(g, r, EXTREME + NOT_FINITE)
    asset = g.to_asset(Clip())
    suffix = r.choice((".ply", ".splat", ".spz", ".glb", ".html"))
    with tempfile.TemporaryDirectory() as folder, np.errstate(all="ignore"), no_hang():
        path = Path(folder) / f"a{suffix}"
        try:
            write_asset(path, asset, frame=r.uniform(0, 23) if suffix in (".splat", ".spz", ".glb") else None)
        except InputError as e:
            is_a_sentence(e, path)
            assert not path.exists() and not list(Path(folder).iterdir())
            return
        monstrous = max(float(getattr(g, k).abs().max()) for k in ("xyz", "velocity", "scale")) >= 1e8
        if suffix != ".glb" and not (suffix == ".splat" and monstrous):  # such a .splat is taken for another kind
            again = read_asset(path).asset
            check(again, path)
            if suffix in (".ply", ".html"):
                check(asset)
                assert np.array_equal(again.xyz, asset.xyz) and np.array_equal(again.velocity, asset.velocity)
                # as logarithms and logits, in single precision; what is nearer to 0 or 1 than these tell is not told
                assert np.allclose(again.scale, asset.scale, rtol=1e-4)
                assert np.allclose(again.opacity, asset.opacity, atol=1e-5)


def test_what_is_left_where_nothing_shows_is_no_monstrous_splat():
    check_export(343)


test_export, test_export_by_the_thousand = suite(check_export, 40)
