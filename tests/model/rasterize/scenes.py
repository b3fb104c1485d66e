# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes for the rasteriser's tests, and how a backend is compared with the reference.

Images: largest absolute difference over the larger of 1 and the brightest value, setting aside at most one value in a
thousand, where float32 and float64 may fall on different sides of a threshold (1/255, 0.999, 1e-4). Gradients of a
random weighting of rgb and alpha: ||g - g_ref|| / ||g_ref|| over each whole tensor, nothing set aside.
"""

import math
from dataclasses import replace

import torch

from timesplat.datagen.rigs import look_at
from timesplat.datagen.sequence import opengl_to_opencv
from timesplat.model.gaussians import Gaussians4D
from timesplat.model.rasterize import render
from timesplat.model.rotations import rotation_matrix

FIELDS = ("xyz", "t", "velocity", "sigma_t", "cov3", "rgb", "opacity")  # what defines a `cloud`
# c2w, intrinsics, time, width, height of a camera that looks along +z
AXIS = (torch.eye(4)[None], torch.tensor([[40.0, 40.0, 20.0, 15.0]]), torch.zeros(1), 40, 30)


def random_shapes(n, rng, low, high):
    """scale (n,3), rotation (n,4), by the generator rng."""
    rotation = torch.nn.functional.normalize(torch.randn(n, 4, generator=rng), dim=1)
    return torch.exp(_uniform((n, 3), math.log(low), math.log(high), rng)), rotation


def _uniform(shape, low, high, rng):
    return low + (high - low) * torch.rand(shape, generator=rng)


def cloud(n, seed=0, scale=(0.01, 0.08), opacity=(0.05, 0.95), sigma_t=(0.2, 0.8)) -> Gaussians4D:
    """n random Gaussians in the unit ball, given by their covariance."""
    rng = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(n, 3, generator=rng), dim=1)
    sides, rotation = random_shapes(n, rng, *scale)
    M = rotation_matrix(rotation) * sides[:, None]
    return Gaussians4D.from_covariance(
        xyz=direction * _uniform((n, 1), 0, 1, rng) ** (1 / 3),
        t=_uniform(n, -1, 1, rng),
        velocity=0.3 * torch.randn(n, 3, generator=rng),
        sigma_t=_uniform(n, *sigma_t, rng),
        cov3=M @ M.mT,
        rgb=_uniform((n, 3), 0, 1, rng),
        opacity=_uniform(n, *opacity, rng),
    )


def gaussians(n=120) -> Gaussians4D:
    """A cloud given by scale and rotation."""
    scale, rotation = random_shapes(n, torch.Generator().manual_seed(5), 0.02, 0.12)
    return replace(cloud(n, seed=5), scale=scale, rotation=rotation, cov3=None)


def cameras(count=3, width=44, height=30, off=(0.0, 0.0), distance=2.7, fov=50):
    """c2w, intrinsics, time, width, height of cameras on a ring, each at its own time."""
    poses = []
    for i in range(count):
        a = 0.3 + 2 * math.pi * i / count
        pose = look_at([distance * x for x in (math.cos(a), math.sin(a), 0.3 * math.sin(3 * a))])
        poses.append(torch.tensor(opengl_to_opencv(pose), dtype=torch.float32))
    f = 0.5 * height / math.tan(math.radians(fov / 2))
    K = torch.tensor([f, 1.1 * f, width / 2 + off[0], height / 2 + off[1]]).expand(count, 4)
    return torch.stack(poses), K, torch.linspace(-0.7, 0.9, count), width, height


def one_of(view, i):
    """Camera i of `cameras`."""
    c2w, K, times, width, height = view
    return c2w[i : i + 1], K[i : i + 1], times[i : i + 1], width, height


def plane(n, z, **change) -> Gaussians4D:
    """A cloud that faces the AXIS camera at depth z; everything alive."""
    g = cloud(n, seed=3, **change)
    xyz = torch.cat([g.xyz[:, :2] * 0.4 * z, torch.full((n, 1), float(z))], 1)
    return replace(g, xyz=xyz, velocity=0 * g.velocity, sigma_t=torch.full((n,), 2.0))


def scenes():
    """Name, Gaussians, view of all."""
    ring, extremes = cameras(), torch.tensor([1e-6, 1 - 1e-6] * 75)
    yield "random", cloud(150), ring
    yield "one", plane(1, 2.0), AXIS
    yield "none", cloud(0), ring
    yield "tiles", cloud(200, scale=(0.005, 0.3)), cameras(2, 150, 70, off=(9.5, -6.3))
    yield "off-centre", cloud(120), cameras(2, 23, 37, off=(-8.2, 11.1))
    yield "one pixel", cloud(60), cameras(2, 1, 1)
    yield "tiny", cloud(150, scale=(1e-4, 1e-3)), ring
    yield "huge", cloud(60, scale=(0.1, 0.3)), ring
    yield "needles", cloud(80, scale=(1e-4, 0.3)), ring
    yield "opacity near 0 and 1", replace(cloud(150), opacity=extremes), ring
    yield "opaque stack", plane(150, 2.0, opacity=(0.9, 1.0), scale=(0.05, 0.2)), AXIS
    times = torch.tensor([-0.7, 0.1, 0.9] * 30) + 1e-3
    yield "brief", replace(cloud(90, sigma_t=(1e-3, 2e-3)), t=times), ring
    yield "dead", replace(cloud(30), t=torch.full((30,), 50.0)), ring
    yield "behind", plane(30, -2.0), AXIS
    yield "around the camera", cloud(200), cameras(3, distance=0.4)
    yield "off-screen", replace(plane(30, 2.0), xyz=torch.tensor([5.0, -4.0, 2.0]).repeat(30, 1)), AXIS
    slopes = torch.tensor([[0.5, 0.1, 0.5], [-0.1, 0.4, 0.4]]).repeat(20, 1)
    yield "clamped slope", replace(plane(40, 0.5, scale=(0.1, 0.3)), xyz=slopes), AXIS
    yield "same depth", plane(60, 2.0), AXIS
    yield "near plane", plane(50, 0.02, scale=(1e-4, 0.3)), AXIS
    wild = 40 * torch.randn(80, 3, generator=torch.Generator().manual_seed(1))
    yield "wild colours", replace(cloud(80), rgb=wild), ring
    yield "fast", replace(cloud(80), velocity=torch.tensor([[8.0, -3.0, 1.0]]).repeat(80, 1)), ring


def with_gradients(g, view, backend, dtype=torch.float32, device="cpu", **options):
    """-> rgb, alpha, gradients {field: tensor} of a random weighting of both, all on the CPU."""
    g = g.map(lambda x: x.detach().to(device, dtype).requires_grad_())
    rgb, alpha = render(g, *view, backend=backend, **options)
    rng = torch.Generator().manual_seed(7)
    a, b = torch.randn(rgb.shape, generator=rng), torch.randn(alpha.shape, generator=rng)
    ((rgb * a.to(device)).sum() + (alpha * b.to(device)).sum()).backward()
    return rgb.detach().cpu(), alpha.detach().cpu(), {k: getattr(g, k).grad.cpu() for k in FIELDS}


def assert_equals_reference(g, view, backend, device="cpu", pixels=2e-5, gradients=1e-3, **options):
    """pixels, gradients: the errors allowed. Returns the reference's rgb, alpha, gradients, in float64."""
    got = with_gradients(g, view, backend, device=device, **options)
    want = with_gradients(g, view, "reference", torch.float64, **options)
    for a, b in zip(got[:2], want[:2], strict=True):
        assert a.shape == b.shape
        if b.numel():
            error = (a - b).abs().flatten() / max(1, b.abs().max())
            assert error.sort().values[: max(1, int(0.999 * len(error)))].max() < pixels
            assert error.max() < 2e-2
    rounded = None  # the reference in float32, asked where a pixel of a Gaussian may lie on the edge of what is drawn
    for name, b in want[2].items():
        a = got[2][name]
        assert a.isfinite().all(), name
        rows = len(b), b.numel() // max(len(b), 1)
        error = (a - b).reshape(rows).norm(dim=1)
        if error.norm() > gradients * b.norm() + 1e-9:
            rounded = rounded or with_gradients(g, view, "reference", torch.float32, **options)
            error = error.minimum((a - rounded[2][name]).reshape(rows).norm(dim=1))
        assert error.norm() <= gradients * b.norm() + 1e-9, (name, (error.norm() / b.norm()).item())
    return want
