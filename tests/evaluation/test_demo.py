"""The whole road in small: `demo` and `evaluate` from a procedural object to files that others read."""

import json

import pytest
from PIL import Image

from timesplat.cli import main
from timesplat.evaluation.demo import METHODS
from timesplat.model.io.ply import read_ply
from timesplat.model.io.usd_read import read_usd

KEYS = {"psnr", "psnr_fg", "ssim", "psnr_p5", "psnr_worst", "seconds", "gaussians", "gaussians_kept"}


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    assert main(["demo", "--out", str(out), "--size", "32", "--samples", "1"]) == 0
    return out


def test_demo_writes_what_it_promises(out):
    metrics = json.loads((out / "metrics.json").read_text())
    assert set(metrics["methods"]) == set(METHODS)
    assert all(set(m) >= KEYS for m in metrics["methods"].values())
    assert set(metrics["seconds"]) >= {"rendering", "lift", "guided", "deform+quality:balanced", "export"}
    assert metrics["methods"]["lift"]["psnr"] > metrics["methods"]["hull"]["psnr"]
    assert Image.open(out / "comparison.png").width > 300
    with Image.open(out / "turntable.webp") as film:
        assert film.n_frames == 24
    asset = read_ply(out / "asset.ply")
    assert len(asset) == len(read_usd(out / "asset.usdc")) == metrics["methods"]["tracks:5"]["gaussians_kept"]
    assert (out / "asset.blend").read_bytes()[:4] in (b"BLEN", b"\x28\xb5\x2f\xfd")  # plain, or zstd-compressed
    assert not [p for p in out.iterdir() if p.name.startswith(".")]


def test_the_blend_plays_without_the_extension(out):
    """In a Blender with factory settings: places at a fractional frame are those of the asset."""
    import subprocess
    import sys

    import numpy as np

    code = (
        "import bpy, sys, numpy as np\n"
        "bpy.ops.wm.read_factory_settings(use_empty=True)\n"
        "bpy.ops.wm.open_mainfile(filepath=sys.argv[1])\n"
        "scene = bpy.context.scene\n"
        "scene.frame_set(7, subframe=0.5)\n"
        "graph = bpy.context.evaluated_depsgraph_get()\n"
        "meshes = [i.object.data for i in graph.object_instances if i.object.type == 'MESH']\n"
        "points = next(m for m in meshes if len(m.polygons)).vertices\n"
        "flat = np.zeros(3 * len(points), np.float32)\n"
        "points.foreach_get('co', flat)\n"
        "np.save(sys.argv[2], flat.reshape(-1, 8, 3).mean(1))\n"  # the middles of ellipsoids
        "assert not any(m.startswith('timesplat') for m in sys.modules)\n"
    )
    saved = out / "positions.npy"
    done = subprocess.run(
        [sys.executable, "-c", code, str(out / "asset.blend"), str(saved)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    asset = read_ply(out / "asset.ply")
    positions, opacity = asset.at(asset.clip.frame_to_time(7.5))
    seen = np.load(saved)
    visible = positions[opacity >= 0.05]
    assert abs(len(seen) - len(visible)) <= 2 or len(seen) == len(positions)
    low, high = visible.min(0), visible.max(0)
    seen = seen[np.all((seen >= low - 1e-4) & (seen <= high + 1e-4), axis=1)]
    nearest = np.sort(seen[:, 0])[:: max(len(seen) // 50, 1)]
    assert all(np.abs(visible[:, 0] - x).min() < 1e-4 for x in nearest)


def test_evaluate_renders_scores_and_goes_on(tmp_path, capsys):
    words = ["evaluate", "zoo:1000001", "zoo:1000004", "--size", "32", "--samples", "1", "--out", str(tmp_path)]
    assert main([*words, "--methods", "white,lift"]) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert len(metrics["objects"]) == 2 and set(metrics["methods"]) == {"white", "lift"}
    rendered = {p: p.stat().st_mtime_ns for p in (tmp_path / "renders").rglob("*.png")}
    assert len(rendered) == 2 * 48
    assert main([*words, "--methods", "hull"]) == 0
    assert all(p.stat().st_mtime_ns == t for p, t in rendered.items())  # nothing was rendered again
