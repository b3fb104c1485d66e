# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes a borrowed scene ready to render: the render settings, an even light, and the cameras of a frame."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import bpy
from mathutils import Matrix, Vector

from .blender_output import FAINTEST, SEEN
from .rigs import Shot
from .sequence import Normalisation

SUNS = (  # direction the light comes from, irradiance: a key, a fill and a light from behind
    ((-1.0, -1.2, 1.6), 1.5),
    ((1.4, -0.7, 0.5), 0.6),
    ((0.4, 1.5, 0.9), 0.9),
)
WORLD_RADIANCE = 0.45  # of the uniform world: albedo 1 in full shade shows as this


@dataclass(frozen=True)
class CaptureSettings:
    """How pictures are rendered; the same for all cameras and frames."""

    size: int | tuple[int, int] = 128  # pixels; an int for a square picture, or (width, height)
    samples: int = 16  # a pixel
    passes: bool = True  # also depth and motion vectors
    linear: bool = False  # with passes: also the scene-linear picture, in the same file
    tracks: int | None = 0  # surface points followed through the clip; 0 = one for each patch of a pixel's size
    engine: str = "CYCLES"  # Blender's name of a render engine
    device: str = "CPU"  # Cycles': or "GPU", the one chosen in Blender's preferences
    threads: int = 0  # 0 = all cores
    lighting: bool = True  # three suns and a grey world in place of the scene's own lights and world
    seed: int = 0  # of Cycles' noise at the clip's first frame; it grows by 1 a frame

    @property
    def width_and_height(self) -> tuple[int, int]:
        return (self.size, self.size) if isinstance(self.size, int) else self.size


@contextlib.contextmanager
def temporary_data() -> Iterator[list]:
    """A list for data-blocks that are removed at the end."""
    blocks: list = []
    try:
        yield blocks
    finally:
        bpy.data.batch_remove(blocks)


def apply_settings(stage, settings: CaptureSettings) -> None:
    """Makes the borrowed scene render as `settings` say, into multi-layer EXR, whatever was set before."""
    _set_render(stage.render, settings)
    if settings.engine == "CYCLES":
        _set_cycles(stage.cycles, settings)
    else:
        stage.eevee.taa_render_samples = settings.samples
    _set_passes(stage.view_layers[0], settings.passes)
    _set_output(stage.render)


def _set_render(render, settings: CaptureSettings) -> None:
    """Plain frames of the size asked for: nothing composited, blurred or stamped, and no background."""
    render.engine = settings.engine
    render.resolution_x, render.resolution_y = settings.width_and_height
    render.resolution_percentage = 100
    render.pixel_aspect_x = render.pixel_aspect_y = 1
    render.use_border = render.use_motion_blur = render.use_freestyle = render.use_stamp = False
    render.use_compositing = render.use_sequencer = False
    render.film_transparent = render.use_persistent_data = True
    if settings.threads:
        render.threads_mode, render.threads = "FIXED", settings.threads


def _set_cycles(cycles, settings: CaptureSettings) -> None:
    """So many samples for every pixel, whatever it shows, and nothing that smooths them."""
    cycles.device, cycles.samples, cycles.time_limit = settings.device, settings.samples, 0
    cycles.use_adaptive_sampling = cycles.use_denoising = cycles.use_animated_seed = False
    cycles.sample_offset = 0
    if hasattr(cycles, "use_sample_subset"):  # Blender 5
        cycles.use_sample_subset = False
    cycles.film_exposure, cycles.film_transparent_glass = 1, False
    cycles.pixel_filter_type, cycles.filter_width = "BLACKMAN_HARRIS", 1.5


def _set_passes(layer, passes: bool) -> None:
    """The picture alone, or with depth and motion vectors."""
    for name in [x for x in dir(layer) if x.startswith("use_pass_")]:
        setattr(layer, name, False)
    layer.use_pass_combined = True
    layer.use_pass_z = layer.use_pass_vector = passes
    layer.use, layer.samples, layer.pass_alpha_threshold = True, 0, SEEN


@contextlib.contextmanager
def faint_surfaces_have_depth(stage) -> Iterator[None]:
    """Inside, renders of the stage are one sample, whose depth and motion are those of the first surface that is not
    all but invisible."""
    layer = stage.view_layers[0]
    before = layer.samples, layer.pass_alpha_threshold
    layer.samples, layer.pass_alpha_threshold = 1, FAINTEST
    try:
        yield
    finally:
        layer.samples, layer.pass_alpha_threshold = before


def _set_output(render) -> None:
    """One multi-layer EXR a view."""
    image = render.image_settings
    if hasattr(image, "media_type"):  # Blender 5: this comes before the format
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format, image.color_depth, image.exr_codec = "OPEN_EXR_MULTILAYER", "32", "NONE"
    image.views_format = "INDIVIDUAL"
    render.use_file_extension = render.use_overwrite = True
    render.views_format = "MULTIVIEW"


def add_even_light(stage, temporary: list) -> None:
    """Three suns and a grey world: the same for every object, wherever it lies and however large it is."""
    world = bpy.data.worlds.new("timesplat")
    temporary.append(world)
    if bpy.app.version < (5, 0):  # from then on it always has nodes
        world.use_nodes = True
    background = next(n for n in world.node_tree.nodes if n.type == "BACKGROUND")
    background.inputs["Color"].default_value = (1, 1, 1, 1)
    background.inputs["Strength"].default_value = WORLD_RADIANCE
    stage.world = world
    for direction, strength in SUNS:
        sun = bpy.data.lights.new("timesplat", "SUN")
        sun.energy, sun.angle = strength, math.radians(10)
        ob = bpy.data.objects.new("timesplat", sun)
        temporary += [ob, sun]
        ob.rotation_euler = Vector(direction).to_track_quat("Z", "Y").to_euler()
        stage.collection.objects.link(ob)


class MultiViewCameras:
    """The cameras of one frame, as views of one render. They are placed, never keyed: no camera motion gets
    into the motion vectors."""

    def __init__(self, stage, temporary: list, normalisation: Normalisation) -> None:
        self.stage, self.temporary, self.normalisation = stage, temporary, normalisation
        self.objects: list = []  # as many as one frame ever had
        self.count = 0  # of those placed at this frame
        self.name = "timesplat"
        while any(ob.name.startswith(self.name) for ob in bpy.data.objects if ob.type == "CAMERA"):
            self.name += "-"  # views find their cameras by name

    def place(self, shots: list[Shot]) -> None:
        """Puts one camera at each of the shots, all of one frame."""
        self.count = len(shots)
        while len(self.objects) < self.count:
            self._add_camera()
        for ob, shot in zip(self.objects, shots, strict=False):
            ob.matrix_world = Matrix(self.normalisation.to_world(shot.c2w).tolist())
            ob.data.angle = math.radians(shot.fov)
            ob.data.shift_x, ob.data.shift_y = shot.shift
        self.stage.camera = self.objects[0]
        self._set_views()

    def _add_camera(self) -> None:
        name = f"{self.name}_v{len(self.objects)}"
        data = bpy.data.cameras.new(name)
        data.sensor_fit = "AUTO"  # the longer side
        data.clip_start, data.clip_end = 1e-3 * self.normalisation.scale, 1e3 * self.normalisation.scale
        ob = bpy.data.objects.new(name, data)
        self.temporary += [ob, data]
        self.stage.collection.objects.link(ob)
        self.objects.append(ob)

    def _set_views(self) -> None:
        """As many views of the render as cameras are placed."""
        self.stage.render.use_multiview = self.count > 1
        views = self.stage.render.views
        while len(views) > max(self.count, 1):
            views.remove(views[len(views) - 1])
        while len(views) < self.count:
            views.new(f"v{len(views)}")
        for i, view in enumerate(views):
            view.name, view.camera_suffix, view.file_suffix, view.use = f"v{i}", f"_v{i}", f"_v{i}", True

    def render(self, folder: Path) -> list[Path]:
        """Renders and returns one EXR for each camera placed; they are overwritten by the next call."""
        self.stage.render.filepath = str(folder / "frame")
        with bpy.context.temp_override(scene=self.stage):  # the operator's own `scene` keeps the old frame
            bpy.ops.render.render(write_still=True)
        if self.count == 1:
            return [folder / "frame.exr"]
        return [folder / f"frame_v{i}.exr" for i in range(self.count)]
