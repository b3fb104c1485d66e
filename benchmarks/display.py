# SPDX-License-Identifier: GPL-3.0-or-later
"""What an asset costs in Blender: a frame change, the panels, a redraw of the viewport.

    python benchmarks/display.py                          with the bpy wheel: frame changes
    blender -b --python benchmarks/display.py             the same in any Blender
    blender --python benchmarks/display.py                with a window: panels and redraws too; ends Blender

A frame change is scene.frame_set, which evaluates the modifier; a panel's row is what one draw of the sidebar costs
on that tab (all of Blender's own work included), and what the add-on's draw() functions take of it. Each is the median
of REPEATS.
"""

import importlib.util
import statistics
import sys
import time
from pathlib import Path

import bpy
import numpy as np

COUNT, REPEATS = 200_000, 41
ROOT = Path(__file__).resolve().parent.parent


def package():
    """The checkout as `timesplat`, whether or not it is installed in this Python."""
    if "timesplat" not in sys.modules:
        init, where = ROOT / "__init__.py", [str(ROOT)]
        spec = importlib.util.spec_from_file_location("timesplat", init, submodule_search_locations=where)
        sys.modules["timesplat"] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules["timesplat"])


def asset():
    """COUNT Gaussians over the cube, of which at each frame of 24 about a third is visible."""
    from timesplat.model.asset import Asset, Clip

    r = np.random.default_rng(0)
    q = r.normal(size=(COUNT, 4))
    arrays = {
        "xyz": r.uniform(-0.8, 0.8, (COUNT, 3)),
        "t": r.uniform(-1, 1, COUNT),
        "velocity": r.normal(0, 0.3, (COUNT, 3)),
        "sigma_t": r.uniform(0.1, 0.4, COUNT),
        "scale": np.exp(r.uniform(-6, -4, (COUNT, 3))),
        "rotation": q / np.linalg.norm(q, axis=1, keepdims=True),
        "rgb": r.uniform(0, 1, (COUNT, 3)),
        "opacity": r.uniform(0.1, 0.99, COUNT),
    }
    return Asset(**{k: a.astype(np.float32) for k, a in arrays.items()}, clip=Clip(24, 1, 24))


def median(act) -> float:
    """Milliseconds, after one call that is not counted."""
    times = []
    for i in range(REPEATS + 1):
        start = time.perf_counter()
        act(i)
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times[1:])


def frame_changes(ob) -> list[tuple[str, float]]:
    from timesplat.addon import display

    scene, rows = bpy.context.scene, []
    for look in ("Points", "Splats"):
        display.set_input(display.sampler(ob), "Look", look)
        for name, step in (("whole frames", 1.0), ("fractional frames", 0.37)):

            def change(i, step=step):
                frame = 1 + (i * step) % 23
                scene.frame_set(int(frame), subframe=frame % 1)

            rows.append((f"frame change, {look}, {name}", median(change)))
    display.set_input(display.sampler(ob), "Look", "Points")
    return rows


def biggest():
    """The biggest 3D view of the window."""
    areas = bpy.context.window_manager.windows[0].screen.areas
    return max((a for a in areas if a.type == "VIEW_3D"), key=lambda a: a.width * a.height)


def windowed() -> list[tuple[str, float]]:
    """Draws of the sidebar and of the viewport."""
    window, area = bpy.context.window_manager.windows[0], biggest()
    regions = {r.type: r for r in area.regions}
    rows, spent = [], [0.0]

    def timed(draw):
        def inner(self, context):
            start = time.perf_counter()
            draw(self, context)
            spent[0] += 1e3 * (time.perf_counter() - start)

        return inner

    ours = [c for c in bpy.types.Panel.__subclasses__() if c.__module__.startswith("timesplat.")]
    for panel in ours:
        panel.draw = timed(panel.draw)

    def drawn(region, kind="DRAW"):
        def act(i):
            with bpy.context.temp_override(window=window, area=area, region=region):
                bpy.ops.wm.redraw_timer(type=kind, iterations=1)

        return act

    for tab in ("View", "Timesplat"):
        regions["UI"].active_panel_category = tab
        drawn(regions["UI"])(0)
        spent[0] = 0.0
        rows.append((f"sidebar, tab {tab}", median(drawn(regions["UI"]))))
        rows.append((f"  of it draw() of the add-on, {len(ours)} panels", spent[0] / (REPEATS + 1)))
    space = area.spaces.active
    for shading in ("SOLID", "MATERIAL"):
        space.shading.type = shading
        for _ in range(3):
            drawn(regions["WINDOW"], "DRAW_SWAP")(0)  # shaders are compiled
        rows.append((f"viewport {shading.lower()}, {area.width}x{area.height}", median(drawn(regions["WINDOW"]))))
    return rows


def main() -> None:
    from timesplat.addon import display, register

    register()
    bpy.ops.object.select_all(action="DESELECT")
    ob = display.add_asset(asset(), "benchmark", look="Points")
    rows = frame_changes(ob)
    if not bpy.app.background:
        rows += windowed()
    print(f"\nBlender {bpy.app.version_string}, {COUNT:,} Gaussians, median of {REPEATS}")
    print("| what | milliseconds |\n| --- | --- |")
    for name, value in rows:
        print(f"| {name} | {value:.2f} |")


def in_window():
    """Once the window is there: opens the sidebar, waits for it, measures, ends."""
    area = biggest()
    area.spaces.active.show_region_ui = True

    def measure():
        try:
            main()
        finally:
            bpy.ops.wm.quit_blender()

    bpy.app.timers.register(measure, first_interval=1)


if __name__ == "__main__":
    package()
    if bpy.app.background:
        main()
        sys.modules["timesplat.addon"].unregister()
    else:
        bpy.app.timers.register(in_window, first_interval=1)
