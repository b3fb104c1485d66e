"""Shared by all tests: the --slow switch, and what makes every run the same."""

import itertools

import pytest
from hypothesis import HealthCheck, settings

# The same examples on every run, however slow the machine is, and none kept from run to run. To search for new ones:
# pytest --hypothesis-profile=default
settings.register_profile(
    "same", derandomize=True, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("same")


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="also run the tests that take minutes")


def pytest_collection_modifyitems(config, items):
    if config.getoption("--slow"):
        return
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="slow: run with --slow"))


@pytest.fixture(scope="session", autouse=True)
def no_weights(tmp_path_factory):
    """Weights of VGG and LPIPS that the user may have are not there; tests of them bring their own."""
    with pytest.MonkeyPatch.context() as m:
        m.setenv("TORCH_HOME", str(tmp_path_factory.mktemp("torch")))
        m.delenv("TIMESPLAT_WEIGHTS", raising=False)
        yield


@pytest.fixture
def steady_clock(monkeypatch):
    """A fit of so many seconds takes as many steps on every machine: each look at its clock is 10 ms later."""
    ticks = itertools.count()
    for module in ("loop", "refine"):
        monkeypatch.setattr(f"timesplat.model.fitting.{module}.work_clock", lambda: 0.01 * next(ticks))


@pytest.fixture(scope="session")
def spheres():
    """A scene known by hand, ray-traced in float64: three striped spheres that move on straight lines.
    `spheres(frames, cameras=…, size=…)` -> Views with exact depth, flow and alpha (no anti-aliasing), one view
    a frame; `spheres.truth(points, frame)` -> velocity per frame of the sphere that each point lies on."""
    import numpy as np
    import torch

    from timesplat.datagen.rigs import spherical
    from timesplat.datagen.sequence import focal_from_fov, opengl_to_opencv
    from timesplat.model.views import Views, camera_rays

    centre = np.array([[-0.35, 0.0, 0.1], [0.4, -0.2, -0.3], [0.2, 0.35, 0.4]])
    motion = np.array([[0.02, 0.01, 0.0], [-0.01, 0.0, 0.02], [0.0, -0.025, 0.0]])  # per frame
    radius = np.array([0.38, 0.3, 0.25])
    colour = np.array([[0.9, 0.3, 0.2], [0.2, 0.6, 0.9], [0.9, 0.8, 0.2]])

    def make(frames, cameras=None, size=48, count=24):
        """frames: list of frame numbers 0..count-1; cameras: (azimuth, elevation) of each in degrees."""
        cameras = cameras or [(90 * (f % 4), 0) for f in frames]
        c2w = np.stack([opengl_to_opencv(spherical(*c)) for c in cameras])
        f = focal_from_fov(50, size)
        K = np.tile([f, f, size / 2, size / 2], (len(frames), 1))
        local = camera_rays(torch.tensor(K), size, size).numpy().astype(np.float64)
        shape = (len(frames), size, size)
        depth, rgb, flow = np.full(shape, np.inf), np.zeros((*shape, 3)), np.zeros((*shape, 4))
        for v, frame in enumerate(frames):
            o, R = c2w[v, :3, 3], c2w[v, :3, :3]
            d = local[v] @ R.T
            for c, m, r, paint in zip(centre, motion, radius, colour, strict=True):
                at = c + m * (frame - (count - 1) / 2)
                a, b = (d * d).sum(-1), (d * (o - at)).sum(-1)
                disc = b * b - a * ((o - at) @ (o - at) - r * r)
                z = np.where(disc > 0, (-b - np.sqrt(np.maximum(disc, 0))) / a, np.inf)
                hit = (z > 0) & (z < depth[v])
                p = o + np.where(hit, z, 0)[..., None] * d
                stripe = 0.75 + 0.25 * np.sin(9 * (p - at)[..., 2] / r)
                for k, sign in enumerate((1, -1)):
                    q = (p + sign * m - o) @ R
                    pixel = q[..., :2] / np.where(hit, q[..., 2], 1)[..., None] * f + size / 2
                    here = (local[v][..., :2]) * f + size / 2
                    flow[v][hit, 2 * k : 2 * k + 2] = (pixel - here)[hit]
                depth[v][hit], rgb[v][hit] = z[hit], (paint * stripe[..., None])[hit]
        tensors = [torch.tensor(x, dtype=torch.float32) for x in (rgb, np.isfinite(depth), c2w, K)]
        time = torch.tensor([2 * x / (count - 1) - 1 for x in frames], dtype=torch.float32)
        views = Views(*tensors, time, 2 / (count - 1))
        views.depth, views.flow = (torch.tensor(x, dtype=torch.float32) for x in (depth, flow))
        return views

    def truth(points, frame, count=24):
        """points (N,3) on the surfaces at a frame (scalar or (N,)) -> (N,3) velocity per frame."""
        at = centre + motion * (np.asarray(frame).reshape(-1, 1, 1) - (count - 1) / 2)
        off = np.abs(np.linalg.norm(points[:, None] - at, axis=-1) - radius)
        return motion[off.argmin(1)]

    make.truth = truth
    return make


@pytest.fixture(scope="session")
def write_views():
    """write_views(views, folder, targets=None) -> the Sequence of Views (24 frames) on disk; views of `targets`
    are of rig "target"."""
    import torch
    from PIL import Image

    from timesplat.datagen.passes import Passes, write_passes
    from timesplat.datagen.sequence import Sequence, View, opengl_to_opencv, write_sequence

    def write(views, folder, targets=None):
        height, width = views.size
        parts = [(views, "input")] + ([(targets, "target")] if targets is not None else [])
        seq = Sequence(width, height, 24.0, 0, 23, provenance={"asset": "spheres"})
        data = []
        for v, rig in parts:
            for i in range(len(v)):
                frame = round(float(v.time[i]) * 11.5 + 11.5)
                c2w = opengl_to_opencv(v.c2w[i].double().numpy())
                seq.views.append(View(frame, f"{rig}{i}", rig, c2w, *map(float, v.intrinsics[i])))
                data.append((v, i))

        def fill(root):
            (root / "images").mkdir()
            (root / "passes").mkdir()
            for n, (view, (v, i)) in enumerate(zip(seq.views, data, strict=True)):
                view.image, view.passes = f"images/{n:03d}.png", f"passes/{n:03d}.exr"
                rgba = torch.cat([v.rgb[i], v.alpha[i][..., None]], -1)
                Image.fromarray((rgba * 255).round().to(torch.uint8).numpy()).save(root / view.image)
                flow = v.flow[i].numpy()
                write_passes(root / view.passes, Passes(v.depth[i].numpy(), flow[..., :2], flow[..., 2:]))

        return write_sequence(seq, folder, fill)

    return write


@pytest.fixture(scope="session")
def sphere_folder(spheres, write_views, tmp_path_factory):
    """A Sequence on disk: 24 alternating views of the spheres at 32x32, and 6 held-out ones."""
    import numpy as np

    rng = np.random.default_rng(0)
    frames = list(range(0, 24, 4))
    held_out = spheres(frames, [(rng.uniform(0, 360), rng.uniform(-30, 60)) for _ in frames], size=32)
    folder = tmp_path_factory.mktemp("data") / "spheres" / "line"
    write_views(spheres(list(range(24)), size=32), folder, held_out)
    return folder


@pytest.fixture
def pictures(sphere_folder, tmp_path):
    """The same Sequence as `--no-passes` leaves it."""
    import json
    import shutil

    folder = tmp_path / "pictures"
    shutil.copytree(sphere_folder, folder, ignore=shutil.ignore_patterns("passes"))
    data = json.loads((folder / "transforms.json").read_text())
    for frame in data["frames"]:
        del frame["exr_path"]
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder
