# SPDX-License-Identifier: GPL-3.0-or-later
"""A real Blender with a window, by mouse and keyboard alone: from a fresh profile to a scrubbed, exported asset;
and what an artist does while a Job runs. Pictures of every step go to TIMESPLAT_PICTURES, if it is set.

What acts on Blender is only ever the mouse and the keyboard; `ask` looks and changes nothing (see window.py)."""

import os
import re
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from timesplat.model.io import slices
from timesplat.model.io.asset import Clip
from timesplat.model.io.ply import read_ply, write_ply
from timesplat.model.io.usd_check import check_usd
from timesplat.model.io.usd_write import write_usd

from .helpers import REAL, TARGET, make
from .window import Window, missing

pytestmark = [
    pytest.mark.skipif(not REAL, reason="TIMESPLAT_BLENDER names no Blender that has windows"),
    pytest.mark.skipif(bool(missing(TARGET)), reason=f"no {missing(TARGET)} for a window"),
]

MONKEY = """
for o in list(bpy.data.objects):
    bpy.data.objects.remove(o)
scene = bpy.context.scene
scene.frame_start, scene.frame_end = 1, 12
bpy.ops.mesh.primitive_monkey_add(size=2)
ob = bpy.context.object
ob.modifiers.new("Subdivision", "SUBSURF").render_levels = 1
bpy.ops.object.shade_smooth()
fur = bpy.data.materials.new("Fur")
fur.use_nodes = True
fur.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.8, 0.25, 0.08, 1)
fur.diffuse_color = (0.8, 0.25, 0.08, 1)
ob.data.materials.append(fur)
for frame, height, turn in ((1, 0, -40), (6, 0.8, 0), (12, 0, 40)):
    ob.location.z, ob.rotation_euler.z = height, np.radians(turn)
    ob.keyframe_insert("location", frame=frame)
    ob.keyframe_insert("rotation_euler", frame=frame)
chosen = scene.timesplat
chosen.size, chosen.samples, chosen.method, chosen.budget, chosen.refine = 64, 8, "lift", "ALL", 0
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
tell()
"""
JOBS_TAKE = 900  # seconds at most, what takes half a minute on a machine that does nothing else
JOBS = "[(j.state, j.fraction, j.text, j.message) for j in ours('addon.runtime.jobs').JOBS]"
STATE = "[(s.name, s.frame_current, s.render.resolution_x, s.camera) for s in bpy.data.scenes], len(bpy.data.cameras)"
SPACE = "next(a.spaces.active for a in bpy.context.window_manager.windows[0].screen.areas if a.type == 'VIEW_3D')"
SHADING = f"[getattr({SPACE}.shading, x) for x in ('type', 'light', 'color_type')]"
ENDED = f"[s for s, *_ in {JOBS} if s not in ('running', 'waiting')]"


@pytest.fixture
def window(installed, tmp_path, request):
    """window(*arguments, env={}) -> a Window on a profile with the extension. tmp_path/monkey.blend has Suzanne, who
    hops and turns in twelve frames."""
    installed(MONKEY, tmp_path / "monkey.blend")
    (tmp_path / "home").mkdir()
    env = {"HOME": str(tmp_path / "home")}
    yield lambda *args, **more: Window(TARGET, tmp_path / "window", installed.user, *args, env={**env, **more})
    if kept := os.environ.get("TIMESPLAT_PICTURES"):
        shutil.copytree(tmp_path / "window/pictures", Path(kept) / request.node.name, dirs_exist_ok=True)


def socket(name: str) -> str:
    """Asks for the identifier of the asset's slider of this name."""
    tree = "bpy.context.object.modifiers[0].node_group.interface.items_tree"
    return f"[i.identifier for i in {tree} if i.name == {name!r}][0]"


def orange(w: Window, view: dict) -> int:
    """How many pixels of the 3D view have the monkey's hue."""
    image = np.asarray(Image.open(w.picture("orange")).convert("RGB")).astype(int)
    part = image[view["y"] : view["y"] + view["h"], view["x"] : view["x"] + view["w"] // 2]
    return int(((part[..., 0] > 120) & (part[..., 0] > 1.4 * part[..., 1]) & (part[..., 1] > 1.2 * part[..., 2])).sum())


def processes(folder: Path) -> list[str]:
    """What runs with its temporary files in a folder: Blender and all that it started."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if str(folder).encode() in (entry / "environ").read_bytes() and (entry / "cmdline").read_bytes():
                found.append(f"{entry.name} {(entry / 'cmdline').read_bytes()[:200]}")
        except OSError:
            continue
    return found


def nothing_left(w: Window) -> None:
    """No process, and no file but what Blender itself leaves: autosaves, shaders, its sound server's folder."""
    assert processes(w.tmp) == []
    ours = [p.name for p in w.tmp.iterdir() if not re.fullmatch(r"pulse-.*|blender|.*\.blend", p.name)]
    runs = list(Path(w.env["BLENDER_USER_RESOURCES"]).rglob("runs/*"))
    assert ours == [] and runs == []


def test_from_a_fresh_profile_to_a_scrubbed_exported_asset(window, tmp_path):
    with window() as w:
        w.move(600, 400)
        time.sleep(0.7)
        w.picture("start")
        w.key("Escape")  # the splash
        w.key("ctrl+o")
        w.choose(tmp_path / "monkey.blend")
        w.wait_for("bpy.data.filepath and len(bpy.data.objects) == 1")
        side = w.sidebar()
        w.find("preferences.addon_show", side["x"] + 0.75 * (side["w"] - 28), 100, 300)  # until there is a runtime
        w.preferences(sys.executable)
        assert w.ask("ours('addon.runtime.worker_options').addon_preferences().python") == sys.executable

        w.sidebar()
        w.press("preset='DRAFT'", across=0.15)
        w.fill("timesplat.size", "56", top=300)
        w.fill("timesplat.samples", "4", top=370)
        assert w.ask("[bpy.context.scene.timesplat.size, bpy.context.scene.timesplat.samples]") == [56, 4]
        w.picture("settings")
        before = w.ask(STATE)
        w.press("timesplat.reconstruct")
        w.wait_for(f"{JOBS}[-1][1] > 0.1 and len(ours('addon.runtime.jobs').running()) == 1", JOBS_TAKE)
        w.picture("running")
        w.wait_for(ENDED, JOBS_TAKE)
        assert w.ask(JOBS)[-1][0] == "done", w.ask(JOBS)
        w.wait_for("bpy.context.object.get('timesplat')")
        assert w.ask("[o.hide_get() for o in bpy.data.objects if o.name == 'Suzanne']") == [True]
        w.press("timesplat.show_colours")
        assert w.ask(SHADING) == ["SOLID", "FLAT", "VERTEX"]
        view = w.area("VIEW_3D")
        w.move(view["x"] + view["w"] / 3, view["y"] + view["h"] * 0.8)
        time.sleep(0.7)
        w.key("Home")  # frames it
        w.picture("done")
        assert orange(w, view) > 2000, "it is there, in its own colour"
        count = int(w.ask(JOBS)[-1][3].split()[0].replace(",", ""))
        assert count > 200
        assert w.ask(STATE) == before

        # the whole clip across the timeline, then along it
        timeline = w.region("DOPESHEET_EDITOR", "WINDOW")
        x, y = timeline["x"], timeline["y"] + 9
        w.move(x + timeline["w"] / 2, y + 15)
        time.sleep(0.7)
        w.key("Home")
        seen = []
        for share in (0.1, 0.35, 0.6, 0.85):
            w.drag(x + timeline["w"] * (share - 0.05), y, x + timeline["w"] * share, y, steps=4)
            seen.append(w.ask("bpy.context.scene.frame_current"))
            w.picture(f"frame {seen[-1]}")
        assert seen == sorted(set(seen)) and seen[0] < 4 and seen[-1] > 8
        w.key("Right")
        assert w.ask("bpy.context.scene.frame_current") == seen[-1] + 1
        w.key("Left", "Left")
        assert w.ask("bpy.context.scene.frame_current") == seen[-1] - 1

        # a slider, in sight at the top
        side = w.region("VIEW_3D", "UI")
        cut = w.ask(socket("Opacity Cut"))
        w.fill(cut, "0.3", across=0.7)
        value = w.under(side["x"] + 0.7 * (side["w"] - 28), w.place[1])
        assert float(value) == pytest.approx(0.3)
        w.picture("opacity cut")
        w.fill(cut, "0.05", across=0.7)

        for name in ("out.ply", "out.usdz"):
            w.menu("Export", "timesplat.export_asset")
            w.choose(tmp_path / name)
            w.wait_for(f"os.path.exists({str(tmp_path / name)!r})", JOBS_TAKE)
            w.picture(f"exported {name}")
        assert w.ask("'torch' in sys.modules or 'timesplat' in sys.modules") is False
        w.key("ctrl+s")
        w.wait_for("not bpy.data.is_dirty")
        w.key("ctrl+q")
        assert w.process.wait(60) == 0
    nothing_left(w)

    asset = read_ply(tmp_path / "out.ply")
    assert len(asset) == count and (asset.clip.frame_start, asset.clip.frame_end) == (1, 12)
    heights = {}
    for frame in (1, 6, 12):  # she hops
        position, opacity = asset.at(asset.frame_to_time(frame))
        world = position * asset.clip.scale + np.array(asset.clip.translation)
        heights[frame] = np.average(world[:, 2], weights=opacity)
        assert np.abs(world[opacity > 0.3]).max() < 2.2
    assert heights[6] - heights[1] == pytest.approx(0.8, abs=0.25), heights
    assert heights[6] - heights[12] == pytest.approx(0.8, abs=0.25), heights
    assert check_usd(tmp_path / "out.usdz") == []


def test_what_an_artist_does_while_a_job_runs(window, tmp_path):
    """Esc while pictures are rendered; the row's cross while the model runs; undo, saving; another file; quitting."""
    shutil.copy(tmp_path / "monkey.blend", tmp_path / "other.blend")
    with window(tmp_path / "monkey.blend", TIMESPLAT_PYTHON=sys.executable) as w:
        region = w.sidebar()
        view = w.area("VIEW_3D")

        def start(seen: str) -> None:
            jobs = len(w.ask(JOBS))
            w.press("timesplat.reconstruct")
            w.wait_for(f"len({JOBS}) == {jobs + 1} and {seen!r} in {JOBS}[-1][2]", JOBS_TAKE)

        def over_the_view(*keys: str) -> None:
            w.move(view["x"] + view["w"] / 3, view["y"] + view["h"] * 0.8)
            time.sleep(0.7)
            w.key(*keys)

        def alone() -> None:
            w.wait_for("not ours('addon.runtime.jobs').running()")
            time.sleep(0.5)
            assert len(processes(w.tmp)) == 1, processes(w.tmp)  # Blender
            assert list(Path(w.env["BLENDER_USER_RESOURCES"]).rglob("runs/*")) == []

        start("rendering")
        over_the_view("Escape")
        w.wait_for(f"{JOBS}[-1][0] == 'cancelled'", 5)
        alone()
        w.picture("cancelled while rendering")

        start("reconstruct")
        cross = region["x"] + region["w"] - 45
        w.click(cross, w.find("timesplat.cancel", cross, w.place[1] + 10, w.place[1] + 60))
        w.wait_for(f"{JOBS}[-1][0] == 'cancelled'", 5)
        alone()
        w.picture("cancelled while reconstructing")

        start("rendering")
        over_the_view("g", "x", "1", "Return", "ctrl+z", "ctrl+shift+z", "ctrl+z", "ctrl+s")
        w.picture("undone and saved while running")
        assert w.ask(JOBS)[-1][0] == "running" and not w.ask("bpy.data.is_dirty")
        w.wait_for(ENDED + "[2:]", JOBS_TAKE)
        assert w.ask(JOBS)[-1][0] == "done", w.ask(JOBS)
        w.wait_for("bpy.context.object.get('timesplat')")
        over_the_view("ctrl+z")
        assert w.ask("[o.name for o in bpy.data.objects]") == ["Suzanne"]  # the result is one step of undo
        over_the_view("ctrl+shift+z")
        w.wait_for("len(bpy.context.scene.objects) == 2")
        over_the_view("ctrl+s")
        alone()

        start("rendering")
        over_the_view("ctrl+o")
        w.choose(tmp_path / "other.blend")
        w.wait_for("bpy.data.filepath.endswith('other.blend')")
        w.wait_for(f"{JOBS}[-1][0] == 'waiting'", JOBS_TAKE)  # it came from another file: it waits to be asked for
        w.sidebar()
        w.picture("waiting in another file")
        assert w.ask("len(bpy.data.objects)") == 1
        w.click(cross - 46, w.find("timesplat.bring", cross - 46, 150, 500))
        w.wait_for("bpy.context.object.get('timesplat')")
        w.picture("brought in")
        alone()

        start("rendering")
        over_the_view("ctrl+q")
        time.sleep(2)
        if w.process.poll() is None:
            w.picture("quitting")
            w.key("d")  # Don't Save
        assert w.process.wait(60) == 0, w.said()
    nothing_left(w)


ASSET = """
bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
scene = bpy.context.scene
bpy.ops.timesplat.import_asset(filepath=sys.argv[2])
bpy.context.object["timesplat_source"] = ["Suzanne"]
scene.frame_set(6)
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
tell()
"""
COUNT = "len(getattr(bpy.context.object.data, 'points', None) or bpy.context.object.data.vertices)"


def test_the_buttons_below_a_result(window, installed, tmp_path):
    """Delete in a rectangle that is dragged, undo, bake, compare."""
    asset = make(400, clip=Clip(24, 1, 12))
    asset.sigma_t[:] = 10
    write_ply(tmp_path / "a.ply", asset)
    installed(ASSET, tmp_path / "monkey.blend", tmp_path / "a.ply")
    with window(tmp_path / "monkey.blend", TIMESPLAT_PYTHON=sys.executable) as w:
        side = w.sidebar()
        view = w.area("VIEW_3D")
        assert w.ask(COUNT) == 400

        x = side["x"] + 0.75 * (side["w"] - 28)
        w.click(x, w.find("timesplat.export_asset", x, 100, 500) + 68)  # unfolds Edit
        w.move(view["x"] + view["w"] / 3, view["y"] + view["h"] * 0.8)
        time.sleep(0.7)
        w.key("shift+h", "Home")  # the result alone, filling the view
        w.press("timesplat.delete_rectangle")
        middle = view["x"] + view["w"] / 2, view["y"] + view["h"] / 2
        w.drag(middle[0], middle[1] - 300, middle[0] - 500, middle[1] + 350)
        w.wait_for(f"{COUNT} < 400")
        left = w.ask(COUNT)
        assert 40 < left < 360
        w.picture("deleted")
        w.move(view["x"] + view["w"] / 3, view["y"] + view["h"] * 0.8)
        time.sleep(0.7)
        w.key("ctrl+z")
        w.wait_for(f"{COUNT} == 400")
        w.key("ctrl+shift+z")
        w.wait_for(f"{COUNT} == {left}")

        w.press("timesplat.bake")
        w.move(w.place[0], w.place[1] - 40)  # from the dialog's first field to its title
        time.sleep(0.7)
        w.key("Return")
        w.wait_for("sum('timesplat_clip' in o for o in bpy.data.objects) == 2")
        assert w.ask(COUNT) <= left
        w.picture("baked")

        w.press("timesplat.compare", across=0.25)
        w.wait_for(f"{JOBS} and {JOBS}[-1][0] not in ('running', 'waiting')", JOBS_TAKE)
        assert w.ask(JOBS)[-1][0] == "done" and "PSNR" in w.ask(JOBS)[-1][3], w.ask(JOBS)
        w.wait_for("any(a['kind'] == 'IMAGE_EDITOR' for x in look() for a in x['areas'])")
        time.sleep(2)
        w.picture("compared")
        assert w.ask("list(bpy.data.images['Timesplat Compare'].size)")[0] == 3 * 384
    assert list(Path(w.env["BLENDER_USER_RESOURCES"]).rglob("runs/*")) == []


def test_a_rig_is_put_and_undone_while_the_view_renders(window, tmp_path):
    """Blender 4.3 crashed at the next undo when a scene was made for measuring; and a pose without a key was lost."""
    with window(tmp_path / "monkey.blend", TIMESPLAT_PYTHON=sys.executable) as w:
        region = w.sidebar()
        view = w.area("VIEW_3D")
        rig = "[o.name for o in bpy.data.objects if o.type == 'CAMERA']"
        across = region["x"] + 0.25 * (region["w"] - 28)
        light = w.find("timesplat.lighting", region["x"] + 0.6 * (region["w"] - 28), 300, 700, "ctrl+shift+c")
        w.click(across, light + 32)  # unfolds Cameras
        button = w.find("rig='CANONICAL'", across, 300, region["y"] + region["h"], step=8)

        def over_the_view(*keys: str) -> None:
            w.move(view["x"] + view["w"] / 3, view["y"] + view["h"] * 0.8)
            time.sleep(0.7)
            w.key(*keys)

        place = "list(bpy.data.objects['Suzanne'].location)"
        over_the_view("g", "x", "1", "Return")
        w.wait_for(f"{place}[0] > 0.9")
        moved = w.ask(place)
        over_the_view("z", "8")
        areas = "bpy.context.window_manager.windows[0].screen.areas"
        w.wait_for(f"any(a.type == 'VIEW_3D' and a.spaces.active.shading.type == 'RENDERED' for a in {areas})")
        for i in range(5):
            w.click(across, button)
            w.wait_for(f"len({rig}) == 4")
            assert w.ask(place) == moved
            w.picture(f"rig {i}")
            over_the_view("ctrl+z")
            w.wait_for(f"len({rig}) == 0")
            w.wait_for("bpy.context.view_layer.update() is None")


def test_files_that_are_dropped_on_the_view(window, tmp_path):
    """From another program, as XDND: an asset, two files as a sequence, USD, and one that is no PLY."""
    xdnd = pytest.importorskip("tests.blender.xdnd", reason="python-xlib is not installed", exc_type=ImportError)
    asset = make(300)
    write_ply(tmp_path / "our clip ü.ply", asset)
    for i, frame in enumerate((12, 20)):
        slices.write_slice(tmp_path / f"slice{i}.ply", asset, frame)
    (tmp_path / "letter.ply").write_text("Dear Blender, this is no PLY.\n")
    write_usd(tmp_path / "asset.usdz", asset)
    with window(tmp_path / "monkey.blend", TIMESPLAT_PYTHON=sys.executable) as w:
        view = w.area("VIEW_3D")
        x, y = round(view["x"] + view["w"] / 3), round(view["y"] + view["h"] / 2)

        def dropped(*names: str) -> None:
            """Drops; chooses Timesplat where Blender asks who shall read the files; presses OK."""
            w.move(x, y)
            time.sleep(0.7)
            xdnd.drop(w.env["DISPLAY"], x, y, [tmp_path / n for n in names])
            time.sleep(1.5)
            w.picture(f"dropped {names[0]}")
            if names[0].endswith(".ply"):  # Blender reads them too
                w.click(x + 30, w.find("timesplat.import_asset", x + 30, y - 25, y + 60))
                time.sleep(1)
                w.picture(f"chosen {names[0]}")
            w.key("Return")

        dropped("our clip ü.ply")
        w.wait_for("bpy.context.object.name == 'our clip ü'")
        assert w.ask(COUNT) == 300 and "300 Gaussians from our clip ü.ply" in w.said()
        dropped("slice0.ply", "slice1.ply")
        w.wait_for(f"bpy.context.object.name == {tmp_path.name!r}")
        assert f"from 2 files in {tmp_path.name}" in w.said()
        dropped("asset.usdz")
        w.wait_for("bpy.context.object.name == 'asset'", JOBS_TAKE)
        assert w.ask(COUNT) == 300
        dropped("letter.ply")
        time.sleep(1)
        w.picture("refused")
        assert f"{tmp_path / 'letter.ply'}: it is not a .ply file" in w.ask("reports()")
        assert w.ask("sum('timesplat_clip' in o for o in bpy.data.objects)") == 3
