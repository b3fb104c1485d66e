# SPDX-License-Identifier: GPL-3.0-or-later
"""The page that plays an asset: what it holds, and in a browser the pictures of our rasteriser."""

import base64
import gzip
import json
import math
import os
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from timesplat.datagen.rigs import spherical
from timesplat.datagen.sequence import InputError
from timesplat.model.io.asset import Clip
from timesplat.model.io.page import FOV, read_page, write_page
from timesplat.model.io.ply import asset_bytes, read_ply, write_ply

from ...assets import CLIP, assert_same, make_asset, tracked_asset

BROWSER = os.environ.get("TIMESPLAT_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
in_browser = pytest.mark.skipif(not BROWSER, reason="no Chromium; put it on PATH or name it by TIMESPLAT_CHROMIUM")
SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SIZE = 200, 160  # of pictures
DISTANCE, TARGET = 2.4, (0.1, -0.05, 0.02)


def large(asset):
    """With Gaussians that one sees, of a clip that knows no pixel."""
    return replace(asset, scale=asset.scale * 3, clip=replace(asset.clip, pixel=0.0))


# ---------------------------------------------------------------- what is in it


@pytest.mark.parametrize("asset", [make_asset(40), tracked_asset(40)], ids=["lines", "paths"])
def test_the_asset_is_in_it_whole(tmp_path, asset):
    write_page(tmp_path / "a.html", asset)
    text = (tmp_path / "a.html").read_text("utf-8")
    (packed,) = re.findall(r'<script id="asset" type="text/plain">([\w+/=]+)</script>', text)
    data = gzip.decompress(base64.b64decode(packed))
    write_ply(tmp_path / "own.ply", asset)
    assert data == (tmp_path / "own.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data)
    assert_same(asset, read_ply(tmp_path / "a.ply"), 1e-4, 4e-5)  # paths are rounded to 16 bits
    assert len(text) - len(packed) < 50_000


def test_it_asks_for_nothing_from_elsewhere(tmp_path):
    write_page(tmp_path / "a.html", make_asset(3))
    text = (tmp_path / "a.html").read_text("utf-8")
    assert "default-src 'none'" in text and "{{" not in text
    assert not re.search(r"https?:|@import|(src|href)\s*=\s*[\"'](?!data:)|url\(", text)


def test_names_are_text(tmp_path):
    """Of files, which may hold what a browser would take for markup, or what stands in the template."""
    write_page(tmp_path / "<b>&{{ASSET}}.html", make_asset(3))
    text = (tmp_path / "<b>&{{ASSET}}.html").read_text("utf-8")
    assert "<title>&lt;b&gt;&amp;{{ASSET}}</title>" in text and text.count("<b>&lt;b&gt;&amp;{{ASSET}}</b>") == 1


def test_the_same_asset_gives_the_same_file(tmp_path):
    for folder in ("one", "two"):
        write_page(tmp_path / folder / "a.html", tracked_asset(9))
    assert (tmp_path / "one" / "a.html").read_bytes() == (tmp_path / "two" / "a.html").read_bytes()


def test_a_bad_asset_leaves_nothing(tmp_path):
    asset = make_asset(3)
    asset.opacity[1] = np.nan
    with pytest.raises(InputError, match=r"a\.html: opacity holds NaN"):
        write_page(tmp_path / "a.html", asset)
    assert not list(tmp_path.iterdir())


def test_pages_that_hold_no_asset_are_refused(tmp_path):
    page = tmp_path / "a.html"
    write_page(page, make_asset(3))
    text = page.read_text("utf-8")
    assert_same(make_asset(3), read_page(page).asset)
    bomb = base64.b64encode(gzip.compress(asset_bytes(make_asset(3)) + bytes(10_000_000))).decode()
    for packed, says in (
        ("", "it is no page that Timesplat wrote"),
        ("AAAA", "the asset in it is damaged"),
        (re.findall(r"plain\">(\S+)</", text)[0][:400], "the asset in it is damaged"),
        (base64.b64encode(gzip.compress(b"ply\n")).decode(), "the header has no end"),
    ):
        page.write_text(f'<script id="asset" type="text/plain">{packed}</script>')
        with pytest.raises(InputError, match=f"a.html: {says}"):
            read_page(page)
    page.write_text(f'<script id="asset" type="text/plain">{bomb}</script>')
    assert len(read_page(page).asset) == 3  # what follows is not unpacked


# ---------------------------------------------------------------- in a browser


def browse(page: Path, words: str, *options: str) -> str:
    """What Chromium prints; `words` are those after the #."""
    width, height = SIZE
    command = [BROWSER, "--headless", "--no-sandbox", "--hide-scrollbars", *options, "--virtual-time-budget=2000"]
    command += [f"--window-size={width},{height + 150}", f"{page.as_uri()}#{words}"]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True, cwd=page.parent).stdout


def picture(page: Path, frame: float, azimuth: float, elevation: float) -> np.ndarray:
    """(H,W,3) 0..1 of the page."""
    camera = ",".join(map(str, (azimuth, elevation, DISTANCE, *TARGET)))
    shot = page.with_suffix(".png")
    words = f"t={frame}&camera={camera}&size={SIZE[0]}x{SIZE[1]}&background=ffe0c0&ui=0"
    browse(page, words, *SOFTWARE, f"--screenshot={shot}")
    return np.asarray(Image.open(shot).convert("RGB"))[: SIZE[1], : SIZE[0]] / 255


def rasterised(asset, frame: float, azimuth: float, elevation: float) -> np.ndarray:
    """(H,W,3) 0..1 of our rasteriser."""
    torch = pytest.importorskip("torch")
    from timesplat.model.gaussians import Gaussians4D
    from timesplat.model.rasterize import render
    from timesplat.model.tracks import Tracks4D

    c2w = spherical(azimuth, elevation, DISTANCE) @ np.diag([1.0, -1, -1, 1])
    c2w[:3, 3] += TARGET
    focal = min(SIZE) / 2 / math.tan(math.radians(FOV / 2))
    scene = (Gaussians4D if asset.paths is None else Tracks4D).from_asset(asset)
    camera = [c2w, [focal, focal, SIZE[0] / 2, SIZE[1] / 2], asset.frame_to_time(frame)]
    camera = [torch.tensor(np.array(x), dtype=torch.float32)[None] for x in camera]
    background = torch.tensor([255, 224, 192]) / 255
    rgb, _ = render(scene, *camera, *SIZE, background=background, inference=True)
    return rgb[0].clamp(0, 1).numpy()


def decibels(a: np.ndarray, b: np.ndarray) -> float:
    assert a.std() > 0.02 and b.std() > 0.02  # something is seen
    return -10 * math.log10(((a - b) ** 2).mean())


@in_browser
@pytest.mark.parametrize("asset", [make_asset(300), tracked_asset(300, turn=0.5)], ids=["lines", "paths"])
def test_its_pictures_are_those_of_our_rasteriser(tmp_path, asset):
    asset = large(asset)
    write_page(tmp_path / "a.html", asset)
    seen = []
    for frame in (CLIP.frame_start, 20.3, CLIP.frame_end):
        for azimuth, elevation in ((0, 0), (130, 25)):
            view = frame, azimuth, elevation
            seen.append(picture(tmp_path / "a.html", *view))
            assert decibels(seen[-1], rasterised(asset, *view)) > 50
    assert all(decibels(a, b) < 35 for i, a in enumerate(seen) for b in seen[:i])  # time and camera count


@in_browser
def test_it_is_as_soft_as_the_pictures_that_it_was_made_from(tmp_path):
    """Where their pixels were wider than those of the screen; else holes would be seen."""
    asset = make_asset(300)
    asset = replace(asset, clip=replace(asset.clip, pixel=0.08))
    write_page(tmp_path / "a.html", asset)
    shown = picture(tmp_path / "a.html", 20, 30, 10)
    soft, plain = decibels(shown, rasterised(asset.softened(), 20, 30, 10)), rasterised(asset, 20, 30, 10)
    assert soft > 40 and soft > decibels(shown, plain) + 6


@in_browser
def test_it_plays(tmp_path):
    """Where it has frames and was told to; else it rests where it was told to."""
    write_page(tmp_path / "a.html", make_asset(30))
    write_page(tmp_path / "still.html", replace(make_asset(30), clip=Clip(24, 3, 3)))

    def dom(name: str, words: str) -> str:
        return browse(tmp_path / name, words, *SOFTWARE, "--dump-dom")

    rests = dom("a.html", "t=12.5")
    assert re.search(r'id="frame"[^>]*>12\.5 <i>/ 33</i>', rests) and 'aria-label="Play"' in rests
    assert "30 Gaussians · 0.8 s" in rests and "<title>a</title>" in rests
    plays = dom("a.html", "play")
    assert 'aria-label="Pause"' in plays and not re.search(r'id="frame"[^>]*>10\.0', plays)
    still = dom("still.html", "play")
    assert 'class="panel still"' in still and 'aria-label="Play"' in still


HANDS = """<script>
const send = (kind, event) => document.getElementById("view").dispatchEvent(new (kind)(...event));
const finger = (type, pointerId, clientX, clientY) =>
  send(PointerEvent, ["pointer" + type, {pointerId, clientX, clientY, buttons: 1, bubbles: true}]);
const key = key => window.dispatchEvent(new KeyboardEvent("keydown", {key}));
const slide = (id, value) => {
  document.getElementById(id).value = value;
  document.getElementById(id).dispatchEvent(new Event("input"));
};
setTimeout(() => {
  const told = [], note = () => told.push({...view, frame: state.frame, playing: state.playing, cut: state.cut});
  note();
  finger("down", 1, 50, 50), finger("move", 1, 60, 70), note();
  finger("down", 2, 60, 90), finger("move", 2, 60, 110), finger("up", 1), finger("up", 2), note();
  send(WheelEvent, ["wheel", {deltaY: -100}]), note();
  key("ArrowRight"), key("."), note();
  slide("time", 20.5), slide("cut", 0.5), note();
  key(" "), key("Home"), note();
  document.title = JSON.stringify(told);
}, 500);
</script>"""


@in_browser
def test_mouse_touch_wheel_and_keys(tmp_path):
    write_page(tmp_path / "a.html", make_asset(30))
    with open(tmp_path / "a.html", "a") as f:
        f.write(HANDS)
    told = re.search(r"<title>(\[.*\])</title>", browse(tmp_path / "a.html", "", *SOFTWARE, "--dump-dom"))
    start, turned, pinched, wheeled, stepped, slid, home = json.loads(told[1])
    assert turned["azimuth"] > start["azimuth"] and turned["elevation"] > start["elevation"]
    assert turned["distance"] == start["distance"] and turned["target"] == start["target"]
    assert pinched["distance"] == pytest.approx(turned["distance"] * math.hypot(0, 20) / math.hypot(0, 40))
    assert pinched["target"] != turned["target"] and pinched["azimuth"] == turned["azimuth"]
    assert 0.8 < wheeled["distance"] / pinched["distance"] < 0.95
    assert stepped["frame"] == pytest.approx(11.1) and (slid["frame"], slid["cut"]) == (20.5, 0.5)
    assert (
        not slid["playing"]
        and home["playing"]
        and (home["distance"], home["target"])
        == (
            start["distance"],
            start["target"],
        )
    )


@in_browser
def test_without_webgl_it_says_so(tmp_path):
    write_page(tmp_path / "a.html", make_asset(3))
    assert "has no WebGL 2, which the page draws with" in browse(
        tmp_path / "a.html", "", "--disable-3d-apis", "--dump-dom"
    )
