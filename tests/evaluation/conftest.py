# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects on disk that the tests of evaluation share."""

import json
import math
import re
import shutil

import numpy as np
import pytest

from timesplat.datagen import rigs

FRAMES = list(range(24))


@pytest.fixture
def folders(sphere_folder, tmp_path):
    """Two objects with one Sequence each, and a half-written one."""
    for name in ("a/line", "b/line", "b/.line.tmp"):
        copy = shutil.copytree(sphere_folder, tmp_path / "data" / name) / "transforms.json"
        if name == "b/line":
            copy.write_text(copy.read_text() + " ")  # not the same Sequence
    return tmp_path / "data"


@pytest.fixture
def alternating_folders(folders):
    """The same, their inputs of the rig `alternating`."""
    for f in folders.glob("?/line/transforms.json"):
        f.write_text(re.sub(r'"rig": "(?!target)\w*"', '"rig": "alternating"', f.read_text()))
    return folders


@pytest.fixture(scope="session")
def evaluation_folder(spheres, write_views, tmp_path_factory):
    """The spheres from the rig `evaluation` with one held-out view a frame, 32x32."""
    shots = rigs.evaluation(FRAMES) + rigs.targets(FRAMES)
    angles = []
    for s in shots:
        x, y, z = s.c2w[:3, 3] / np.linalg.norm(s.c2w[:3, 3])
        angles.append((math.degrees(math.atan2(-x, -y)), math.degrees(math.asin(z))))
    folder = tmp_path_factory.mktemp("data") / "spheres" / "line"
    write_views(spheres([s.frame for s in shots], angles, size=32), folder)
    path = folder / "transforms.json"
    d = json.loads(path.read_text())
    for f, s in zip(d["frames"], shots, strict=True):
        f["camera"], f["rig"] = s.camera, s.rig
    path.write_text(json.dumps(d))
    return folder
