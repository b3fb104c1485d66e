# SPDX-License-Identifier: GPL-3.0-or-later
"""More views, pixels and seconds: which views go in, which points are measured, and what is said where a line falls."""

from types import SimpleNamespace

import pytest

from timesplat.datagen.sequence import InputError
from timesplat.evaluation import scaling
from timesplat.evaluation.provenance import Provenance
from timesplat.evaluation.scaling import LINES, QUICK, Lines, falls, means, part_of, write


def clip(frames=6, each=4):
    views = [
        SimpleNamespace(frame=f, rig="target" if k == each else "x") for f in range(frames) for k in range(each + 1)
    ]
    inputs = [i for i, v in enumerate(views) if v.rig == "x"]
    return SimpleNamespace(views=views, root="clip", inputs=lambda: inputs)


def test_parts_are_even_over_the_frames_and_within_one_another():
    seq = clip()
    parts = {n: part_of(seq, n) for n in (3, 6, 9, 12, 24)}
    for n, part in parts.items():
        counts = [sum(seq.views[i].frame == f for i in part) for f in range(6)]
        assert len(set(part)) == n and max(counts) - min(counts) <= 1
        assert all(seq.views[i].rig == "x" for i in part) and part == part_of(seq, n)
    assert set(parts[6]) < set(parts[12]) < set(parts[24])
    assert [seq.views[i].frame for i in parts[3]] == [0, 2, 4]
    with pytest.raises(InputError, match="24 views that are not held out, and 25"):
        part_of(seq, 25)


def test_the_lines_go_through_the_centre():
    for lines in (LINES, QUICK):
        points = lines.points()
        assert points[0] == lines.centre and len(set(points)) == len(points)
        assert len(points) == sum(len(getattr(lines, k)) for k in scaling.AXES) - 2
        assert all(sum(a != b for a, b in zip(p, lines.centre, strict=True)) <= 1 for p in points)


def made_up(lines, psnr):
    return [
        {"object": o, "way": w, "views": v, "size": p, "seconds": s, "psnr": psnr(v, p, s), "worst": 20.0,
         "finer": psnr(v, p, s) + 2 * p if (v, s) == (lines.centre[0], lines.centre[2]) else None, "ssim": 0.9,
         "lpips": None, "gaussians": 1000, "taken": s}
        for o in "ab" for w in lines.ways for v, p, s in lines.points()
    ]  # fmt: skip


def test_falling_lines_are_named_and_all_is_written(tmp_path):
    lines = Lines((2, 4, 8), (8, 16), (1, 2), (4, 16, 2), ("deform", "4dgs"))
    rows = made_up(lines, lambda v, p, s: 30 + v - p)
    assert falls(means(rows), lines) == []
    rows = made_up(lines, lambda v, p, s: 30 - (v == 8) + 0.05 * (s == 1) - p)
    rows.pop()  # a point that not all objects have is none
    found = means(rows)
    assert len(found) == 2 * len(lines.points()) - 1
    assert falls(found, lines)[0] == "deform falls from 14.00 to 13.00 dB between 4 and 8 input views"
    rows = made_up(lines, lambda v, p, s: 30 + v - 3 * p)
    assert falls(means(rows), lines)[0] == "deform falls from 26.00 to 18.00 dB between 8 and 16 pixels a side"
    pytest.importorskip("matplotlib")
    text = write(tmp_path, rows, lines, Provenance.of("timesplat bench --scaling", []))
    assert "deform falls" in text and {"scaling.md", "scaling.csv", "scaling.png", "scaling.svg"} <= {
        f.name for f in tmp_path.iterdir()
    }
