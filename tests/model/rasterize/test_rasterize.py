# SPDX-License-Identifier: GPL-3.0-or-later
"""The compiled rasteriser against the slow float64 reference, and the reference against mathematics.

How errors are measured. Images: largest absolute difference over the larger of 1 and the brightest value,
setting aside at most one value in a thousand, where float32 and float64 may fall on different sides of a
threshold (1/255, 0.999, 1e-4). Gradients of a random weighting of rgb and alpha: ||g - g_ref|| / ||g_ref|| over
each whole tensor, nothing set aside.
"""

import importlib.machinery
import math
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from timesplat.model import rasterize as package
from timesplat.model.gaussians import Gaussians4D
from timesplat.model.rasterize import rasterize, render
from timesplat.model.rotations import rotation_matrix


@pytest.fixture(autouse=True)
def one_thread():
    """The reference's small tensors are not worth torch's threads, which on a busy machine cost seconds."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


NAMES = ("xyz", "t", "velocity", "sigma_t", "covariance", "rgb", "opacity")


def cloud(n, seed=0, scale=(0.01, 0.08), opacity=(0.05, 0.95), sigma_t=(0.2, 0.8)):
    """n random Gaussians in the unit ball as the dict of rasterize's first seven arguments."""
    rng = torch.Generator().manual_seed(seed)

    def uniform(shape, low, high):
        return low + (high - low) * torch.rand(shape, generator=rng)

    direction = torch.nn.functional.normalize(torch.randn(n, 3, generator=rng), dim=1)
    axes = rotation_matrix(torch.nn.functional.normalize(torch.randn(n, 4, generator=rng), dim=1))
    M = axes * torch.exp(uniform((n, 3), math.log(scale[0]), math.log(scale[1])))[:, None]
    return {
        "xyz": direction * uniform((n, 1), 0, 1) ** (1 / 3),
        "t": uniform(n, -1, 1),
        "velocity": 0.3 * torch.randn(n, 3, generator=rng),
        "sigma_t": uniform(n, *sigma_t),
        "covariance": M @ M.mT,
        "rgb": uniform((n, 3), 0, 1),
        "opacity": uniform(n, *opacity),
    }


def cameras(count=3, width=44, height=30, off=(0.0, 0.0), distance=2.7, fov=50):
    """Cameras on a ring, each at its own time, as rasterize's other arguments."""
    poses = []
    for i in range(count):
        a = 0.3 + 2 * math.pi * i / count
        at = distance * torch.tensor([math.cos(a), math.sin(a), 0.3 * math.sin(3 * a)])
        forward = -at / at.norm()
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
        pose = torch.eye(4)
        pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], 1)
        pose[:3, 3] = at
        poses.append(pose)
    f = 0.5 * height / math.tan(math.radians(fov / 2))
    K = torch.tensor([f, 1.1 * f, width / 2 + off[0], height / 2 + off[1]]).expand(count, 4)
    return torch.stack(poses), K, torch.linspace(-0.7, 0.9, count), width, height


AXIS = (torch.eye(4)[None], torch.tensor([[40.0, 40.0, 20.0, 15.0]]), torch.zeros(1), 40, 30)  # looks along +z


def with_gradients(g, view, backend, dtype, **kw):
    g = {k: v.detach().to(dtype).requires_grad_() for k, v in g.items()}
    rgb, alpha = rasterize(*g.values(), *view, backend=backend, **kw)
    rng = torch.Generator().manual_seed(7)
    a, b = torch.randn(rgb.shape, generator=rng), torch.randn(alpha.shape, generator=rng)
    ((rgb * a).sum() + (alpha * b).sum()).backward()
    return rgb.detach().double(), alpha.detach().double(), [v.grad.double() for v in g.values()]


def compare(g, view, **kw):
    """Asserts that the cpu backend equals the reference; returns the reference's (rgb, alpha, gradients)."""
    got, want = (with_gradients(g, view, *how, **kw) for how in (("cpu", torch.float32), ("reference", torch.float64)))
    for a, b in zip(got[:2], want[:2], strict=True):
        assert a.shape == b.shape
        if b.numel():
            error = (a - b).abs().flatten() / max(1, b.abs().max())
            assert error.sort().values[: max(1, int(0.999 * len(error)))].max() < 2e-5
            assert error.max() < 2e-2
    for name, a, b in zip(NAMES, got[2], want[2], strict=True):
        assert a.isfinite().all(), name
        assert (a - b).norm() <= 1e-3 * b.norm() + 1e-9, (name, ((a - b).norm() / b.norm()).item())
    return want


def plane(n, z, **change):
    """A cloud facing the AXIS camera at depth z; everything alive."""
    g = cloud(n, seed=3, **change)
    g["xyz"] = torch.cat([g["xyz"][:, :2] * 0.4 * z, torch.full((n, 1), float(z))], 1)
    g["velocity"] *= 0
    g["sigma_t"] = torch.full((n,), 2.0)
    return g


def scenes():
    ring = cameras()
    yield "random", cloud(150), ring
    yield "one", plane(1, 2.0), AXIS
    yield "none", cloud(0), ring
    yield "tiles", cloud(200, scale=(0.005, 0.3)), cameras(2, 150, 70, off=(9.5, -6.3))
    yield "off-centre", cloud(120), cameras(2, 23, 37, off=(-8.2, 11.1))
    yield "one pixel", cloud(60), cameras(2, 1, 1)
    yield "tiny", cloud(150, scale=(1e-4, 1e-3)), ring
    yield "huge", cloud(60, scale=(0.1, 0.3)), ring
    yield "needles", cloud(80, scale=(1e-4, 0.3)), ring
    yield "opacity near 0 and 1", cloud(150, opacity=(0, 0.01)) | {"opacity": torch.tensor([1e-6, 1 - 1e-6] * 75)}, ring
    yield "opaque stack", plane(150, 2.0, opacity=(0.9, 1.0), scale=(0.05, 0.2)), AXIS
    yield "brief", cloud(90, sigma_t=(1e-3, 2e-3)) | {"t": torch.tensor([-0.7, 0.1, 0.9] * 30) + 1e-3}, ring
    yield "dead", cloud(30) | {"t": torch.full((30,), 50.0)}, ring
    yield "behind", plane(30, -2.0), AXIS
    yield "around the camera", cloud(200), cameras(3, distance=0.4)
    yield "off-screen", plane(30, 2.0) | {"xyz": torch.tensor([5.0, -4.0, 2.0]).repeat(30, 1)}, AXIS
    yield (
        "clamped slope",
        plane(40, 0.5, scale=(0.1, 0.3)) | {"xyz": torch.tensor([[0.5, 0.1, 0.5], [-0.1, 0.4, 0.4]]).repeat(20, 1)},
        AXIS,
    )
    yield "same depth", plane(60, 2.0), AXIS
    yield "near plane", plane(50, 0.02, scale=(1e-4, 0.3)), AXIS
    yield "wild colours", cloud(80) | {"rgb": 40 * torch.randn(80, 3, generator=torch.Generator().manual_seed(1))}, ring
    yield "fast", cloud(80) | {"velocity": torch.tensor([[8.0, -3.0, 1.0]]).repeat(80, 1)}, ring


@pytest.mark.parametrize("g, view", [pytest.param(g, v, id=name) for name, g, v in scenes()])
def test_equals_reference(g, view):
    rgb, alpha, _ = compare(g, view, background=torch.tensor([0.2, 1.0, 0.6]))
    assert rgb.isfinite().all() and alpha.min() >= 0 and alpha.max() <= 1 - 1e-4 + 1e-9


def test_scenes_are_what_they_claim():
    """Otherwise the comparison above could be of empty images."""
    alpha = {name: rasterize(*g.values(), *v)[1] for name, g, v in scenes()}
    empty = {"none", "dead", "behind", "off-screen"}
    assert {name for name, a in alpha.items() if a.max() == 0} == empty
    assert (alpha["opaque stack"] > 0.999).float().mean() > 0.1


def test_reference_by_finite_differences():
    g = {k: v.double() for k, v in plane(4, 2.0, scale=(0.05, 0.3)).items()}
    g["velocity"] = torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64).repeat(4, 1)
    g["sigma_t"] = torch.full((4,), 0.9, dtype=torch.float64)
    view = (AXIS[0].double(), torch.tensor([[5.0, 6.0, 3.1, 2.2]]).double(), torch.tensor([0.2]).double(), 6, 5)

    def f(*inputs):
        return rasterize(*inputs, *view, backend="reference")

    assert torch.autograd.gradcheck(f, [v.clone().requires_grad_() for v in g.values()], eps=1e-6, atol=1e-6)


def test_single_gaussian_by_hand():
    """On the axis at z = 2, isotropic: Σ₂ = (40 · 0.1 / 2)² + 0.3 = 4.3 px², alpha = o · m · exp(-½ d² / 4.3)."""
    g = plane(1, 2.0)
    g |= {"covariance": 0.01 * torch.eye(3)[None], "rgb": torch.tensor([[0.9, 0.5, -0.3]])}
    g |= {"xyz": torch.tensor([[0.0, 0.0, 2.0]]), "t": torch.tensor([0.5]), "sigma_t": torch.tensor([0.5])}
    g["opacity"] = torch.tensor([0.8])
    rgb, alpha = rasterize(*g.values(), *AXIS, background=0.25)
    for x, y in ((20, 15), (22, 14), (17, 15)):
        d2 = (x + 0.5 - 20) ** 2 + (y + 0.5 - 15) ** 2
        a = 0.8 * math.exp(-0.5) * math.exp(-0.5 * d2 / 4.3)
        assert alpha[0, y, x].item() == pytest.approx(a, rel=1e-5)
        want = a * g["rgb"][0] + (1 - a) * 0.25
        torch.testing.assert_close(rgb[0, y, x], want, rtol=1e-5, atol=1e-6)
    assert alpha[0, 0, 0] == 0 and (rgb[0, 0, 0] == 0.25).all()


def test_background():
    g, view = cloud(100), cameras()
    black, alpha = rasterize(*g.values(), *view, background=0.0)
    colour = torch.tensor([0.1, 0.7, 1.5])
    rgb, same = rasterize(*g.values(), *view, background=colour)
    assert torch.equal(alpha, same)
    torch.testing.assert_close(rgb, black + (1 - alpha)[..., None] * colour)
    torch.testing.assert_close(rasterize(*g.values(), *view)[0], black + (1 - alpha)[..., None])


def gaussians(n=120):
    rng = torch.Generator().manual_seed(5)
    g = cloud(n, seed=5)
    scale = 0.02 + 0.1 * torch.rand(n, 3, generator=rng)
    rotation = torch.nn.functional.normalize(torch.randn(n, 4, generator=rng), dim=1)
    return Gaussians4D(*(g[k] for k in ("xyz", "t", "velocity", "sigma_t")), scale, rotation, g["rgb"], g["opacity"])


def test_slice_is_the_conditional_of_the_4d_gaussian():
    """Rendering at τ equals rendering the static 3D Gaussians that the paper's conditional of Σ gives."""
    g, (c2w, K, times, width, height) = gaussians(), cameras()
    cov = g.covariance4().double()
    for i, tau in enumerate(times.tolist()):
        cross, var = cov[:, :3, 3], cov[:, 3, 3]
        mean = g.xyz + (cross * ((tau - g.t) / var)[:, None]).float()
        conditional = (cov[:, :3, :3] - cross[:, :, None] * cross[:, None] / var[:, None, None]).float()
        opacity = g.opacity * torch.exp(-0.5 * (tau - g.t) ** 2 / var).float()
        still, ones = torch.zeros_like(g.xyz), torch.ones_like(g.t)
        view = c2w[i : i + 1], K[i : i + 1], times[i : i + 1], width, height
        want, _ = rasterize(mean, tau * ones, still, ones, conditional, g.rgb, opacity, *view)
        torch.testing.assert_close(render(g, *view)[0], want, rtol=1e-4, atol=2e-5)


def test_scale_and_rotation_do_as_their_covariance():
    """`render` takes them to the compiled code as they are; unit length of a quaternion is not asked for."""
    (c2w, K, times, width, height), results = cameras(), []
    for fused in (True, False):
        g = gaussians().map(lambda x: x.clone().requires_grad_())
        if not fused:
            g.cov3 = g.covariance3()
        rgb, alpha = render(g, c2w, K, times, width, height)
        rng = torch.Generator().manual_seed(7)
        ((rgb * torch.randn(rgb.shape, generator=rng)).sum() + alpha.sum()).backward()
        results.append((rgb.detach(), g.xyz.grad, g.sigma_t.grad, g.scale.grad, g.rotation.grad, g.opacity.grad))
    for a, b in zip(*results, strict=True):
        assert (a - b).norm() <= 1e-5 * b.norm() and b.norm() > 0


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_inference_filters_per_view(backend):
    g, (c2w, K, times, width, height) = gaussians(), cameras()
    got, _ = render(g, c2w, K, times, width, height, inference=True, backend=backend)
    for i, tau in enumerate(times):
        m = g.marginal(tau)
        keep = (m >= 0.05) & (m * g.opacity >= 0.05)
        assert 0 < keep.sum() < len(g)
        want, _ = render(g[keep], c2w[i : i + 1], K[i : i + 1], times[i : i + 1], width, height, backend=backend)
        assert torch.equal(got[i], want[0])
    assert not torch.equal(got, render(g, c2w, K, times, width, height, backend=backend)[0])


def test_same_bits_on_every_run_and_any_number_of_threads():
    g, view = cloud(400), cameras(3, 150, 100)
    runs = []
    for n in (2, 2, 1, 3):
        torch.set_num_threads(n)
        runs.append(with_gradients(g, view, "cpu", torch.float32))
    for rgb, alpha, grads in runs[1:]:
        assert torch.equal(rgb, runs[0][0]) and torch.equal(alpha, runs[0][1])
        assert all(torch.equal(a, b) for a, b in zip(grads, runs[0][2], strict=True))


def test_views_are_independent_and_dtype_is_kept():
    g, (c2w, K, times, width, height) = cloud(100), cameras()
    rgb, _ = rasterize(*(v.double() for v in g.values()), c2w, K, times, width, height)
    assert rgb.dtype == torch.float64
    for i in range(3):
        one, _ = rasterize(*g.values(), c2w[i : i + 1], K[i : i + 1], times[i : i + 1], width, height)
        assert torch.equal(one[0], rgb[i].float())
    none, alpha = rasterize(*g.values(), c2w[:0], K[:0], times[:0], width, height)
    assert none.shape == (0, height, width, 3) and alpha.shape == (0, height, width)


@pytest.mark.parametrize("name", (*NAMES, "c2w", "intrinsics", "time"))
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_not_a_number_is_named(name, bad):
    c2w, K, times, width, height = cameras()
    args = cloud(20) | {"c2w": c2w, "intrinsics": K.clone(), "time": times}
    args[name] = args[name].clone()
    args[name].view(-1)[-1] = bad
    with pytest.raises(ValueError, match=f"{name} has 1 value"):
        rasterize(*args.values(), width, height)


def test_wrong_arguments_are_named():
    g, view = cloud(20), cameras()
    for name in NAMES[1:]:
        with pytest.raises(ValueError, match=f"{name} has shape"):
            rasterize(*(g | {name: g[name][:-1]}).values(), *view)
    with pytest.raises(ValueError, match="opacity has dtype"):
        rasterize(*(g | {"opacity": torch.ones(20, dtype=torch.int64)}).values(), *view)
    with pytest.raises(ValueError, match="background"):
        rasterize(*g.values(), *view, background=torch.zeros(4))
    with pytest.raises(ValueError, match="image size"):
        rasterize(*g.values(), *view[:3], 0, 5)
    with pytest.raises(ValueError, match="backend"):
        rasterize(*g.values(), *view, backend="opengl")


def test_missing_gsplat_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(ImportError, match=r"timesplat\[cuda\]"):
        rasterize(*cloud(3).values(), *cameras(), backend="cuda")


def test_gsplat_is_chosen_only_where_it_is_compiled(monkeypatch, tmp_path):
    monkeypatch.delitem(sys.modules, "gsplat", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "gsplat").mkdir()
    (tmp_path / "gsplat/__init__.py").write_text("raise AssertionError('imported only to look')")
    assert not package._gsplat_is_compiled()
    (tmp_path / "gsplat" / f"csrc{importlib.machinery.EXTENSION_SUFFIXES[-1]}").touch()
    importlib.invalidate_caches()
    assert package._gsplat_is_compiled()
    monkeypatch.setitem(sys.modules, "gsplat", None)  # as if not installed
    assert not package._gsplat_is_compiled()


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU and gsplat")
@pytest.mark.parametrize("name", ["random", "tiles", "opaque stack", "clamped slope"])
def test_gsplat_equals_reference(name):
    pytest.importorskip("gsplat", reason="needs gsplat")
    g, view = next((g, v) for n, g, v in scenes() if n == name)
    want = with_gradients(g, view, "reference", torch.float64)
    g = {k: v.cuda().requires_grad_() for k, v in g.items()}
    rgb, alpha = rasterize(*g.values(), *view, backend="cuda")
    rng = torch.Generator().manual_seed(7)
    a, b = torch.randn(rgb.shape, generator=rng).cuda(), torch.randn(alpha.shape, generator=rng).cuda()
    ((rgb * a).sum() + (alpha * b).sum()).backward()
    assert (rgb.cpu() - want[0]).abs().mean() < 1e-4 and (alpha.cpu() - want[1]).abs().mean() < 1e-4
    for k, x, y in zip(NAMES, g.values(), want[2], strict=True):
        assert (x.grad.cpu() - y).norm() < 1e-2 * y.norm(), k


def test_a_moving_scene_is_drawn_from_its_state_at_each_time():
    g = gaussians()

    class Slices:
        def at(self, t):
            return g.frozen(t)

    c2w, intrinsics, _, width, height = cameras(4)
    args = (c2w, intrinsics, torch.tensor([0.5, -0.2, 0.5, 0.9]), width, height)
    for mine, expected in zip(render(Slices(), *args), render(g, *args), strict=True):
        torch.testing.assert_close(mine, expected, atol=1e-5, rtol=1e-5)


def test_kernels_are_compiled_again_when_a_file_they_share_changes(tmp_path):
    """By itself numba's cache looks only at the file that a function is in."""
    folder = tmp_path / "model" / "rasterize"
    shutil.copytree(Path(package.__file__).parent, folder, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "model" / "gaussians.py").write_text("DynamicScene = Gaussians4D = None")
    code = """
import importlib, numpy
from model.rasterize import project
def hits():
    kernel = importlib.reload(project).all_finite
    kernel((numpy.ones(1, numpy.float32),))
    return sum(kernel.stats.cache_hits.values())
print(hits(), hits())
for name in ("simd.py", "__init__.py"):
    with open("model/rasterize/" + name, "a") as f:
        f.write("# changed")
    print(hits(), hits())
"""
    run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["0", "1"] * 3
