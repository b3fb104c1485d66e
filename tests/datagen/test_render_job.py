# SPDX-License-Identifier: GPL-3.0-or-later
import os

import pytest

from timesplat.datagen.render_job import (
    Asset,
    Part,
    RenderSettings,
    asset_name,
    list_assets,
    rendered_sequences,
    zoo_seed,
)
from timesplat.datagen.sequence import InputError


@pytest.mark.parametrize(
    "wrong",
    [
        *({"rig": "x"}, {"size": 7}, {"samples": 0}, {"frames": 0}, {"targets": -1}, {"seed": -1}),
        *({"start": -1}, {"every": 0}, {"clips": "some"}),
        *({"spread": True, "every": 2}, {"spread": True, "clips": "consecutive"}),
        *({"tracks": text} for text in ("many", "0", "-5", "1.5", "", "12345678")),
    ],
)
def test_settings_that_cannot_be(wrong):
    with pytest.raises(InputError, match=rf"^--{next(iter(wrong))}[ :][^\n]*;[^\n]*\.$"):
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
    root = str(tmp_path)
    assert list_assets([root]) == [
        Asset(str(tmp_path / "a.glb"), "a", root),
        Asset(str(tmp_path / "b" / "c.FBX"), "b/c", root),
    ]


def named(tmp_path, *files, given=None, root=None):
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    listed = list_assets([str(tmp_path / name) for name in given or [""]], root)
    return {asset.below_root: asset.name for asset in listed}


def test_names_are_paths_below_the_folder_given(tmp_path):
    files = ("chair/scene.gltf", "lamp/scene.gltf", "x.y.glb", "Fox.fbx", "fox.glb", "chair.obj")
    assert named(tmp_path, *files) == {
        "chair/scene.gltf": "chair/scene",
        "lamp/scene.gltf": "lamp/scene",
        "x.y.glb": "x.y",
        "Fox.fbx": "Fox-fbx",  # one folder for both where capitals count for nothing
        "fox.glb": "fox-glb",
        "chair.obj": "chair-obj",  # its clips would lie beside those of chair/scene
    }


def test_files_given_alone(tmp_path):
    files = ("a/scene.gltf", "b/scene.gltf")
    assert named(tmp_path, *files, given=files[:1]) == {"scene.gltf": "scene"}
    assert named(tmp_path, *files, given=files, root=tmp_path) == {"a/scene.gltf": "a/scene", "b/scene.gltf": "b/scene"}
    with pytest.raises(InputError, match=r"outside of --root [^\n]*;[^\n]*\.$"):
        named(tmp_path, *files, given=files, root=tmp_path / "a")


def test_every_asset_is_in_just_one_part():
    names = [f"zoo-{i:06d}" for i in range(3000)]
    parts = [[n for n in names if Part(i, 7).holds(n)] for i in range(1, 8)]
    assert sorted(name for part in parts for name in part) == names and all(360 < len(part) < 500 for part in parts)
    assert Part.parse("2/7") == Part(2, 7) and Part(1, 1).holds("anything")
    assert [Part(i, 3).holds("Chair/Scene") for i in (1, 2, 3)] == [Part(i, 3).holds("chair/scene") for i in (1, 2, 3)]
    # as everywhere and for ever: int(sha256("zoo-000007").hexdigest(), 16) % 8 == 5
    assert [i for i in range(1, 9) if Part(i, 8).holds("zoo-000007")] == [6]


@pytest.mark.parametrize("wrong", ["0/4", "5/4", "1/0", "2", "a/b", "-1/3", "1/2/3", "²/3"])
def test_parts_that_there_are_not(wrong):
    with pytest.raises(InputError, match=r"^--shard [^\n]*;[^\n]*\.$"):
        Part.parse(wrong)


def test_nothing_is_finished_where_nothing_is(tmp_path):
    asset = Asset("a.glb", "a")
    assert rendered_sequences(tmp_path / "no", asset, RenderSettings()) == ([], False)
    (tmp_path / "clip").mkdir()
    (tmp_path / "clip" / "transforms.json").write_text("{")
    assert rendered_sequences(tmp_path, asset, RenderSettings()) == ([], False)
