"""Figures of many views, and the tables that are made of them."""

import csv
import re
from pathlib import Path

import numpy as np
import pytest

from timesplat.evaluation import paper, tables
from timesplat.evaluation.metrics import summarise
from timesplat.evaluation.paper import paper_rows
from timesplat.evaluation.provenance import Provenance
from timesplat.evaluation.tables import COLUMNS, collect, gather, table

MADE = Provenance(
    "timesplat evaluate data --setup all", "1.0", "1234567890ab", False, {"guided.safetensors": "0123456789ab"}
)


def row(values, setup="alternating", size=128, name="a", method="lift"):
    novel = [True] * (len(values) - 1) + [False]
    flip = [0.1 if n else None for n in novel]
    frames = {"psnr": values, "psnr_fg": values, "ssim": values, "lpips": [None] * len(values), "flip": flip}
    frames["novel"] = novel
    cost = {"seconds": 1.0, "seconds_scoring": 0.1, "gaussians": 2, "gaussians_kept": 1}
    what = {"setup": setup, "size": size, "object": name, "method": method, "stride": 1, "jobs": 1}
    what["has_depth"] = method == "lift"
    return summarise(frames) | cost | what | {"frames": frames}


def test_means_are_over_views_and_percentiles_over_all():
    m = collect({"a": {"m": row([10.0, 20.0])}, "b": {"m": row([30.0, 40.0])}})
    assert m["methods"]["m"]["psnr"] == 25 and m["methods"]["m"]["psnr_worst"] == 10
    assert m["methods"]["m"]["psnr_p5"] == pytest.approx(np.percentile([10, 20, 30, 40], 5))
    assert m["methods"]["m"]["novel_psnr"] == 20 and m["methods"]["m"]["flip"] == pytest.approx(0.1)
    assert m["methods"]["m"]["lpips"] is None
    assert m["objects"]["b"]["m"]["psnr"] == 35 and set(m["objects"]["b"]["m"]) == set(COLUMNS)
    assert table(m).count("\n") == 2


def test_nothing_novel_is_no_figure():
    frames = row([1.0, 2.0])["frames"] | {"novel": [False, False], "flip": [None, None]}
    out = summarise(frames)
    assert out["novel_psnr"] is None and out["flip"] is None and out["psnr"] == 1.5


@pytest.fixture
def metrics():
    rows = [row([20.0, 22.0], s, n, o) for s in ("alternating", "interpolation") for n in (128, 256) for o in "ab"]
    rows += [row([15.0, 16.0], "alternating", 256, "a", "gs-lrm-frame")]
    return gather(rows, MADE)


def test_the_layout_of_the_paper(metrics):
    text = tables.tables_md(metrics)
    lines = text.splitlines()
    assert lines[0] == "`timesplat evaluate data --setup all`"
    assert lines[2] == "timesplat 1.0; revision 1234567890ab with uncommitted changes; guided.safetensors 0123456789ab"
    assert "| Res. | Model | Sees | Alter. Canonical Views: PSNR | LPIPS | SSIM | Frame Interpolation: PSNR" in text
    assert "| 128 | lift | depth + motion | 21.00 | – | 21.000 | 21.00 | – | 21.000 |" in lines
    assert "| 256 | gs-lrm-frame (1 of 2 objects) | RGB only | 15.50 | – | 15.500 | – | – | – |" in lines
    assert "| 256 | 4D-LRM-Large | Yes | 30.094 | 0.041 | 0.967 | 30.028 | 0.042 | 0.967 | 27.810" in text
    assert text.count("other objects than ours") == 2 and text.count("LPIPS is left out") == 1
    for block in re.split(r"(?=^\| Res)", text, flags=re.M)[1:]:
        widths = {line.count("|") for line in block.splitlines() if line.startswith("|")}
        assert len(widths) == 1


def test_csv_holds_ours_and_the_papers(metrics):
    first, second, *rest = tables.tables_csv(metrics).splitlines()
    assert first == "# timesplat evaluate data --setup all" and second == f"# {MADE}"
    rows = list(csv.DictReader(rest))
    assert [r["model"] for r in rows if r["made_by"] == "ours"] == ["lift", "lift", "gs-lrm-frame"]
    assert float(rows[0]["alternating_psnr"]) == 21 and rows[0]["random_psnr"] == "" == rows[0]["alternating_lpips"]
    best = [r for r in rows if r["objects"] == "Objaverse4D (Test)"][-1]
    assert float(best["random_psnr"]) == 26.694 and best["sees"] == "RGB only"


def test_the_papers_rows():
    """All rows are there; single figures that stand out, and the empty cells."""
    consistent, objaverse = (paper_rows(t) for t in paper.TABLES.values())
    assert [len(consistent), len(objaverse)] == [10, 9]
    assert consistent[-1][3]["alternating"] == {"psnr": 32.177, "lpips": 0.028, "ssim": 0.98}
    assert consistent[3][1] == "SoM" and "interpolation" not in consistent[3][3]
    assert consistent[3][3]["random"] == {"psnr": 17.637, "lpips": 0.208, "ssim": 0.875}
    assert "interpolation" not in objaverse[3][3] and objaverse[4][3]["random"]["psnr"] == 19.379
    assert all(
        len(r[3]) == 4 for r in (*consistent, *objaverse) if r[1] not in ("SoM", consistent[4][1], objaverse[3][1])
    )


def test_one_setup_is_flat_and_files_are_whole(tmp_path: Path):
    flat = gather([row([20.0, 21.0])], Provenance("timesplat evaluate x", "1.0"))
    assert set(flat) >= {"methods", "objects", "machine", "versions", "command", "stride", "jobs"}
    tables.write_metrics(tmp_path, flat)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["metrics.json", "metrics.md"]
    assert (
        (tmp_path / "metrics.md").read_text().startswith("`timesplat evaluate x`\n\ntimesplat 1.0\n\n| method | PSNR |")
    )
