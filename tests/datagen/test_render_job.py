# SPDX-License-Identifier: GPL-3.0-or-later
import os

import pytest

from timesplat.datagen.render_job import RenderSettings, asset_name, expand_folders, finished_sequences, zoo_seed
from timesplat.datagen.sequence import InputError


@pytest.mark.parametrize(
    "wrong",
    [
        *({"rig": "x"}, {"size": 7}, {"samples": 0}, {"frames": 0}, {"targets": -1}, {"seed": -1}),
        *({"tracks": text} for text in ("many", "0", "-5", "1.5", "", "12345678")),
    ],
)
def test_settings_that_cannot_be(wrong):
    with pytest.raises(InputError, match=rf"^--{next(iter(wrong))} [^\n]*;[^\n]*\.$"):
        RenderSettings(**wrong)


@pytest.mark.parametrize(("text", "count"), [("auto", 0), ("none", None), ("500", 500)])
def test_how_many_tracks(text, count):
    assert RenderSettings(tracks=text).track_count == count


def test_names_of_assets():
    assert asset_name("zoo:7") == "zoo-000007" and asset_name("x/a.b.glb") == "a.b"
    assert zoo_seed("zoo:12") == "12" and zoo_seed("zoo:x") is None and zoo_seed("x/zoo:1") is None


def test_folders_may_go_while_assets_are_looked_for(tmp_path, monkeypatch):
    """Such as the hidden one in which another process renders."""
    for name in ("a.glb", "b/c.FBX", ".half/d.blend", "b/notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    look = os.scandir

    def scandir(path):
        if os.path.basename(path) == ".half":
            raise FileNotFoundError(path)
        return look(path)

    monkeypatch.setattr(os, "scandir", scandir)
    assert expand_folders([str(tmp_path)]) == [str(tmp_path / "a.glb"), str(tmp_path / "b" / "c.FBX")]


def test_nothing_is_finished_where_nothing_is(tmp_path):
    assert finished_sequences(tmp_path / "no", "a.glb", RenderSettings()) == []
    (tmp_path / "clip").mkdir()
    (tmp_path / "clip" / "transforms.json").write_text("{")
    assert finished_sequences(tmp_path, "a.glb", RenderSettings()) == []
