"""Figures and tables: what is written, whole, with the command that made it."""

import csv

import numpy as np
import pytest
from PIL import Image

from timesplat.evaluation import figures
from timesplat.evaluation.provenance import Provenance


def test_a_table_is_markdown_and_csv_with_its_command(tmp_path):
    rows = [["lift", "25.10 ± 0.20"], ["a, b", ""]]
    made_by = Provenance("python -m x", "1.0")
    text = figures.write_table(tmp_path / "new" / "t", "Title", ["method", "PSNR (dB)"], rows, made_by, ["Note."])
    assert (tmp_path / "new" / "t.md").read_text() == text
    assert "`python -m x`" in text and "timesplat 1.0" in text
    assert "| lift | 25.10 ± 0.20 |" in text and text.endswith("Note.\n")
    first, second, *sheet = (tmp_path / "new" / "t.csv").read_text().splitlines()
    assert (first, second) == ("# python -m x", "# timesplat 1.0")
    assert list(csv.reader(sheet)) == [
        ["method", "PSNR (dB)"],
        *rows,
    ]
    assert {p.name for p in (tmp_path / "new").iterdir()} == {"t.md", "t.csv"}


def test_a_figure_is_svg_and_png_with_its_command(tmp_path):
    pytest.importorskip("matplotlib")
    command = "python -m timesplat.evaluation.studies views " + "a/long/folder " * 20

    def draw(stem):
        fig, axes = figures.panels(2)
        figures.band(axes[0], [1, 2, 4], np.array([[1.0, 2, 3], [2, 3, 4]]), "lift", 0)
        figures.save(fig, stem, command)

    draw(tmp_path / "a")
    draw(tmp_path / "b")
    svg = (tmp_path / "a.svg").read_text()
    assert "a/long/folder" in svg and svg == (tmp_path / "b.svg").read_text()
    with Image.open(tmp_path / "a.png") as im:
        assert im.info["Description"] == command and im.width > 1000


def test_a_band_is_mean_and_standard_error():
    pytest.importorskip("matplotlib")
    _, (ax,) = figures.panels(1)
    figures.band(ax, [0, 1], np.array([[1.0, 5], [3.0, 5]]), "x", 0)
    assert ax.lines[0].get_ydata().tolist() == [2, 5]
    edge = ax.collections[0].get_paths()[0].vertices
    assert edge[:, 1].min() == pytest.approx(1) and edge[:, 1].max() == pytest.approx(5)


def test_pictures_carry_the_command_below(tmp_path):
    pytest.importorskip("matplotlib")
    figures.save_picture(Image.new("RGB", (300, 50), "red"), tmp_path / "p", "python -m a <b>")
    with Image.open(tmp_path / "p.png") as im:
        assert im.size[0] == 300 and im.size[1] > 60
        assert im.getpixel((0, 0)) == (255, 0, 0) and np.asarray(im)[50:].min() < 200
    assert "&lt;b&gt;" in (tmp_path / "p.svg").read_text()


@pytest.mark.parametrize("window", [1, 3, 50])
def test_smoothing_keeps_what_is_constant_and_averages_the_rest(window):
    assert figures.smooth([2.0] * 7, window) == pytest.approx([2.0] * 7)
    assert figures.smooth([0.0, 3, 0], 3) == pytest.approx([1.5, 1, 1.5])
    assert len(figures.smooth([1.0], window)) == 1


def test_commands_can_be_typed_again():
    assert figures.command_line("m", ["--out", "a b"]) == "python -m m --out 'a b'"
