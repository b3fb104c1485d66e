# SPDX-License-Identifier: GPL-3.0-or-later
"""File > Export > 4D Gaussians: the active asset object as any file that `timesplat export` writes, where and as it is
now.

    bpy.ops.timesplat.export_asset(filepath="a.usdz", half=True)          the suffix says the format
    bpy.ops.timesplat.export_asset(filepath="frames", format="SLICES")    a folder with a 3DGS .ply a frame, or …
    bpy.ops.timesplat.export_asset(filepath="frames", format="SLICES", kind="SOG")    … a file of another kind

What the sliders do and what was deleted is in the file, and so is the object's place in the world: at each frame in
USD and in a folder of slices, else at the current one. Animated sliders are followed by slices alone. What Blender
lacks libraries for is written by the worker, USD where there is none with the pxr of Blender's own Python.
"""

from __future__ import annotations

import tempfile
from contextlib import closing
from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, StringProperty

from ...datagen.sequence import InputError
from ...model.io import slices
from ...model.io.asset import Asset
from ...model.io.files import APART, WRITABLE, named, write_asset
from ...model.io.placement import place_asset, rest_and_motion
from ...model.io.ply import write_ply
from ...model.io.slice_formats import SLICE_FORMATS
from ...model.io.usd_check import check_usd
from ..asset.apply_sliders import moment, with_sliders
from ..asset.asset_object import asset_of, slider_values
from ..asset.sliders import is_asset
from ..asset.timeline import may_change, visit_frames
from ..runtime import child_process, worker_options
from .common import wait_cursor
from .original_usd import original_usd

REPORT = "Timesplat USD report"
SUFFIXES = {
    **{"PLY": ".ply", "USDC": ".usdc", "USDA": ".usda", "USDZ": ".usdz"},
    **{"FOURDGS": ".4dgs", "PAGE": ".html"},
    **{"SLICE": ".ply", "SPLAT": ".splat", "SPZ": ".spz", "SOG": ".sog", "GLB": ".glb", "SLICES": ""},
}
MOMENTS = ("SLICE", "SPLAT", "SPZ", "SOG", "GLB")  # which hold the current frame
FORMAT_ITEMS = [
    ("PLY", "4D PLY", "Timesplat's own: a 3DGS .ply with motion and lifetimes. Nothing is lost"),
    ("USDC", "USDC (binary)", "USD for pipelines"),
    ("USDA", "USDA (text)", "USD to look into: large"),
    ("USDZ", "USDZ (package)", "USD in one file with all it needs"),
    (
        "FOURDGS",
        ".4dgs",
        "Straight 4D Gaussians for players of 4dgs.dev. Paths become pieces; needs the package fourdgs",
    ),
    ("PAGE", "Web Page", "One file that plays in any browser, from disk and without network"),
    ("SLICE", "3DGS PLY, this frame", "For 3DGS viewers and tools: what is visible at the current frame"),
    ("SPLAT", ".splat, this frame", "For web viewers: what is visible at the current frame, in 32 bytes a Gaussian"),
    ("SPZ", ".spz, this frame", "Niantic's packed splats: what is visible at the current frame, in few bytes"),
    ("SOG", ".sog, this frame", "PlayCanvas's packed splats: what is visible at the current frame, in few bytes"),
    ("GLB", ".glb, this frame", "glTF with KHR_gaussian_splatting: what is visible at the current frame"),
    ("SLICES", "3DGS PLY, all frames", "A new folder with what the timeline shows at every frame of the scene"),
]
KIND_ITEMS = [(key, SUFFIXES[key], f"A {SUFFIXES[key]} for every frame") for key in MOMENTS]
MODE_ITEMS = [
    ("splats", "Splats", "A Gaussian splat prim, which older readers take as points"),
    ("points", "Points", "A points prim only, for files that are referenced into others and for older readers"),
    ("frames", "Splats, every frame", "Positions at every frame, for readers that do not interpolate"),
]


def with_place(asset: Asset, matrix: np.ndarray) -> Asset:
    """The asset with its place in the world in the clip (see `place_asset`). Raises InputError."""
    clip = asset.clip
    own = np.diag([clip.scale, clip.scale, clip.scale, 1.0])
    own[:3, 3] = clip.translation
    if np.allclose(matrix, own, rtol=1e-6, atol=1e-6 * clip.scale):
        return asset  # it was not moved: the clip's numbers are exacter than the object's
    return place_asset(asset, matrix)


def places_and_changes(ob, frames: range, context) -> tuple[np.ndarray, list[str]]:
    """Where the object is at each of the frames, (F,4,4), or (1,4,4) where it stands still; and the names of
    the sliders that change."""
    found = [(np.array(ob.matrix_world), slider_values(ob))]
    if may_change(ob):
        found = [(np.array(ob.matrix_world), slider_values(ob)) for _ in visit_frames(frames, context)]
    first = found[0][1]
    names = [k for k in first if k not in ("Look", "Point Size") and any(s[k] != first[k] for _, s in found)]
    return np.stack([m for m, _ in found]), names


def write_usd(path: Path, asset: Asset, *, mode: str, half: bool, original: Path | None, motion, context) -> list[str]:
    """Writes and validates; returns what the validators complain about. Raises InputError."""
    if not worker_options.python_for(path.suffix.lower(), context):
        write_asset(path, asset, mode=mode, half=half, original=original, motion=motion)
        return check_usd(path)
    with tempfile.TemporaryDirectory(prefix="timesplat-", ignore_cleanup_errors=True) as folder:
        options = {"mode": mode, "half": half} | ({"original": str(original)} if original else {})
        if motion is not None:
            options["motion"] = str(Path(folder) / "motion.npy")
            np.save(options["motion"], motion)
        return write_apart(path, asset, context, **options)["complaints"]


def write_apart(path: Path, asset: Asset, context, **options) -> dict:
    """Has the worker write the asset; returns what it told. Raises InputError."""
    python = worker_options.python_for(path.suffix.lower(), context)
    with tempfile.TemporaryDirectory(prefix="timesplat-", ignore_cleanup_errors=True) as folder:
        copy = Path(folder) / "asset.ply"
        write_ply(copy, asset)
        request = {"task": "export", "asset": str(copy), "out": str(path.resolve()), **options}
        return child_process.ask_worker(python, request)


def write_frames(path: Path, moments, suffix: str, context) -> int:
    """Writes a folder with a file for each (frame, asset); returns their number. Raises InputError."""
    if suffix not in APART:
        return slices.write_moments(path, moments, path.name, cut=0, suffix=suffix)
    python = worker_options.python_for(suffix, context)
    with tempfile.TemporaryDirectory(prefix="timesplat-", ignore_cleanup_errors=True) as folder:
        frames = Path(folder) / "frames"
        slices.write_moments(frames, moments, path.name, cut=0)
        request = {"task": "export", "asset": str(frames), "out": str(path.resolve()), "suffix": suffix}
        return child_process.ask_worker(python, request)["files"]


def with_suffix(filepath: str, kind: str) -> str:
    """The path with the format's suffix, in place of another format's."""
    path = Path(filepath)
    if path.suffix.lower() in SUFFIXES.values():
        filepath = str(path.with_suffix(""))
    return filepath + SUFFIXES[kind]


def format_of(filepath: str, default: str) -> str:
    """The format that a path's suffix stands for: `default` if that has it or the suffix is of no format."""
    suffix = Path(filepath).suffix.lower()
    if suffix in ("", SUFFIXES[default]):
        return default
    return next((k for k, s in SUFFIXES.items() if s == suffix), default)


class TIMESPLAT_OT_export_asset(bpy.types.Operator):
    """Export the active 4D Gaussian asset: for Blender, USD pipelines, splat viewers, game engines or browsers"""

    bl_idname = "timesplat.export_asset"
    bl_label = "Export 4D Gaussians"
    bl_options = {"PRESET"}  # noqa: RUF012

    filepath: StringProperty(name="File", subtype="FILE_PATH", options={"SKIP_SAVE"})
    check_existing: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    filter_glob: StringProperty(
        default=";".join(sorted({f"*{s}" for s in (*WRITABLE, *SUFFIXES.values()) if s})), options={"HIDDEN"}
    )
    format: EnumProperty(name="Format", items=FORMAT_ITEMS, default="PLY")
    kind: EnumProperty(name="Files", description="What there is one of a frame", items=KIND_ITEMS, default="SLICE")
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
        return context.mode == "OBJECT" and is_asset(context.object)

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
            self.format = format_of(self.filepath, self.format)
        self.checked = self.format
        path = with_suffix(self.filepath, self.format)
        changed, self.filepath = path != self.filepath, path
        return changed

    def draw(self, context):
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        layout.prop(self, "format")
        if self.format == "SLICES":
            layout.prop(self, "kind")
        layout.prop(self, "apply_sliders")
        if self.format.startswith("USD"):
            layout.prop(self, "mode")
            layout.prop(self, "half")
            row = layout.row()
            row.enabled = bpy.app.build_options.usd and bool(context.object and context.object.get("timesplat_source"))
            row.prop(self, "with_original")

    def execute(self, context):
        if not self.properties.is_property_set("format"):
            self.format = format_of(self.filepath, self.format)
        try:
            if not self.filepath:
                raise InputError("No file was named; choose one.")
            path = Path(bpy.path.abspath(with_suffix(self.filepath, self.format)))
            with wait_cursor(context):
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
        if self.format in MOMENTS:
            part = moment(ob, asset_of(ob), frame, self.apply_sliders)
            if path.suffix in APART:
                write_apart(path, part, context, frame=frame)
            else:
                write_asset(path, part, frame=frame, cut=0)
            if not part.opacity.any():
                return "WARNING", f"Nothing is shown at frame {frame:g}; one clear Gaussian stands in."
            return "INFO", f"{len(part)} Gaussians of frame {frame:g}."
        if self.format == "SLICES":
            asset = asset_of(ob)
            frames = range(scene.frame_start, scene.frame_end + 1) if self.apply_sliders else asset.clip.frames
            steps = visit_frames(frames, context)
            moments = ((f, moment(ob, asset, f, self.apply_sliders)) for f in steps)
            with closing(steps):
                return "INFO", f"{write_frames(path, moments, SUFFIXES[self.kind], context)} files."

        asset = with_sliders(ob) if self.apply_sliders else asset_of(ob)
        now = np.array(ob.matrix_world)
        places, animated = places_and_changes(ob, asset.clip.frames, context)
        rest, motion = rest_and_motion(places)
        lost = animated if self.apply_sliders else []
        if self.format in ("PLY", "PAGE", "FOURDGS"):
            placed = with_place(asset, now)
            write_apart(path, placed, context) if path.suffix in APART else write_asset(path, placed)
            lost = lost + ["place"] * (motion is not None)
            level, said = "INFO", f"{len(asset)} Gaussians."
        elif self.with_original:
            with original_usd(ob, path, asset.clip.frames, context) as original:
                level, said = self.write_usd(path, with_place(asset, rest), original, motion, context)
        else:
            level, said = self.write_usd(path, with_place(asset, rest), None, motion, context)
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
    self.layout.operator("timesplat.export_asset", text=f"4D Gaussians ({named((*WRITABLE, *SLICE_FORMATS))})")


def register() -> None:
    bpy.utils.register_class(TIMESPLAT_OT_export_asset)
    bpy.types.TOPBAR_MT_file_export.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_export.remove(_menu)
    bpy.utils.unregister_class(TIMESPLAT_OT_export_asset)
