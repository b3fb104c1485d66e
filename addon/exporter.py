# SPDX-License-Identifier: GPL-3.0-or-later
"""File > Export > 4D Gaussians: the active asset object as .ply, .splat or USD, where and as it is now.

    bpy.ops.timesplat.export_asset(filepath="a.usdz", half=True)          the suffix says the format
    bpy.ops.timesplat.export_asset(filepath="frames", format="SLICES")    a folder with a 3DGS .ply a frame

What the sliders do and what was deleted is in the file, and so is the object's place in the world: at each frame in
USD and in a folder of slices, else at the current one. Animated sliders are followed by slices alone. USD is written
by the worker, or where there is none with the pxr of Blender's own Python.
"""

from __future__ import annotations

import tempfile
from contextlib import closing, contextmanager
from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, StringProperty

from ..datagen.sequence import InputError
from ..model.io import placement, slices, usd_check, usd_write
from ..model.io.asset import Asset
from ..model.io.atomic import atomic_write
from ..model.io.ply import write_ply
from . import display, held, preferences, process
from .importer import busy

REPORT = "Timesplat USD report"
SUFFIX = {"PLY": ".ply", "USDC": ".usdc", "USDA": ".usda", "USDZ": ".usdz", "SLICE": ".ply", "SPLAT": ".splat"}
SUFFIX |= {"SLICES": ""}
FORMAT_ITEMS = [
    ("PLY", "4D PLY", "Timesplat's own: a 3DGS .ply with motion and lifetimes. Nothing is lost"),
    ("USDC", "USDC (binary)", "USD for pipelines"),
    ("USDA", "USDA (text)", "USD to look into: large"),
    ("USDZ", "USDZ (package)", "USD in one file with all it needs"),
    ("SLICE", "3DGS PLY, this frame", "For 3DGS viewers and tools: what is visible at the current frame"),
    ("SPLAT", ".splat, this frame", "For web viewers: what is visible at the current frame, in 32 bytes a Gaussian"),
    (
        "SLICES",
        "3DGS PLY, all frames",
        "A new folder with what the timeline shows at every frame of the scene",
    ),
]
MODE_ITEMS = [
    ("splats", "Splats", "A Gaussian splat prim, which older readers take as points"),
    ("points", "Points", "A points prim only, for files that are referenced into others and for older readers"),
    ("frames", "Splats, every frame", "Positions at every frame, for readers that do not interpolate"),
]


def place(asset: Asset, matrix: np.ndarray) -> Asset:
    """The asset with its place in the world in the clip (see `place_asset`). Raises InputError."""
    clip = asset.clip
    own = np.diag([clip.scale, clip.scale, clip.scale, 1.0])
    own[:3, 3] = clip.translation
    if np.allclose(matrix, own, rtol=1e-6, atol=1e-6 * clip.scale):
        return asset  # it was not moved: the clip's numbers are exacter than the object's
    return placement.place_asset(asset, matrix)


def changes(ob, frames: range, context) -> tuple[np.ndarray, list[str]]:
    """Where the object is at each of the frames, (F,4,4), or (1,4,4) where it stands still; and the names of
    the sliders that change."""
    found = [(np.array(ob.matrix_world), held.sliders(ob))]
    if held.may_change(ob):
        found = [(np.array(ob.matrix_world), held.sliders(ob)) for _ in held.steps(frames, context)]
    first = found[0][1]
    names = [k for k in first if k not in ("Look", "Point Size") and any(s[k] != first[k] for _, s in found)]
    return np.stack([m for m, _ in found]), names


def write_usd(path: Path, asset: Asset, *, mode: str, half: bool, original: Path | None, motion, context) -> list[str]:
    """Writes and validates; returns what the validators complain about. Raises InputError."""
    python = preferences.usd_python(context)
    if not python:
        usd_write.write_usd(path, asset, mode=mode, half=half, original=original, motion=motion)
        return usd_check.check_usd(path)
    with tempfile.TemporaryDirectory(prefix="timesplat-", ignore_cleanup_errors=True) as folder:
        copy = Path(folder) / "asset.ply"
        write_ply(copy, asset)
        request = {"task": "export", "asset": str(copy), "out": str(path.resolve()), "mode": mode, "half": half}
        request |= {"original": str(original)} if original else {}
        if motion is not None:
            request["motion"] = str(Path(folder) / "motion.npy")
            np.save(request["motion"], motion)
        return process.ask(python, request)["complaints"]


@contextmanager
def original_usd(ob, path: Path, frames: range, context):
    """Yields a .usdc of the objects that the asset was made from, over these frames: a temporary one for a .usdz, which
    takes it in, else <name>_original.usdc beside `path`, which refers to it. Raises InputError."""
    if path.suffix.lower() == ".usdz":
        with tempfile.TemporaryDirectory(prefix="timesplat-", ignore_cleanup_errors=True) as folder:
            _export_original(ob, Path(folder) / "original.usdc", frames, context)
            yield Path(folder) / "original.usdc"
        return
    beside = path.with_name(f"{path.stem}_original.usdc")
    new = not beside.exists()
    with atomic_write(beside) as tmp:
        _export_original(ob, tmp, frames, context)
    try:
        yield beside
    except InputError:
        if new:
            beside.unlink(missing_ok=True)
        raise


def _export_original(ob, path: Path, frames: range, context) -> None:
    """Blender's own USD export; selection, visibility and frame range are afterwards as they were."""
    if not bpy.app.build_options.usd:
        raise InputError("This Blender was built without USD, which With Original needs; switch that off.")
    layer, scene = context.view_layer, context.scene
    objects = [layer.objects[n] for n in ob.get("timesplat_source", []) if n in layer.objects]
    if not objects:
        raise InputError(f"{ob.name}: what it was made from is not in this view layer; switch With Original off.")
    before = [(o, o.hide_get(), o.hide_viewport) for o in objects]
    selected, active = list(layer.objects.selected), layer.objects.active
    span, now = (scene.frame_start, scene.frame_end), (scene.frame_current, scene.frame_subframe)
    why = "see its console"
    try:
        for o in selected:
            o.select_set(False)
        for o in objects:
            o.hide_viewport = False
            o.hide_set(False)
            o.select_set(True)
        scene.frame_start, scene.frame_end = frames.start, frames.stop - 1
        bpy.ops.wm.usd_export(
            filepath=str(path),
            selected_objects_only=True,
            export_animation=True,
            export_armatures=False,  # deformed meshes at every frame, which every reader shows
            export_shapekeys=False,
            convert_world_material=False,
        )
    except RuntimeError as e:
        why = " ".join(str(e).split())
    finally:
        scene.frame_start, scene.frame_end = span
        scene.frame_set(now[0], subframe=now[1])
        for o, hidden, off in before:
            o.select_set(False)
            o.hide_set(hidden)
            o.hide_viewport = off
        for o in selected:
            o.select_set(True)
        layer.objects.active = active
    if not path.is_file():
        raise InputError(f"{ob.name}: Blender could not export what it was made from ({why}); do without it.")


def with_suffix(filepath: str, kind: str) -> str:
    """The path with the format's suffix, in place of another format's."""
    path = Path(filepath)
    if path.suffix.lower() in SUFFIX.values():
        filepath = str(path.with_suffix(""))
    return filepath + SUFFIX[kind]


def kind_of(filepath: str, default: str) -> str:
    """The format that a path's suffix stands for: `default` if that has it or the suffix is of no format."""
    suffix = Path(filepath).suffix.lower()
    return default if suffix in ("", SUFFIX[default]) else next((k for k, s in SUFFIX.items() if s == suffix), default)


class TIMESPLAT_OT_export_asset(bpy.types.Operator):
    """Export the active 4D Gaussian asset: as .ply or .splat, or as USD"""

    bl_idname = "timesplat.export_asset"
    bl_label = "Export 4D Gaussians"
    bl_options = {"PRESET"}  # noqa: RUF012

    filepath: StringProperty(name="File", subtype="FILE_PATH", options={"SKIP_SAVE"})
    check_existing: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    filter_glob: StringProperty(default="*.ply;*.splat;*.usd;*.usdc;*.usda;*.usdz", options={"HIDDEN"})
    format: EnumProperty(name="Format", items=FORMAT_ITEMS, default="PLY")
    apply_sliders: BoolProperty(
        name="Apply Sliders",
        description="Retiming, crop, density, lifetimes and opacity cut go into the file. Off: all the object holds",
        default=True,
    )
    mode: EnumProperty(name="Mode", items=MODE_ITEMS, default="splats")
    half: BoolProperty(
        name="Half Precision",
        description="All but positions and opacities in 16 bits: a smaller file",
        default=False,
    )
    with_original: BoolProperty(
        name="With Original",
        description="Also the objects that the asset was made from, as the other variant of a variant set",
        default=False,
    )

    @classmethod
    def poll(cls, context):
        cls.poll_message_set("Select a Timesplat asset, in Object Mode")
        return context.mode == "OBJECT" and display.is_asset(context.object)

    def invoke(self, context, event):
        if not self.filepath:
            folder = Path(bpy.data.filepath).parent if bpy.data.filepath else Path()
            self.filepath = str(folder / bpy.path.clean_name(context.object.name))
        self.checked = ""
        self.check(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def check(self, context):
        if self.format == self.checked:  # so that the name was changed: a suffix that is typed chooses the format
            self.format = kind_of(self.filepath, self.format)
        self.checked = self.format
        path = with_suffix(self.filepath, self.format)
        changed, self.filepath = path != self.filepath, path
        return changed

    def draw(self, context):
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        layout.prop(self, "format")
        layout.prop(self, "apply_sliders")
        if self.format.startswith("USD"):
            layout.prop(self, "mode")
            layout.prop(self, "half")
            row = layout.row()
            row.enabled = bpy.app.build_options.usd and bool(context.object and context.object.get("timesplat_source"))
            row.prop(self, "with_original")

    def execute(self, context):
        if not self.properties.is_property_set("format"):
            self.format = kind_of(self.filepath, self.format)
        try:
            if not self.filepath:
                raise InputError("No file was named; choose one.")
            path = Path(bpy.path.abspath(with_suffix(self.filepath, self.format)))
            with busy(context):
                level, said = self.write(path, context)
        except InputError as e:
            self.report({"ERROR"}, str(e))
            return {"CANCELLED"}
        except OSError as e:  # no room for temporary files
            self.report({"ERROR"}, f"{e.filename or path}: it cannot be written ({e.strerror or e}); make room.")
            return {"CANCELLED"}
        self.report({level}, f"{path.name}: {said}")
        return {"FINISHED"}

    def write(self, path: Path, context) -> tuple[str, str]:
        """-> the report's level and text."""
        ob, scene = context.object, context.scene
        context.view_layer.update()  # a script may have moved it just now
        frame = scene.frame_current_final
        if self.format in ("SLICE", "SPLAT"):
            part = held.moment(ob, held.asset_of(ob), frame, self.apply_sliders)
            count = slices.write_slice(path, part, frame, cut=0)
            if not part.opacity.any():
                return "WARNING", f"Nothing is shown at frame {frame:g}; one clear Gaussian stands in."
            return "INFO", f"{count} Gaussians of frame {frame:g}."
        if self.format == "SLICES":
            asset = held.asset_of(ob)
            frames = range(scene.frame_start, scene.frame_end + 1) if self.apply_sliders else asset.clip.frames
            steps = held.steps(frames, context)
            moments = ((f, held.moment(ob, asset, f, self.apply_sliders)) for f in steps)
            with closing(steps):
                return "INFO", f"{slices.write_moments(path, moments, path.name, cut=0)} files."

        asset = held.applied(ob) if self.apply_sliders else held.asset_of(ob)
        now = np.array(ob.matrix_world)
        places, animated = changes(ob, asset.clip.frames, context)
        rest, motion = placement.rest_and_motion(places)
        lost = animated if self.apply_sliders else []
        if self.format == "PLY":
            write_ply(path, place(asset, now))
            lost = lost + ["place"] * (motion is not None)
            level, said = "INFO", f"{len(asset)} Gaussians."
        elif self.with_original:
            with original_usd(ob, path, asset.clip.frames, context) as original:
                level, said = self.write_usd(path, place(asset, rest), original, motion, context)
        else:
            level, said = self.write_usd(path, place(asset, rest), None, motion, context)
        if lost:
            said += f" Animated, but in the file as at frame {frame:g}: {', '.join(lost)}."
            said += " 3DGS PLY, all frames, keeps it."
        return "WARNING" if lost else level, said

    def write_usd(self, path: Path, asset: Asset, original: Path | None, motion, context) -> tuple[str, str]:
        options = {"mode": self.mode, "half": self.half, "original": original, "motion": motion}
        complaints = write_usd(path, asset, **options, context=context)
        verdict = f"{len(complaints)} complaints" if complaints else "valid USD"
        text = bpy.data.texts.get(REPORT) or bpy.data.texts.new(REPORT)
        lines = [str(path), f"{len(asset)} Gaussians, mode {self.mode}, {path.stat().st_size:,} bytes", verdict]
        text.from_string("\n".join([*lines, "", *complaints]).rstrip() + "\n")
        if complaints:
            return "WARNING", f'{len(asset)} Gaussians, {verdict}: see the text "{REPORT}".'
        return "INFO", f"{len(asset)} Gaussians, {verdict}."


def _menu(self, context):
    self.layout.operator("timesplat.export_asset", text="4D Gaussians (.ply, .splat, .usd)")


def register() -> None:
    bpy.utils.register_class(TIMESPLAT_OT_export_asset)
    bpy.types.TOPBAR_MT_file_export.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_export.remove(_menu)
    bpy.utils.unregister_class(TIMESPLAT_OT_export_asset)
