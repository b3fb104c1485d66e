# SPDX-License-Identifier: GPL-3.0-or-later
import pytest

from timesplat.datagen.licences import Licences, Terms, read_licences
from timesplat.datagen.render_job import Asset
from timesplat.datagen.sequence import InputError


def asset(path, root=None):
    return Asset(path, "n", root)


def test_who_is_found_by_hash_path_uid_and_name(tmp_path):
    table = tmp_path / "l.csv"
    table.write_text(
        "Name,uid,sha256,path,license,Author,notes\n"
        'fox,,,,CC0-1.0,"Ann, Bob",x\n'
        ",77aa,,,CC-BY-4.0,Cleo,\n"
        ",,beef,,MIT,Dan,\n"
        ",,,a/cat.glb,Apache-2.0,,\n",
        encoding="utf-8-sig",
    )
    found = read_licences(table)
    assert found.of(asset("/x/fox.glb")) == Terms("fox", "CC0-1.0", "Ann, Bob")
    assert found.of(asset("/x/77aa.glb")) == Terms("77aa", "CC-BY-4.0", "Cleo")
    assert found.of(asset("/x/fox.glb"), "beef") == Terms(
        "fox", "MIT", "Dan"
    )  # what a file holds is surer than its name
    assert found.of(asset("/x/a/cat.glb", "/x")) == Terms("cat", "Apache-2.0", "")
    assert found.of(asset("/x/cat.glb")) == Terms("cat") and found.of(asset("zoo:7")) == Terms("zoo:7")
    assert Licences().of(asset("fox.glb"), "beef") == Terms("fox")


@pytest.mark.parametrize("text", ["name,author\nfox,A\n", "licence,author\nCC0,A\n", "", b"\xff\xfe\x00licence"])
def test_what_is_no_table_of_licences_is_one_sentence(tmp_path, text):
    table = tmp_path / "l.csv"
    table.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=r"^[^\n]*l\.csv[^\n]*;[^\n]*\.$"):
        read_licences(table)
    with pytest.raises(InputError, match="no such file"):
        read_licences(tmp_path / "no.csv")
