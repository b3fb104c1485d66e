# SPDX-License-Identifier: GPL-3.0-or-later
"""Paired differences against figures worked out by hand."""

import json

from timesplat.evaluation.differences import compare, read


def test_pairs_by_hand(tmp_path):
    path, lines = tmp_path / "rows.jsonl", []
    for method, scores in (("a", {"x": 20.0, "y": 30.0}), ("b", {"x": 21.0, "y": 30.5, "z": 99.0}), ("c", {"z": 1.0})):
        for name, db in scores.items():
            row = {"size": 128, "setup": "random", "method": method, "object": name, "novel_psnr": db}
            lines.append(json.dumps(row | {"gaussians_kept": 100 if method == "a" else 10, "seconds": 2.0}))
    path.write_text("\n\n".join(lines))
    table = compare(read(path), "a", ["b", "c"])
    assert len(table) == 3  # heading, rule, and b: nothing in common with c
    assert table[2] == "| 128 | random | b | 2 | +0.75 | 0.25 | +0.50 | 2 | 100 → 10 | 2.0 → 2.0 |"
    assert compare(read(path), "b", ["a"])[2].split(" | ")[7] == "0"
