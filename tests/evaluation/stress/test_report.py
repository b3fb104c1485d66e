# SPDX-License-Identifier: GPL-3.0-or-later
"""The report, from made-up figures."""

import pytest

from timesplat.evaluation.provenance import Provenance
from timesplat.evaluation.stress import report
from timesplat.evaluation.stress.report import Result
from timesplat.evaluation.stress.sweeps import SWEEPS


def row(psnr, key="none", **more):
    figures = {"psnr": psnr, "psnr_p5": psnr - 1, "psnr_worst": psnr - 3, "flip": 0.05, "ghost": 1.5, "flicker": 2}
    return {"key": key, "failed": "", **figures, "between": psnr - 0.5, "at_whole": psnr, **more}


@pytest.fixture
def results():
    speed = {
        "good": {0: row(30), 0.5: row(29), 2: row(28)},
        "bad": {0: row(30), 0.5: row(25), 2: {"key": "x", "failed": "InputError: too fast", "psnr": ""}},
    }
    seed = {"good": {0: row(30), 1: row(30.2), 2: row(29.8)}}
    return [Result(SWEEPS["speed"], speed), Result(SWEEPS["seed"], seed)]


def test_tables(results):
    text = report.markdown(results)
    assert "## speed: fast motion (0, 0.5, 2 radii a moment)" in text
    assert "| good | 30.00 | never | 28.00 | 27.00 | 25.00 | 0.050 | 1.50 | 2.00 | -0.50 |  |" in text
    assert "| bad | 30.00 | 0.3 | – | – | – | – | – | – | – | 2: InputError: too fast |" in text
    assert "| good | 30.00 | 0.200 | 0.400 |" in text


def test_a_page_and_a_chart(results, tmp_path):
    pytest.importorskip("matplotlib")
    (tmp_path / "pictures").mkdir()
    from PIL import Image

    Image.new("RGB", (8, 4)).save(tmp_path / "pictures" / "none.png")
    report.write(tmp_path, results, Provenance("timesplat stress --quick"), "About.")
    page = (tmp_path / "stress.html").read_text()
    assert page.count("data:image/png") == 1 + 5 + 3, "a chart, and the pictures that there are"
    assert "InputError: too fast" in page and "http" not in page.replace("http-", "")
    assert (tmp_path / "stress.png").stat().st_size > 5000
    assert (tmp_path / "stress.md").read_text().startswith("# Stability\n\n`timesplat stress --quick`")
