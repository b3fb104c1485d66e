# SPDX-License-Identifier: GPL-3.0-or-later
"""Assets for tests."""

import numpy as np

from timesplat.model.io.asset import ARRAYS, STATIC_SIGMA_T, Asset, Clip
from timesplat.model.io.paths import Paths, continuous

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


def make_paths(counts, seed=0, *, way=0.1, turn=0.2) -> Paths:
    """Paths with that many knots each, from one to the next up to about `way` along each axis and `turn` radians; every
    second one is there for a part of the clip alone."""
    r, counts = np.random.default_rng(seed), np.array(counts, np.int32)
    part, first = np.arange(len(counts)) % 2 == 1, np.cumsum(counts) - counts
    step, q = r.uniform(-way, way, (counts.sum(), 3)), r.normal(size=(counts.sum(), 4))
    step[first] = r.uniform(-0.5, 0.5, (len(counts), 3))
    place, base = np.empty_like(step), np.repeat(q[first], counts, 0)
    for i, n in zip(first, counts, strict=True):
        place[i : i + n] = step[i : i + n].cumsum(0)
        drift = np.cumsum(q[i : i + n] - q[i], 0) / np.linalg.norm(q[i])
        base[i : i + n] += turn / 4 * drift * np.linalg.norm(q[i])
    base /= np.linalg.norm(base, axis=1, keepdims=True)
    start, end = np.where(part, r.uniform(-1, -0.2, len(counts)), -1), np.where(part, r.uniform(0.2, 1, len(counts)), 1)
    f32 = lambda a: np.ascontiguousarray(a, np.float32)  # noqa: E731
    return Paths(f32(start), f32(end), counts, f32(place), continuous(f32(base), counts))


def tracked_asset(n=50, counts=(1, 2, 5, 24), seed=0, clip=CLIP, **motion) -> Asset:
    """n Gaussians that ride in turn on paths with so many knots; `motion` as in `make_paths`."""
    paths, path = make_paths(counts, seed, **motion), np.arange(n, dtype=np.int32) % len(counts)
    a = make_asset(n, seed, clip)
    a.t[:] = paths.start[path] + (a.t + 1) / 2 * (paths.end - paths.start)[path]
    a.sigma_t[:] = STATIC_SIGMA_T
    a.xyz[:] = paths.at(a.t, path)[0] + 0.2 * a.xyz
    a.path, a.paths = path, paths
    a.velocity[:] = a.path_velocity()
    return a


def assert_same(a: Asset, b: Asset, rtol=2e-6, atol=2e-6) -> None:
    """Clips are equal, arrays and those of the paths within the tolerance."""
    assert a.clip == b.clip
    for name in ARRAYS:
        np.testing.assert_allclose(getattr(b, name), getattr(a, name), rtol=rtol, atol=atol, err_msg=name)
    assert (a.paths is None) == (b.paths is None)
    if a.paths is not None:
        np.testing.assert_array_equal(b.path, a.path)
        for name, one in vars(a.paths).items():
            np.testing.assert_allclose(getattr(b.paths, name), one, rtol=rtol, atol=atol, err_msg=name)
