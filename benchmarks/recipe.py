# SPDX-License-Identifier: GPL-3.0-or-later
"""What pictures of one object cost, by the field's recipe and by ours: one way a process, as the recipe has it.

    python -m timesplat.benchmarks.recipe ASSET WAY SIZE FOLDER [CORE]     # pictures and result.json into FOLDER

`timesplat bench --recipe` runs it. The recipe is that of Objaverse-XL's and TRELLIS's render scripts: a process an
object, one `render()` an image, nothing kept in between, 128 samples, denoised, RGBA as PNG. All ways see the same
light, cameras and frames, and have one thread; what the recipe's own normalisation costs is not counted. Seconds are
the processor's, from the start of the process.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from timesplat.datagen.render_job import zoo_seed

SIZE = 512
CAMERAS = (0, 4)  # of the six of the rig `default`: the front, and one that is elevated
FRAMES = (0, 12)  # of clips of 24
TRUTH = "truth"


@dataclass(frozen=True)
class Way:
    """How pictures are made. filter: Cycles' name, and its width in pixels."""

    samples: int
    ours: bool = False
    filter: tuple[str, float] = ("BLACKMAN_HARRIS", 1.5)
    few_bounces: bool = False  # 1 diffuse, 1 glossy, 3 transparent, 3 transmission
    denoised: bool = False
    seed: int = 0


WAYS = {
    TRUTH: Way(512, ours=True, seed=1000),  # whose samples are not among those compared with it
    "Objaverse-XL": Way(128, filter=("BLACKMAN_HARRIS", 0.01), few_bounces=True, denoised=True),
    "TRELLIS": Way(128, filter=("BOX", 1.0), few_bounces=True, denoised=True),
    "128 samples alone": Way(128),  # neither denoised nor short of bounces, with our filter
    "16 samples alone": Way(16),
    **{f"ours, {n}": Way(n, ours=True) for n in (1, 2, 4, 8, 16, 32, 64, 128)},
}


class Stages:
    """Processor seconds by the name of what took them."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.process_time()
        try:
            yield
        finally:
            self.seconds[name] += time.process_time() - start

    def timed(self, name: str, call: Callable) -> Callable:
        """The function, whose calls count as that stage."""

        def wrapped(*args, **kwargs):
            with self.stage(name):
                return call(*args, **kwargs)

        return wrapped


def measure(asset: str, way: Way, size: int, folder: Path) -> dict:
    """Pictures into `folder`; {"start", "import", "measure": seconds an object; "image": seconds of one more image;
    "stages": of which; "images": how many were made; "total": seconds}. In a process with bpy that has done nothing
    else."""
    import bpy  # noqa: F401

    stages = Stages()
    stages.seconds["start"] = time.process_time()
    with stages.stage("import"):
        frames = _open(asset)
    with stages.stage("measure"):
        from timesplat.datagen.scene.measure import normalisation

        norm, _ = normalisation(frames, name=asset)
    shoot = _shoot_ours if way.ours else _shoot_recipe
    result = shoot(way, size, [frames[i] for i in FRAMES], norm, folder, stages)
    if not way.ours:
        result["total"] -= stages.seconds["measure"]
        stages.seconds["measure"] = 0.0
    return {name: stages.seconds[name] for name in ("start", "import", "measure")} | result


def _open(asset: str) -> list:
    """Opens it -> the scene's frames, 24."""
    from timesplat.datagen.scene.open import empty_session, open_asset
    from timesplat.datagen.zoo.build import build_object

    if seed := zoo_seed(asset):
        empty_session()
        build_object(int(seed))
        return list(range(1, 25))
    opened = open_asset(Path(asset))
    opened.play(opened.clips[0])
    return opened.clips[0].frames(24)


def _shots() -> list:
    from timesplat.datagen.rigs import RIGS

    by_frame = [[s for s in RIGS["default"](range(len(FRAMES)), 0) if s.frame == f] for f in range(len(FRAMES))]
    return [shots[i] for shots in by_frame for i in CAMERAS]


def _shoot_ours(way: Way, size: int, frames: list, norm, folder: Path, stages: Stages) -> dict:
    """As `timesplat render` does; the stages are those of all frames but the first, which holds the start of Cycles."""
    from timesplat.datagen import capture as c
    from timesplat.datagen.render_setup import CaptureSettings, MultiViewCameras

    times: list[tuple[float, int, Counter]] = []
    of: dict[str, tuple] = {
        "render": (MultiViewCameras, "render"),
        "EXR of Blender": (c, "_read"),
        "PNG": (c, "write_png"),
        "EXR": (c, "write_passes"),
    }
    for name, (owner, attribute) in of.items():
        setattr(owner, attribute, stages.timed(name, getattr(owner, attribute)))

    def shoot(samples: int, out: Path) -> Counter:
        """-> seconds an image by stage, and under "image" of all that it takes."""
        times.clear()
        settings = CaptureSettings(size=size, samples=samples, threads=1, seed=way.seed)
        c.capture(
            _shots(), out, c.Subject(frames, norm), settings,
            progress=lambda done, total: times.append((time.process_time(), done, Counter(stages.seconds))),
        )  # fmt: skip
        (start, first, before), (end, last, after) = times[0], times[-1]
        spent = {name: (after[name] - before[name]) / (last - first) for name in of}
        return Counter({"image": (end - start) / (last - first), **spent})

    spent = shoot(way.samples, folder / "sequence")
    total = time.process_time()
    start = shoot(1, folder / ".once")["render"]
    image = spent.pop("image")
    return {"image": image, "images": len(_shots()), "total": total} | {"stages": _split(spent, start, way.samples)}


def _shoot_recipe(way: Way, size: int, frames: list, norm, folder: Path, stages: Stages) -> dict:
    """A camera that is moved, and one render an image."""
    import bpy

    from timesplat.datagen.render_setup import CaptureSettings, MultiViewCameras, add_even_light, apply_settings

    scene = bpy.context.scene
    add_even_light(scene, [])
    apply_settings(scene, CaptureSettings(size=size, samples=way.samples, passes=False, threads=1))
    scene.render.use_persistent_data = False
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = way.filter
    if way.few_bounces:
        scene.cycles.diffuse_bounces = scene.cycles.glossy_bounces = 1
        scene.cycles.transparent_max_bounces = scene.cycles.transmission_bounces = 3
    image = scene.render.image_settings
    if hasattr(image, "media_type"):  # Blender 5
        image.media_type = "IMAGE"
    image.file_format, image.color_mode, image.color_depth = "PNG", "RGBA", "8"
    scene.view_settings.view_transform, scene.render.dither_intensity = "Standard", 0
    camera = MultiViewCameras(scene, [], norm)

    def shoot(name: str, out: Path) -> float:
        """-> seconds an image"""
        before = stages.seconds[name]
        for i, shot in enumerate(_shots()):
            scene.frame_set(frames[shot.frame])
            camera.place([shot])
            scene.render.filepath = str(out / f"{i}.png")
            with stages.stage(name):
                bpy.ops.render.render(write_still=True)
        return (stages.seconds[name] - before) / len(_shots())

    scene.cycles.use_denoising = way.denoised
    start = time.process_time()
    spent = Counter(render=shoot("render", folder))
    total = time.process_time()
    seconds = (total - start) / len(_shots())
    with stages.stage("PNG"):
        bpy.data.images["Render Result"].save_render(str(folder / ".once.png"), scene=scene)
    spent["PNG"] = stages.seconds["PNG"]
    spent["render"] -= spent["PNG"]
    scene.cycles.samples = 1
    once = shoot("once", folder / ".once") - spent["PNG"]
    if way.denoised:
        scene.cycles.use_denoising = False
        spent["denoising"] = once - (once := shoot("plain", folder / ".once") - spent["PNG"])
        spent["render"] -= spent["denoising"]
    return {"image": seconds, "images": len(_shots()), "total": total} | {"stages": _split(spent, once, way.samples)}


def _split(spent: Counter, once: float, samples: int) -> dict[str, float]:
    """`spent["render"]`, seconds of a render, as those of its samples and of what comes before them. once: seconds of a
    render of one sample."""
    render = spent.pop("render")
    kernel = (render - once) * samples / (samples - 1) if samples > 1 else 0.0
    return {"scene": render - kernel, "samples": kernel, **spent}


def main(asset: str, way: str, size: str, folder: str, core: str = "") -> int:
    if core and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {int(core)})  # before Blender starts its threads
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    result = measure(asset, WAYS[way], int(size), out)
    tmp = out / ".result.json"
    tmp.write_text(json.dumps(result))
    tmp.replace(out / "result.json")
    return 0


if __name__ == "__main__":
    status = main(*sys.argv[1:])
    os._exit(status)  # Blender's own way out is slow
