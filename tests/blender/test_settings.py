# SPDX-License-Identifier: GPL-3.0-or-later
"""What the settings select in the scene, and what is expected of them."""

from itertools import pairwise

import pytest

SELECT = """
part("addon").register()
settings, estimates = part("addon.settings"), part("addon.estimates")
scene, chosen = bpy.context.scene, bpy.context.scene.timesplat
ranges = [[list(settings.spread(1, e, n)) for n in (1, 2, 8, 24)] for e in (1, 2, 24, 40, 250)]
names = lambda: sorted(o.name for o in settings.objects(chosen, bpy.context))
everything = names()
bpy.ops.mesh.primitive_cube_add()
cube = bpy.context.object
cube.name = "Child"
bpy.ops.object.empty_add()
empty = bpy.context.object
cube.parent = empty
bpy.ops.mesh.primitive_cube_add()
asset = bpy.context.object
asset.name, asset["timesplat"] = "Asset", 1
bpy.ops.object.select_all(action="DESELECT")
empty.select_set(True)
chosen.source = "SELECTED"
selected = names()
group = bpy.data.collections.new("Group")
scene.collection.children.link(group)
group.objects.link(cube)
chosen.source, chosen.collection = "COLLECTION", "Group"
collected = names()
chosen.every = 7
own = list(settings.frames(chosen, scene))
said = [settings.cameras(bpy.context)[1]]
chosen.source = "SCENE"
bpy.ops.timesplat.add_cameras(rig="ORBIT", count=5)
pictures = []
for every, turn in ((7, False), (7, True)):
    chosen.every, chosen.in_turn = every, turn
    pictures.append(estimates.estimate(chosen, bpy.context).pictures)
said.append(settings.cameras(bpy.context)[1])
bpy.ops.object.select_all(action="DESELECT")
said.append(settings.cameras(bpy.context)[1])
bpy.data.objects["Camera"].select_set(True)
said.append(settings.cameras(bpy.context)[1])
chosen.in_turn, chosen.every = True, 50
counts, chosen.method = {}, "guided"
for budget, refine, size in (("ALL", 0, 128), ("SHARE", 0, 128), ("SHARE", 0, 32), ("NUMBER", 0, 128), ("ALL", 9, 256)):
    chosen.budget, chosen.refine, chosen.size, chosen.number = budget, refine, size, 100
    e = estimates.estimate(chosen, bpy.context)
    counts[f"{budget} {refine} {size}"] = [e.gaussians, e.reconstructing]
estimates.learn_number("guided", 9000, 1, 100)
chosen.budget, chosen.refine, chosen.size = "ALL", 0, 128
counts["learnt"] = estimates.estimate(chosen, bpy.context).gaussians
chosen.method = "tracks"
for budget, refine, size in (("ALL", 0, 128), ("ALL", 9, 256), ("SHARE", 0, 128), ("ALL", 0, 32), ("ALL", 0, 1024)):
    chosen.budget, chosen.refine, chosen.size = budget, refine, size
    e = estimates.estimate(chosen, bpy.context)
    counts[f"tracks {budget} {refine} {size}"] = [e.gaussians, e.reconstructing]
estimates.learn_number("tracks", 9000, 5, 128)
chosen.size = 256
counts["tracks learnt"] = estimates.estimate(chosen, bpy.context).gaussians
chosen.every = 1  # 250 pictures
for method, quality, size in (("tracks", "DRAFT", 256), ("tracks", "FINE", 512), ("lift", "DRAFT", 128)):
    chosen.method, chosen.quality, chosen.size = method, quality, size
    e = estimates.estimate(chosen, bpy.context)
    counts[f"{method} {quality} {size}"] = [e.gaussians, e.reconstructing]
tell(counts=counts, ranges=ranges, everything=everything, selected=selected, collected=collected, own=own, said=said,
     estimates=pictures)
"""


def test_what_the_settings_select(blender):
    told = blender(SELECT)
    for row, end in zip(told["ranges"], (1, 2, 24, 40, 250), strict=True):
        for frames, count in zip(row, (1, 2, 8, 24), strict=True):
            steps = {b - a for a, b in pairwise(frames)}
            assert frames[0] == 1 and len(frames) <= count and len(steps) <= 1
            if count > 1:
                assert frames[-1] <= end < frames[-1] + max([1, *steps])
    assert told["everything"] == ["Camera", "Cube", "Light"]
    assert told["selected"] == ["Child", "Empty", "Light"] and told["collected"] == ["Child", "Light"]
    assert told["own"] == [*range(1, 251, 7)] and told["estimates"] == [5 * 36, 36]
    assert told["said"] == [
        "All sides, above and below in turn", "5 selected cameras", "5 cameras of the rig", "1 selected camera",
    ]  # fmt: skip
    from timesplat.model.fitting.refine import FROM_DEPTH

    counts = told["counts"]  # five pictures
    assert counts["ALL 0 128"][0] == round(0.19 * 5 * 128**2) and counts["SHARE 0 128"][0] == round(0.019 * 5 * 128**2)
    assert counts["SHARE 0 32"][0] == round(0.019 * 5 * 32**2) and counts["NUMBER 0 128"][0] == 100
    assert counts["learnt"] == round(0.9 * 5 * 128**2)
    assert counts["ALL 9 256"][0] == 2 * FROM_DEPTH.max_gaussians
    assert counts["SHARE 0 128"][1] - counts["ALL 0 128"][1] == pytest.approx(5)

    from timesplat.datagen import tracks  # the surface's pixels, however many pictures show them

    assert [counts[f"tracks ALL 0 {n}"][0] for n in (32, 128, 1024)] == [
        tracks.FEWEST,
        round(0.63 * 128**2),
        tracks.MOST,
    ]
    assert counts["tracks SHARE 0 128"][0] == round(0.063 * 128**2) and counts["tracks learnt"] == 4 * 9000
    assert counts["tracks SHARE 0 128"][1] == counts["tracks ALL 0 128"][1]
    step = {n: 128**2 * 3e-7 + n * 1e-6 for n in (10_000, 4000)}  # a quality's seconds are those of its steps
    for key, taken in (("tracks DRAFT 256", 300 * step[10_000]), ("lift DRAFT 128", 300 * step[4000])):
        method, _, size = key.split()
        assert counts[key][0] == (10_000 if method == "tracks" else 4000)
        a_pixel = 1e-6 if method == "tracks" else 8e-7
        assert counts[key][1] == pytest.approx(3 + 250 * int(size) ** 2 * a_pixel + taken)
    assert counts["tracks FINE 512"][1] == pytest.approx(
        3 + 250 * 512**2 * 1e-6 + 4000 * (512**2 * 3e-7 + 100_000 * 1e-6)
    )
    assert counts["tracks ALL 9 256"] == [round(0.63 * 256**2), pytest.approx(3 + 9 + 5 * 256**2 * 1e-6)]
