# SPDX-License-Identifier: GPL-3.0-or-later
"""Does this interpreter, on this computer, reconstruct? A few seconds, and a line for everything that must be there.

The scene is known by hand: a striped sphere that moves on a line, ray-traced exactly, written as a Sequence and read
back, reconstructed, and drawn from a camera that no input had.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from ..datagen.passes import Passes, write_passes
from ..datagen.rigs import Shot, alternating, spherical
from ..datagen.sequence import (
    InputError,
    Sequence,
    View,
    focal_from_fov,
    opengl_to_opencv,
    read_sequence,
    write_sequence,
)

PACKAGES = {"torch": "torch", "numba": "numba", "safetensors": "safetensors", "numpy": "numpy", "pillow": "PIL"}
PACKAGES |= {"tqdm": "tqdm", "OpenEXR": "OpenEXR"}
AGAIN = "install the runtime again in Timesplat's preferences"
SIZE, FRAMES = 48, 8
RADIUS, STEP = 0.5, np.array([0.05, 0.03, 0.02])  # of the sphere, and its way in one frame; normalised units
HELD_OUT = Shot(4, "held_out", "target", spherical(35, 25))
LEAST = 22.0  # dB that a reconstruction of the sphere must reach; its tests say what it reaches
REFINE = 0.5  # seconds
COMPILES = " (compiled now, if never before)"


def selftest(device: str = "cpu", checkpoint: Path | None = None, progress=None) -> list[str]:
    """A list of lines, each "ok …" or "FAILED: what, why; what to do". device: as torch names it; checkpoint: the
    one that is used, None for those that come with Timesplat. `progress(fraction, text)` is called between checks.
    Raises nothing but what the interpreter itself does."""
    report, failed = [], set()
    with tempfile.TemporaryDirectory(prefix="timesplat-", ignore_cleanup_errors=True) as folder:
        s = SimpleNamespace(device=device, checkpoint=checkpoint, folder=Path(folder))
        for i, (check, needs, remedy) in enumerate(CHECKS):
            name = check.__name__.strip("_").replace("_", " ")
            if progress:
                progress(i / len(CHECKS), name + (COMPILES if check in (_lift, _refinement) else ""))
            if because := [n for n in needs if n in failed]:
                failed.add(name)
                report.append(f"FAILED: {name}: not tried; see {because[0]}.")
                continue
            try:
                report.append(f"ok {name}: {check(s)}")
            except InputError as e:
                failed.add(name)
                report.append(f"FAILED: {name}: {e}")
            except Exception as e:
                failed.add(name)
                why = " ".join(str(e).split())[:300]
                report.append(f"FAILED: {name}: {type(e).__name__}: {why}; {remedy}.")
    return report


def _Python(s) -> str:
    return f"{sys.version.split()[0]}, {sys.executable}"


def _packages(s) -> str:
    told, lacking = [], []
    for name, module in PACKAGES.items():
        try:
            importlib.import_module(module)
            told.append(f"{name} {importlib.metadata.version(name)}")
        except Exception as e:  # not there, or a library of it is not
            lacking.append(f"{name} ({' '.join(str(e).split())[:100]})")
    if lacking:
        raise InputError(f"{', '.join(lacking)}: cannot be imported; {AGAIN}, or timesplat[torch] where it runs.")
    return ", ".join(told)


def _device(s) -> str:
    import torch

    from .devices import check_device

    check_device(s.device)
    if s.device.startswith("cuda"):
        about = torch.cuda.get_device_properties(s.device)
        return f"{s.device}, {about.name}, {about.total_memory / 1e9:.1f} GB, CUDA {torch.version.cuda}"
    return f"{s.device}, {torch.get_num_threads()} threads"


def _memory(s) -> str:
    if "SC_PHYS_PAGES" not in getattr(os, "sysconf_names", ()):
        return "not known on this system"
    whole = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9
    if whole < 2:
        raise InputError(f"{whole:.1f} GB in all; take small pictures and few of them, or another computer.")
    return f"{whole:.1f} GB in all"


def _files(s) -> str:
    shots = alternating(list(range(FRAMES)))
    write_sequence(_sequence(shots), s.folder / "sphere", lambda root: _fill(root, shots))
    s.sequence = read_sequence(s.folder / "sphere")
    for i in range(FRAMES):
        s.sequence.load_image(i), s.sequence.load_passes(i)
    return f"{FRAMES} pictures with depth and motion written and read"


def _lift(s) -> str:
    text, s.lifted = _reconstruct(s, "lift")
    return text


def _checkpoints(s) -> str:
    from .checkpoints_io import CHECKPOINTS, load_network

    files = [Path(s.checkpoint)] if s.checkpoint else sorted(CHECKPOINTS.glob("*.safetensors"))
    if not files:
        raise InputError(f"{CHECKPOINTS}: no checkpoint is there; install Timesplat again.")
    told = []
    for file in files:
        network = load_network(file, s.device)
        told.append(f"{file.stem} ({sum(p.numel() for p in network.parameters()) / 1e6:.1f} M weights)")
    return ", ".join(told)


def _network(s) -> str:
    # A checkpoint of the user's may be half trained: its quality is told, not judged.
    return _reconstruct(s, "guided", judged=not s.checkpoint)[0]


def _refinement(s) -> str:
    text, _ = _reconstruct(s, "lift", refine=REFINE)
    return text


def _USD(s) -> str:
    try:
        from pxr import Usd
    except ImportError:
        return "usd-core is not there; all but export and import of USD works"
    from .io.asset import Clip
    from .io.usd_check import check_usd
    from .io.usd_read import read_usd
    from .io.usd_write import write_usd

    asset = s.lifted.to_asset(Clip(24.0, 0, FRAMES - 1))
    path = s.folder / "sphere.usdc"
    write_usd(path, asset)
    if complaints := check_usd(path):
        raise InputError(f"{complaints[0]}; {AGAIN}.")
    version = ".".join(map(str, Usd.GetVersion()[1:]))
    return f"{len(read_usd(path))} Gaussians written, checked and read (OpenUSD {version})"


# check, the checks that it stands on, what to do where it fails with an error of Python's
CHECKS: list[tuple[Callable, tuple[str, ...], str]] = [
    (_Python, (), ""),
    (_packages, (), AGAIN),
    (_device, ("packages",), "choose another device in Timesplat's preferences"),
    (_memory, (), ""),
    (_files, ("packages",), f"{AGAIN}, and see that the disk has room"),
    (_lift, ("files",), AGAIN),
    (_checkpoints, ("device",), "install Timesplat again, or name another checkpoint"),
    (_network, ("files", "checkpoints"), "choose the CPU in Timesplat's preferences, or another checkpoint"),
    (_refinement, ("device", "lift"), "choose the CPU in Timesplat's preferences"),
    (_USD, ("lift",), AGAIN),
]


def _reconstruct(s, method: str, refine: float = 0.0, judged: bool = True):
    """What to say, and the scene; raises InputError where the held-out picture is off."""
    import torch

    from .rasterize import render
    from .reconstruct import ReconstructOptions, reconstruct

    start = time.monotonic()
    checkpoint = s.checkpoint if method == "guided" else None
    options = ReconstructOptions(device=s.device, checkpoint=checkpoint, refine=refine)
    scene = reconstruct(s.sequence, method, options=options)
    seconds = time.monotonic() - start
    c2w, intrinsics = _sequence([HELD_OUT]).cameras()
    moment = torch.tensor(s.sequence.times()[[HELD_OUT.frame]])
    with torch.no_grad():
        drawn, _ = render(scene, torch.tensor(c2w), torch.tensor(intrinsics), moment, SIZE, SIZE)
    truth, _ = _picture(HELD_OUT)
    alpha = truth[..., 3:]
    error = np.square(drawn[0].clamp(0, 1).numpy() - truth[..., :3] * alpha - (1 - alpha)).mean()
    quality = -10 * np.log10(max(error, 1e-10))
    if judged and not quality >= LEAST:
        raise InputError(f"a new view is {quality:.1f} dB from the truth instead of {LEAST:.0f} or more; {AGAIN}.")
    return f"{len(scene)} Gaussians in {seconds:.1f} s, {quality:.1f} dB on a new view", scene


# ---------------------------------------------------------------- the scene


def _sequence(shots: list[Shot]) -> Sequence:
    f = focal_from_fov(50, SIZE)
    views = [View(x.frame, x.camera, x.rig, x.c2w, f, f, SIZE / 2, SIZE / 2) for x in shots]
    for i, view in enumerate(views):
        view.image, view.passes = f"images/{i}.png", f"passes/{i}.exr"
    return Sequence(SIZE, SIZE, 24.0, 0, FRAMES - 1, views=views, provenance={"asset": "self-test"})


def _fill(root: Path, shots: list[Shot]) -> None:
    from PIL import Image

    (root / "images").mkdir()
    (root / "passes").mkdir()
    for i, shot in enumerate(shots):
        rgba, passes = _picture(shot)
        Image.fromarray((rgba * 255).round().astype(np.uint8)).save(root / f"images/{i}.png")
        write_passes(root / f"passes/{i}.exr", passes)


def _picture(shot: Shot) -> tuple[np.ndarray, Passes]:
    """(SIZE,SIZE,4) RGBA 0..1 and the passes of what a camera sees."""
    c2w, f = opengl_to_opencv(shot.c2w), focal_from_fov(50, SIZE)
    here = np.stack(np.meshgrid(*[np.arange(SIZE) + 0.5] * 2), -1)  # x, y
    ray = np.concatenate([(here - SIZE / 2) / f, np.ones((SIZE, SIZE, 1))], -1) @ c2w[:3, :3].T
    centre = STEP * (shot.frame - (FRAMES - 1) / 2)
    off = c2w[:3, 3] - centre
    a, b, c = (ray**2).sum(-1), ray @ off, off @ off - RADIUS**2
    hit = b * b > a * c
    z = np.where(hit, (-b - np.sqrt(np.maximum(b * b - a * c, 0))) / a, np.inf).astype(np.float32)
    point = c2w[:3, 3] + np.where(hit, z, 0)[..., None] * ray - centre
    shade = 0.7 + 0.3 * np.sin(5 * point[..., 2:] / RADIUS)
    rgba = np.concatenate([np.array([0.9, 0.5, 0.2]) * shade, np.ones((SIZE, SIZE, 1))], -1) * hit[..., None]

    def flow(frames: int) -> np.ndarray:
        q = (point + centre + frames * STEP - c2w[:3, 3]) @ c2w[:3, :3]
        there = q[..., :2] / np.where(hit, q[..., 2], 1)[..., None] * f + SIZE / 2
        return ((there - here) * hit[..., None]).astype(np.float32)

    return rgba, Passes(z, flow(1), flow(-1))
