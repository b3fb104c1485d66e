# SPDX-License-Identifier: GPL-3.0-or-later
"""Assets for tests."""

import numpy as np

from timesplat.model.io.asset import ARRAYS, Asset, Clip

CLIP = Clip(30.0, 10, 33, 2.0, (1.0, 2.0, 3.0), pixel=0.01)


def make_asset(n=50, seed=0, clip=CLIP, *, speed=0.1, sigma=(0.05, 0.4)) -> Asset:
    """A random, valid asset of n Gaussians in the cube of half-side 0.8, that move up to `speed` along each axis in a
    unit of model time and live for between `sigma` of them."""
    r = np.random.default_rng(seed)
    q = r.normal(size=(n, 4))
    arrays = {
        "xyz": r.uniform(-0.8, 0.8, (n, 3)),
        "t": r.uniform(-1, 1, n),
        "velocity": r.uniform(-speed, speed, (n, 3)),
        "sigma_t": r.uniform(*sigma, n),
        "scale": np.exp(r.uniform(-6, -3, (n, 3))),
        "rotation": q / np.linalg.norm(q, axis=1, keepdims=True),
        "rgb": r.uniform(0, 1, (n, 3)),
        "opacity": r.uniform(0.1, 0.99, n),
    }
    return Asset(**{k: a.astype(np.float32) for k, a in arrays.items()}, clip=clip)


def stray_asset(**options) -> Asset:
    """One Gaussian lives for a fifth of a frame and is very fast: its line leaves the scene."""
    a = make_asset(**options)
    a.sigma_t[3], a.velocity[3], a.t[3], a.xyz[3], a.opacity[3] = 0.2 * 2 / 23, (60, 0, 0), -0.4, (0.1, 0, 0), 1
    return a


def assert_same(a: Asset, b: Asset, rtol=2e-6, atol=2e-6) -> None:
    """Clips are equal, arrays within the tolerance."""
    assert a.clip == b.clip
    for name in ARRAYS:
        np.testing.assert_allclose(getattr(b, name), getattr(a, name), rtol=rtol, atol=atol, err_msg=name)
