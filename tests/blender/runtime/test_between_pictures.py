# SPDX-License-Identifier: GPL-3.0-or-later
"""Clips of which a picture is taken now and then: surfaces are followed through the frames between."""

import numpy as np

from timesplat.datagen.sequence import read_sequence

from ..helpers import CHECKOUT, Runner
from .test_capture import SETUP

SWINGS = """
def make(scene):
    b = box()
    driver(b, "location", 0, "2 * sin(frame)")
    driver(b, "location", 2, "2 * cos(frame)")
    return steps(1, 10, 4, method="tracks")
case("swings", make)
ob = bpy.data.objects["Box"]
norm = capturing.Normalisation(3.0, (0.0, 0.0, 0.0))
def chosen(points, objects=(ob,)):
    asked = {"frames": [1, 5, 9], "last": 10, "tracks": points, "size": 24}
    return capturing.clip_frames(asked, norm, list(objects))
most = capturing.MOST_FLOATS // 7
told["memory"] = [chosen(most // n) for n in (10, 9, 4)]
blob = add("Blob", bpy.data.metaballs.new("Blob"))
driver(blob.data.elements.new(), "radius", -1, "1 + frame / 9")
told["blob"] = chosen(1, [ob, blob])
tell(told=told)
"""


def test_surfaces_are_followed_between_pictures(tmp_path):
    told = Runner(tmp_path / "blender", CHECKOUT)(SETUP + SWINGS, tmp_path)["told"]
    assert told["swings"] == ""
    assert told["memory"] == [[*range(1, 11)], [1, 3, 5, 7, 9], [1, 5, 9]]
    assert told["blob"] == [1, 5, 9], "whose topology changes"
    seq = read_sequence(tmp_path / "swings")
    assert (seq.frame_start, seq.frame_end, seq.fps) == (0, 9, 24)
    assert seq.provenance["scene_frames"] == [*range(1, 11)]
    assert sorted({v.frame for v in seq.views}) == [0, 4, 8]
    tracks, norm = seq.load_tracks(), seq.normalisation
    middle = (tracks.position.min(0) + tracks.position.max(0)) / 2 * norm.scale + np.array(norm.translation)
    frame = np.arange(1, 11)
    expected = np.stack([2 * np.sin(frame), 0 * frame, 2 * np.cos(frame)], 1)
    np.testing.assert_allclose(middle, expected, atol=0.05)  # of a box of which not every corner has a point
