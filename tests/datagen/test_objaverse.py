# SPDX-License-Identifier: GPL-3.0-or-later
"""Against a package in place of the real one, whose three functions answer from an index that the test makes."""

import sys
import types
import urllib.error

import pytest

from timesplat.cli import main
from timesplat.datagen.licences import Terms, read_licences
from timesplat.datagen.objaverse import fetch, read_uids
from timesplat.datagen.render_job import Asset
from timesplat.datagen.sequence import InputError

UIDS = [f"{i:032x}" for i in range(1, 6)]
NOTES = {
    uid: {
        "uid": uid,
        "name": f"thing {i}",
        "animationCount": i % 2,
        "license": ["by", "cc0", "by-nc", "custom", "by-sa"][i],
        "user": {"username": f"u{i}", "displayName": "Ünal, B." if i == 0 else ""},
        "viewerUrl": f"https://example.org/{i}",
    }
    for i, uid in enumerate(UIDS)
}


@pytest.fixture
def package(monkeypatch, tmp_path):
    """`fetched`: the UIDs that went over the network; offline True: none would."""
    fake = types.ModuleType("objaverse")
    fake.fetched, fake.offline = [], False

    def online():
        if fake.offline:
            raise urllib.error.URLError("Name or service not known")

    def load_uids():
        online()
        return list(UIDS)

    def load_annotations(uids=None):
        online()
        return {uid: NOTES[uid] for uid in (uids or UIDS)}

    def load_objects(uids, download_processes=1):
        online()
        cache = tmp_path / "cache"
        cache.mkdir(exist_ok=True)
        for uid in uids:
            if not (cache / f"{uid}.glb").exists():
                fake.fetched.append(uid)
                (cache / f"{uid}.glb").write_bytes(b"glTF" + uid.encode())
        return {uid: str(cache / f"{uid}.glb") for uid in uids if uid != UIDS[4]}

    fake.load_uids, fake.load_annotations, fake.load_objects = load_uids, load_annotations, load_objects
    monkeypatch.setitem(sys.modules, "objaverse", fake)
    return fake


def test_files_and_licences_come_and_nothing_twice(package, tmp_path):
    out = tmp_path / "out"
    first = fetch(out, UIDS[1:3])
    assert [f.name for f in first] == [f"{uid}.glb" for uid in UIDS[1:3]] and first[0].read_bytes().startswith(b"glTF")
    both = fetch(out, UIDS[:2])
    assert package.fetched == [UIDS[1], UIDS[2], UIDS[0]] and both[1] == first[0]
    table = read_licences(out / "licences.csv")
    assert table.of(Asset(str(out / f"{UIDS[0]}.glb"), "x")) == Terms(UIDS[0], "CC-BY-4.0", "Ünal, B.")
    assert table.of(Asset(str(out / f"{UIDS[2]}.glb"), "x")) == Terms(UIDS[2], "CC-BY-NC-4.0", "u2")
    assert sorted(f.name for f in out.iterdir()) == sorted([*(f"{uid}.glb" for uid in UIDS[:3]), "licences.csv"])


def test_animated_ones_a_limit_and_a_list_that_leaks(package, tmp_path, capsys):
    leak = tmp_path / "leak.csv"
    leak.write_text(f"uid,set\n{UIDS[1].upper()},test\n")
    assert main(["fetch", "objaverse", "--out", str(tmp_path / "a"), "--animated", "--leave-out", str(leak)]) == 0
    assert package.fetched == [UIDS[3]] and "1 objects" in capsys.readouterr().out
    assert main(["fetch", "objaverse", "--out", str(tmp_path / "b"), "--limit", "2"]) == 0
    assert sorted(f.stem for f in (tmp_path / "b").glob("*.glb")) == UIDS[:2]
    listed = tmp_path / "uids.txt"
    listed.write_text(f"{UIDS[0]}\n{'f' * 32}\n{UIDS[4]}\n")
    assert main(["fetch", "objaverse", "--out", str(tmp_path / "c"), "--uids", str(listed)]) == 2
    told = capsys.readouterr().out
    assert f"{'f' * 32}: Objaverse has no such object" in told and f"{UIDS[4]}: it could not be fetched" in told


def test_offline_and_without_the_package_it_is_one_sentence(package, tmp_path, monkeypatch, capsys):
    package.offline = True
    assert main(["fetch", "objaverse", "--out", str(tmp_path / "a"), "--limit", "1"]) == 2
    told = capsys.readouterr().err
    assert "it cannot be reached" in told and "Name or service not known" in told and told.count("\n") == 1
    assert not (tmp_path / "a").exists()
    monkeypatch.setitem(sys.modules, "objaverse", None)
    with pytest.raises(InputError, match=r"timesplat\[objaverse\]"):
        fetch(tmp_path / "a", UIDS)


def test_what_is_asked_wrongly(package, tmp_path):
    with pytest.raises(InputError, match="nothing is left"):
        fetch(tmp_path / "a", UIDS[:1], leave_out=UIDS[:1])
    with pytest.raises(InputError, match="cannot be read"):
        read_uids(tmp_path / "no.txt")
    (tmp_path / "none.txt").write_text("fox\n")
    with pytest.raises(InputError, match="no UID in it"):
        read_uids(tmp_path / "none.txt")
    for words in ([], ["--limit", "0"]):
        assert main(["fetch", "objaverse", "--out", str(tmp_path / "a"), *words]) == 2
