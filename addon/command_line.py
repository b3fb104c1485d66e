# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension on Blender's command line, for scenes that are .blend files:

    blender -b scene.blend --command timesplat render --out data/scene --rig default
    blender -b scene.blend --command timesplat reconstruct --method tracks --output scene.ply --blend result.blend

`--help` after either explains it. Exit code 2 and one sentence where the input cannot be used.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import bpy

from ..datagen import rigs
from ..datagen.scene.open import enter_object_mode
from ..datagen.sequence import InputError
from . import settings
from .operators import reconstruct
from .runtime import jobs
from .runtime.capture import start_capture

SKIPPED = ("look",)  # of no use without a window


def main(argv: list[str]) -> int:
    """Runs `render` or `reconstruct` on the open scene; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="blender -b SCENE.blend --command timesplat",
        description="Captures the scene that Blender was started with.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="render | reconstruct")
    chosen = bpy.context.scene.timesplat
    for name, text in (
        ("render", "cameras x frames to a Sequence: posed images, depth, motion, tracks of the surface"),
        ("reconstruct", "the object as 4D Gaussians, into the scene, a .ply or a new .blend"),
    ):
        sub = commands.add_parser(name, help=text, description=text)
        keys = ("source", "collection", "leave_out", "in_turn", "frame_range", "frame_start", "frame_end", "every",
                "size", "samples", "lighting") if name == "render" else settings.KEYS  # fmt: skip
        for key in keys:
            if key not in SKIPPED:
                _option(sub, chosen, key)
        if name == "render":
            sub.add_argument("--out", type=Path, required=True, help="folder of the Sequence to write")
            sub.add_argument("--rig", choices=rigs.RIGS, help="cameras of a rig (default: those of the scene that are "
                             "selected or in the Timesplat rig, else coverage)")  # fmt: skip
            sub.add_argument("--targets", type=int, default=0, help="held-out random views a frame")
            sub.add_argument("--no-passes", dest="passes", action="store_false", help="pictures alone")
            sub.add_argument("--seed", type=int, default=0)
        else:
            sub.add_argument("--blend", type=Path, help="save the scene with the result as this .blend")
    try:
        args = parser.parse_args(argv)
    except SystemExit as e:
        return int(e.code or 0)
    for key in settings.KEYS:
        if getattr(args, key, None) is not None:
            setattr(chosen, key, getattr(args, key))
    window = bpy.context.window_manager.windows[0]
    try:
        with bpy.context.temp_override(window=window):  # a command has none, and operators find no object without
            enter_object_mode()
            _render(chosen, args) if args.command == "render" else _reconstruct(chosen, args)
    except InputError as e:
        print(f"timesplat: {e}", file=sys.stderr)
        return 2
    return 0


def _option(parser, chosen, key: str) -> None:
    """An option of the same name, range and description as the setting has."""
    rna = chosen.bl_rna.properties[key]
    flag, text = f"--{key.replace('_', '-')}", rna.description or rna.name
    default = getattr(chosen, key)
    if rna.type == "BOOLEAN":
        parser.add_argument(flag, action=argparse.BooleanOptionalAction, default=None, help=text)
        return
    kinds = {"INT": int, "FLOAT": float}
    choices = [i.identifier for i in rna.enum_items] if rna.type == "ENUM" else None
    help = f"{text} ({default})".replace("%", "%%") if default != "" else text
    parser.add_argument(flag, type=kinds.get(rna.type, str), choices=choices, default=None, help=help)


def _render(chosen, args) -> None:
    keys = ("rig", "targets", "seed", "passes")
    rig = {key: getattr(args, key) for key in keys} | {"tracks": 0, "last": None}
    request = reconstruct.request(chosen, bpy.context) | rig | {"sequence": str(args.out.resolve())}
    stages = [lambda folder: start_capture(request, folder)]
    job = jobs.start("Rendering", stages, lambda event, folder: f"{event['pictures']} pictures")
    _run(job)
    print(f"{args.out}: {job.message}")


def _reconstruct(chosen, args) -> None:
    if not (chosen.output or args.blend):
        raise InputError("The result would be lost: give --output FILE.ply, --blend FILE.blend, or both.")
    job = reconstruct.start(chosen, bpy.context)
    _run(job)
    print(job.message)
    if args.blend:
        try:
            bpy.ops.wm.save_as_mainfile(filepath=str(args.blend.resolve()), copy=True)
        except RuntimeError as e:
            raise InputError(f"{args.blend}: it cannot be written ({' '.join(str(e).split())}).") from None


def _run(job: jobs.Job) -> None:
    try:
        jobs.wait(job, lambda job: print(f"\r{job.fraction:4.0%} {job.text:40}", end="", file=sys.stderr, flush=True))
    finally:
        print(file=sys.stderr)


_registered: list = []


def register() -> None:
    _registered.append(bpy.utils.register_cli_command("timesplat", main))


def unregister() -> None:
    while _registered:
        bpy.utils.unregister_cli_command(_registered.pop())
