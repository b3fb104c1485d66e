# SPDX-License-Identifier: GPL-3.0-or-later
"""What an asset costs in Blender: a frame change, the panels, a redraw of the viewport.

    python benchmarks/blender_display.py                          with the bpy wheel: frame changes
    blender -b --python benchmarks/blender_display.py             the same in any Blender
    blender --python benchmarks/blender_display.py                with a window: panels and redraws too; ends Blender

A frame change is scene.frame_set, which evaluates the modifier: of an asset whose Gaussians move along lines, and of
TRACKED ones that ride on paths of KNOTS knots, beside as many on lines. draw() is what the add-on's panels add to a
redraw of the sidebar. Each is the median of REPEATS.
"""

import importlib.util
import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np

COUNT, REPEATS = 200_000, 41
TRACKED, PATHS, KNOTS = 50_000, (5_000, 50_000), 24
ROOT = Path(__file__).resolve().parent.parent


def package():
    """The checkout as `timesplat`, whether or not it is installed in this Python."""
    if "timesplat" not in sys.modules:
        init, where = ROOT / "__init__.py", [str(ROOT)]
        spec = importlib.util.spec_from_file_location("timesplat", init, submodule_search_locations=where)
        sys.modules["timesplat"] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules["timesplat"])


def asset(count: int = COUNT):
    """Gaussians over the cube, of which at each frame of 24 about a third is visible."""
    from timesplat.model.io.asset import Asset, Clip

    r = np.random.default_rng(0)
    q = r.normal(size=(count, 4))
    arrays = {
        "xyz": r.uniform(-0.8, 0.8, (count, 3)),
        "t": r.uniform(-1, 1, count),
        "velocity": r.normal(0, 0.3, (count, 3)),
        "sigma_t": r.uniform(0.1, 0.4, count),
        "scale": np.exp(r.uniform(-6, -4, (count, 3))),
        "rotation": q / np.linalg.norm(q, axis=1, keepdims=True),
        "rgb": r.uniform(0, 1, (count, 3)),
        "opacity": r.uniform(0.1, 0.99, count),
    }
    return Asset(**{k: a.astype(np.float32) for k, a in arrays.items()}, clip=Clip(24, 1, 24))


def tracked_asset(count: int, lines):
    """The Gaussians of `lines` on `count` paths, so that all are visible at each frame."""
    from timesplat.model.io.asset import STATIC_SIGMA_T
    from timesplat.model.io.paths import Paths

    r = np.random.default_rng(1)
    turn = np.array([1.0, 0, 0, 0]) + np.cumsum(r.normal(0, 0.1, (count, KNOTS, 4)), 1)
    turn /= np.linalg.norm(turn, axis=2, keepdims=True)
    place = r.uniform(-0.8, 0.8, (count, 1, 3)) + np.cumsum(r.normal(0, 0.05, (count, KNOTS, 3)), 1)
    ends, knots = np.ones(count, np.float32), np.full(count, KNOTS, np.int32)
    paths = Paths(-ends, ends, knots, *(a.reshape(-1, a.shape[2]).astype(np.float32) for a in (place, turn)))
    path = np.arange(len(lines), dtype=np.int32) % count
    still = {"velocity": np.zeros_like(lines.velocity), "sigma_t": np.full_like(lines.sigma_t, STATIC_SIGMA_T)}
    return replace(lines, **still, xyz=paths.at(lines.t, path)[0], path=path, paths=paths)


def median(act) -> float:
    """Milliseconds, after one call that is not counted."""
    times = []
    for i in range(REPEATS + 1):
        start = time.perf_counter()
        act(i)
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times[1:])


def frame_changes(ob, what: str) -> list[tuple[str, float]]:
    from timesplat.addon.asset.sliders import asset_modifier, set_input

    scene, rows = bpy.context.scene, []
    for look in ("Points", "Ellipsoids", "Splats"):
        set_input(asset_modifier(ob), "Look", look)
        for name, step in (("whole frames", 1.0), ("fractional frames", 0.37)):

            def change(i, step=step):
                frame = 1 + (i * step) % 23
                scene.frame_set(int(frame), subframe=frame % 1)

            rows.append((f"frame change, {what}, {look}, {name}", median(change)))
    set_input(asset_modifier(ob), "Look", "Points")
    return rows


def all_frame_changes() -> list[tuple[str, float]]:
    """Each asset alone, with the add-on registered; the big one, which comes last, stays."""
    from timesplat.addon import register
    from timesplat.addon.asset import display

    register()
    rows, lines = [], asset(TRACKED)
    for paths in (0, *PATHS):
        ob = display.add_asset(tracked_asset(paths, lines) if paths else lines, "benchmark", look="Points")
        rows += frame_changes(ob, f"{TRACKED:,} on {f'{paths:,} paths' if paths else 'lines'}")
        bpy.data.objects.remove(ob)
    return rows + frame_changes(display.add_asset(asset(), "benchmark", look="Points"), f"{COUNT:,} on lines")


def biggest():
    """The biggest 3D view of the window."""
    areas = bpy.context.window_manager.windows[0].screen.areas
    return max((a for a in areas if a.type == "VIEW_3D"), key=lambda a: a.width * a.height)


def windowed():
    """Yields seconds to wait for Blender's own redraws; returns rows."""
    window, area = bpy.context.window_manager.windows[0], biggest()
    regions = {r.type: r for r in area.regions}
    rows, calls = [], {}

    def timed(draw):
        def inner(self, context):
            start = time.perf_counter()
            draw(self, context)
            calls.setdefault(self.bl_label, []).append(1e3 * (time.perf_counter() - start))

        return inner

    for panel in bpy.types.Panel.__subclasses__():
        if panel.__module__.startswith("timesplat."):
            panel.draw = timed(panel.draw)
    regions["UI"].active_panel_category = "Timesplat"
    for _ in range(REPEATS):
        regions["UI"].tag_redraw()
        yield 0.05
    rows += [
        (f"draw() of the panel {name}, {len(times)} times", statistics.median(times)) for name, times in calls.items()
    ]
    rows.append(("draw() of all panels", sum(row[1] for row in rows)))

    def redraw(i):
        with bpy.context.temp_override(window=window, area=area, region=regions["WINDOW"]):
            bpy.ops.wm.redraw_timer(type="DRAW_SWAP", iterations=1)

    for shading in ("SOLID", "MATERIAL"):
        area.spaces.active.shading.type = shading
        yield 5  # shaders are compiled
        rows.append((f"redraw of the viewport, {shading.lower()}, {area.width}x{area.height}", median(redraw)))
    return rows


def report(rows) -> None:
    print(f"\nBlender {bpy.app.version_string}, median of {REPEATS}")
    print("| what | milliseconds |\n| --- | --- |")
    for name, value in rows:
        print(f"| {name} | {value:.2f} |", flush=True)


def in_window():
    """Yields seconds to wait: the window comes, the sidebar gets to know its tabs, panels are drawn."""
    yield 1
    rows = all_frame_changes()
    biggest().spaces.active.show_region_ui = True
    yield 3
    report(rows + (yield from windowed()))
    bpy.ops.wm.quit_blender()


if __name__ == "__main__":
    package()
    if bpy.app.background:
        report(all_frame_changes())
        sys.modules["timesplat.addon"].unregister()
    else:
        steps = in_window()
        bpy.app.timers.register(lambda: next(steps, None))
