# SPDX-License-Identifier: GPL-3.0-or-later
import base64
import io
import re

import numpy as np
from PIL import Image

from timesplat.datagen.curation.curate import curate
from timesplat.datagen.curation.decisions import Bounds, read_decisions
from timesplat.datagen.curation.page import advice

from .drawn import box, draw_sequence


def test_one_file_with_pictures_reasons_and_the_histogram(tmp_path):
    draw_sequence(tmp_path / "fox" / "Run", lambda t, camera: box(0.4 + 0.2 * t), licence="CC0-1.0", author="<Ann>")
    draw_sequence(tmp_path / "owl" / "Fly", lambda t, camera: box(0.7 * t + 0.1, side=0.5))
    curate(tmp_path, report=print)
    page = (tmp_path / "curation.html").read_text()
    assert not re.search(r'(src|href)="(?!data:)', page) and "http" not in page and "<script" not in page
    assert "fox/Run" in page and "CC0-1.0, &lt;Ann&gt;" in page and "not stated 1" in page
    assert "leaves the frame" in page and "<svg" in page and "--sufficient 0.25" in page
    pictures = [base64.b64decode(x) for x in re.findall(r"data:image/jpeg;base64,([^\"]+)", page)]
    assert len(pictures) == 2
    strip = np.asarray(Image.open(io.BytesIO(pictures[-1])))
    assert strip.shape == (72, 288, 3)
    assert strip[36, 24].mean() < 200 < 250 < strip[36, 4].mean()  # the fox is there, and white around it


def test_advice_names_the_bound_that_gives_the_papers_share(tmp_path):
    for i in range(22):
        draw_sequence(tmp_path / f"x{i}", lambda t, camera, i=i: box(0.3 + 0.018 * i * t, colour=(9 * i, 80, 40)))
    curate(tmp_path, report=print)
    rows = read_decisions(tmp_path / "curation.csv")
    told = advice(rows, Bounds())
    bound = float(re.search(r"--sufficient ([\d.]+)", told)[1])
    moving = [d for d in rows if d.final in ("hq4d", "4d")]
    assert "the paper's is 9.4%" in told and len(moving) > 10
    assert sum(bound <= d.motion < 0.45 for d in moving) == round(len(moving) * 3000 / 32000)
    assert advice([], Bounds()) == "Nothing that moves was kept."
