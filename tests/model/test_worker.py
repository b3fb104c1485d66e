# SPDX-License-Identifier: GPL-3.0-or-later
"""The worker's protocol, spoken to as the add-on does: a process, JSON in, JSON lines out."""

import json
import subprocess
import sys
import time

import numpy as np
import pytest

from timesplat.datagen.passes import Passes, write_passes
from timesplat.datagen.sequence import Sequence, View, focal_from_fov, opengl_to_opencv
from timesplat.datagen.sequence import write_sequence as write
from timesplat.model.io.asset import ARRAYS, Asset, Clip
from timesplat.model.io.ply import read_ply, write_ply
from timesplat.model.io.slices import write_slice


def ask(*argv, stdin="", code=None):
    command = [sys.executable, "-c", code] if code else [sys.executable, "-m", "timesplat.model.worker"]
    run = subprocess.run([*command, *map(str, argv)], input=stdin, capture_output=True, text=True, timeout=600)
    return run.returncode, [json.loads(line) for line in run.stdout.splitlines()], run.stderr


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """A sphere of radius 0.6 that stands still, seen by four cameras at four frames."""
    from PIL import Image

    from timesplat.datagen.rigs import alternating

    size = 32
    focal = focal_from_fov(50, size)
    shots = alternating(list(range(4)))
    views = [View(s.frame, s.camera, s.rig, s.c2w, focal, focal, size / 2, size / 2) for s in shots]
    seq = Sequence(size, size, 24.0, 0, 3, views=views)

    def fill(folder):
        y, x = np.mgrid[:size, :size] + 0.5
        d = np.stack([(x - size / 2) / focal, (y - size / 2) / focal, np.ones_like(x)], -1)
        for i, v in enumerate(views):
            c2w = opengl_to_opencv(v.c2w)
            ray = d @ c2w[:3, :3].T
            a, b, c = (ray**2).sum(-1), ray @ c2w[:3, 3], (c2w[:3, 3] ** 2).sum() - 0.36
            hit = b * b - a * c > 0
            z = np.where(hit, (-b - np.sqrt(np.maximum(b * b - a * c, 0))) / a, np.inf).astype(np.float32)
            rgba = np.dstack([np.full((size, size, 3), 180), hit * 255]).astype(np.uint8)
            v.image, v.passes = f"{i}.png", f"{i}.exr"
            Image.fromarray(rgba).save(folder / v.image)
            write_passes(folder / v.passes, Passes(z, *np.zeros((2, size, size, 2), np.float32)))

    folder = tmp_path_factory.mktemp("worker") / "sphere"
    write(seq, folder, fill)
    return folder


def test_lift(tmp_path, sequence):
    asset = tmp_path / "a.ply"
    (tmp_path / "r.json").write_text(json.dumps({"sequence": str(sequence), "asset": str(asset), "method": "lift"}))
    code, said, _ = ask(tmp_path / "r.json")
    assert code == 0 and said[-1]["event"] == "done" and said[-1]["asset"] == str(asset)
    steps = [s["fraction"] for s in said[:-1]]
    assert len(steps) > 2 and steps == sorted(steps) and all(s["event"] == "progress" and s["text"] for s in said[:-1])
    a = read_ply(asset)
    assert len(a) == said[-1]["gaussians"] > 100 and (a.clip.frame_start, a.clip.frame_end) == (0, 3)
    np.testing.assert_allclose(a.clip.pixel, 2.7 * 2 * np.tan(np.radians(25)) / 32, rtol=1e-6)
    assert np.abs(np.linalg.norm(a.xyz, axis=1) - 0.6).max() < 0.1


@pytest.mark.parametrize(
    ("request_", "word"),
    [
        ("", "cannot be read"),
        ("{", "cannot be read"),
        ("[]", "not an object"),
        ('{"asset": "a.ply"}', "sequence is missing"),
        ('{"sequence": 3, "asset": "a"}', "sequence must be a text"),
        ('{"sequence": "nowhere", "asset": "a.ply", "method": "lift"}', "nowhere"),
        ('{"colour": 1}', "unknown key colour"),
        ('{"task": "dance"}', "no task dance; choose one of reconstruct, export, import, video, selftest"),
        ('{"task": "export", "asset": "a.ply"}', "out is missing"),
        ('{"task": "export", "asset": "a.ply", "out": "a.usdc", "half": 1}', "half must be true or false"),
        ('{"task": "export", "asset": "nowhere.ply", "out": "a.usdc"}', "nowhere.ply"),
        ('{"task": "import", "asset": "a.ply"}', "source is missing"),
        ('{"task": "import", "source": "nowhere.usdc", "asset": "a.ply"}', "nowhere.usdc: no such file"),
        ('{"sequence": "a", "asset": "b", "refine": true}', "refine must be a number"),
    ],
)
def test_bad_requests_are_answered_with_one_sentence(request_, word):
    code, said, _ = ask(stdin=request_ + "\n")
    assert code == 1 and said[-1]["event"] == "error"
    assert word in said[-1]["message"] and "\n" not in said[-1]["message"]


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"refine": -1}, "-1 seconds of refinement: give 0 or more"),
        ({"budget": "half"}, "half: no budget"),
        ({"quality": "superb"}, "superb: no such quality"),
        ({"quality": "draft", "refine": 1}, "quality and refine: each says how long"),
        ({"budget": "auto", "max_loss": 0}, "0 dB of loss"),
        ({"indices": [0, 99]}, "it has no view 99; give numbers from 0 to 3"),
        ({"indices": ["a"]}, "it has no view 'a'"),
    ],
)
def test_impossible_wishes_are_refused_before_the_work(tmp_path, sequence, options, word):
    request = {"sequence": str(sequence), "asset": str(tmp_path / "a.ply"), "method": "lift", **options}
    code, said, _ = ask(stdin=json.dumps(request) + "\n")
    assert code == 1 and word in said[-1]["message"]
    assert [s["text"] for s in said[:-1]] == ["starting"] and not list(tmp_path.iterdir())


def test_a_budget_and_refinement_are_passed_on(tmp_path, sequence):
    """The lift alone makes more than 100 of this; a fit as short as this may leave a few more than the budget."""
    request = {"sequence": str(sequence), "asset": str(tmp_path / "a.ply"), "method": "lift"}
    code, said, _ = ask(stdin=json.dumps({**request, "refine": 0.2, "budget": "50", "max_loss": 0.5}) + "\n")
    assert code == 0, said
    assert 0 < said[-1]["gaussians"] == len(read_ply(tmp_path / "a.ply")) < 100


NOISY = """
import os, sys
from timesplat.model import worker
def noisy(request, progress):
    print("a library speaks")
    os.write(1, b"and C too\\n")
    os.system("echo and a child")
    progress(0.5, "half")
    raise RuntimeError("many\\nlines")
worker._reconstruct = noisy
sys.exit(worker.main([]))
"""


def test_what_libraries_print_does_not_reach_the_protocol():
    code, said, err = ask(stdin='{"sequence": "a", "asset": "b"}\n', code=NOISY)
    assert [s["event"] for s in said] == ["progress", "error"] and code == 1
    assert said[1]["message"] == "The reconstruction stopped with RuntimeError: many lines"
    for words in ("a library speaks", "and C too", "and a child", "Traceback"):
        assert words in err


TALK = """
import sys
from types import ModuleType
fake = sys.modules["timesplat.model.selftest"] = ModuleType("selftest")
def selftest(device, checkpoint, progress):
    progress(0.5, "half")
    return [device, str(checkpoint)]
fake.selftest = selftest
from timesplat.model import worker
sys.exit(worker.main([]))
"""


def test_the_self_test_is_asked_and_its_report_handed_on():
    code, said, _ = ask(stdin='{"task": "selftest", "device": "cuda", "checkpoint": "a.safetensors"}\n', code=TALK)
    assert code == 0 and said[0]["text"] == "half"
    assert said[-1]["event"] == "done" and said[-1]["report"] == ["cuda", "a.safetensors"]


LISTING = """
import json, sys
from timesplat.model import worker
code = worker.main([])
loaded = [name for name, module in sys.modules.items() if getattr(module, "__file__", None)]
print(json.dumps({"loaded": loaded}), file=sys.__stderr__)
sys.exit(code)
"""
HEAVY = ["torch._meta_registrations", "torch._dynamo", "torch._inductor", "sympy", "networkx", "scipy", "matplotlib"]
HEAVY += ["pandas", "bpy", "pxr", "pytest", "IPython", "timesplat.model.training", "timesplat.evaluation"]


@pytest.mark.parametrize("method", ["guided", "rgb"])
def test_nothing_heavy_is_imported_that_it_does_not_use(tmp_path, sequence, method):
    request = {"sequence": str(sequence), "asset": str(tmp_path / "a.ply"), "method": method}
    code, said, err = ask(stdin=json.dumps(request) + "\n", code=LISTING)
    assert code == 0 and said[-1]["gaussians"] > 100
    loaded = json.loads(err.splitlines()[-1])["loaded"]
    assert "torch" in loaded and "numba" in loaded
    assert [name for name in HEAVY if name in loaded] == []


def test_usd_and_back_without_torch(tmp_path):
    pytest.importorskip("pxr")
    rng = np.random.default_rng(0)
    n = 20
    one = {"t": rng.uniform(-1, 1, n), "sigma_t": rng.uniform(0.1, 1, n), "opacity": rng.uniform(0.1, 1, n)}
    three = {k: rng.uniform(0.01, 0.5, (n, 3)) for k in ("xyz", "velocity", "scale", "rgb")}
    arrays = {**one, **three, "rotation": np.tile([1, 0, 0, 0], (n, 1))}
    asset = Asset(**{k: v.astype(np.float32) for k, v in arrays.items()}, clip=Clip(25, 3, 9, 2.0, (1, 2, 3)))
    ply, usd, back = (str(tmp_path / name) for name in ("a.ply", "a.usdz", "b.ply"))
    write_ply(ply, asset)
    write = {"task": "export", "asset": ply, "out": usd, "mode": "frames", "half": False, "watch": None}
    for request in (write, {"task": "import", "source": usd, "asset": back}):
        code, said, err = ask(stdin=json.dumps(request) + "\n", code=LISTING)
        assert code == 0 and said[0]["event"] == "progress", said
        loaded = json.loads(err.splitlines()[-1])["loaded"]
        assert "pxr" in loaded and not {"torch", "numba", "bpy", "PIL"} & set(loaded)
        if request["task"] == "export":
            assert {"event", "out", "complaints", "bytes", "seconds"} == set(said[-1])
            assert said[-1]["complaints"] == [] and said[-1]["bytes"] == (tmp_path / "a.usdz").stat().st_size
    assert said[-1]["gaussians"] == n and said[-1]["asset"] == back
    code, said, _ = ask(stdin=json.dumps({**write, "original": str(tmp_path / "none.usd")}) + "\n")
    assert code == 1 and "none.usd: no such file" in said[-1]["message"]
    code, said, _ = ask(stdin=json.dumps({**write, "original": usd, "out": str(tmp_path / "c.usdz")}) + "\n")
    assert code == 0 and said[-1]["complaints"] == []
    a, b = read_ply(ply), read_ply(back)
    assert a.clip == b.clip
    for name in ARRAYS:
        np.testing.assert_allclose(getattr(b, name), getattr(a, name), atol=3e-6, err_msg=name)
    (tmp_path / "d.usdc").write_bytes((tmp_path / "a.ply").read_bytes())
    request |= {"source": str(tmp_path / "d.usdc")}
    code, said, _ = ask(stdin=json.dumps(request) + "\n")
    assert code == 1 and "d.usdc" in said[-1]["message"]


def test_slices_and_films_for_blender(tmp_path):
    """What Blender lacks libraries for: .sog, folders of them, and films."""
    pytest.importorskip("PIL")
    r = np.random.default_rng(0)
    n = 9
    one = {"t": np.zeros(n), "sigma_t": np.full(n, 9.0), "opacity": np.full(n, 0.9)}
    three = {"xyz": r.uniform(-0.5, 0.5, (n, 3)), "velocity": np.zeros((n, 3)), "scale": np.full((n, 3), 0.1)}
    arrays = {**one, **three, "rgb": r.uniform(0, 1, (n, 3)), "rotation": np.tile([1, 0, 0, 0], (n, 1))}
    asset = Asset(**{k: v.astype(np.float32) for k, v in arrays.items()}, clip=Clip(24, 3, 4, 2.0, (1, 2, 3)))
    write_ply(tmp_path / "a.ply", asset)
    (tmp_path / "frames").mkdir()
    for frame in (3, 4):
        write_slice(tmp_path / f"frames/x_{frame:04d}.ply", asset, frame)
    ply, back = str(tmp_path / "a.ply"), str(tmp_path / "b.ply")

    def answer(**request) -> dict:
        code, said, _ = ask(stdin=json.dumps(request) + "\n")
        assert code == 0, said
        return said[-1]

    assert answer(task="export", asset=ply, out=str(tmp_path / "a.sog"), frame=3)["complaints"] == []
    told = answer(task="import", source=str(tmp_path / "a.sog"), asset=back)
    assert told["gaussians"] == n and told["up"] == "-Y" and len(read_ply(back)) == n
    assert answer(task="export", asset=str(tmp_path / "frames"), out=str(tmp_path / "s"), suffix=".sog")["files"] == 2
    files = sorted((tmp_path / "s").iterdir())
    assert [f.name for f in files] == ["s_0003.sog", "s_0004.sog"]
    told = answer(
        task="import", source=str(files[0]), sources=[str(f) for f in files], asset=back, fps=12, frame_start=3
    )
    assert told["gaussians"] == 2 * n and read_ply(back).clip.frames == range(3, 5) and read_ply(back).clip.fps == 12
    told = answer(task="video", asset=ply, out=str(tmp_path / "t.webp"), size=[32, 24], plays=2)
    assert told["pictures"] == 4 and (tmp_path / "t.webp").is_file()
    code, said, _ = ask(stdin=json.dumps({"task": "video", "asset": ply, "out": "t.gif"}) + "\n")
    assert code == 1 and "films are .mp4 or .webp" in said[-1]["message"]


WAITING = """
import sys, time
from timesplat.model import worker
worker._reconstruct = lambda request, progress: (progress(0, "x"), time.sleep(999))
sys.exit(worker.main([]))
"""


def test_it_leaves_when_the_program_that_asked_is_gone():
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", WAITING], stdin=pipe, stdout=pipe, text=True) as p:
        p.stdin.write('{"sequence": "a", "asset": "b", "watch": true}\n')
        p.stdin.flush()
        assert "progress" in p.stdout.readline()
        time.sleep(0.2)
        assert p.poll() is None
        p.stdin.close()
        assert p.wait(120) == 3
