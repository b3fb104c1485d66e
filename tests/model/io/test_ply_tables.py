# SPDX-License-Identifier: GPL-3.0-or-later
"""Tables of .ply files of any kind, against files that are written here by plain loops."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from timesplat.datagen.sequence import InputError
from timesplat.model.io.ply_tables import PlyTables

KINDS = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def numbers(kind: str):
    """Of the property's type, as the file holds them."""
    if kind in ("float", "double"):
        return st.floats(width=32 if kind == "float" else 64)
    size = 8 * struct.calcsize(KINDS[kind])
    return st.integers(0, 2**size - 1) if kind[0] == "u" else st.integers(-(2 ** (size - 1)), 2 ** (size - 1) - 1)


@st.composite
def elements(draw):
    """{name: ({property: type}, rows)}, in any order."""
    found = {}
    for name in draw(st.permutations(["camera", "vertex", "chunk"])):
        kinds = draw(st.lists(st.sampled_from(sorted(KINDS)), min_size=1, max_size=4))
        rows = draw(st.lists(st.tuples(*map(numbers, kinds)), max_size=4))
        found[name] = {f"p{i}": kind for i, kind in enumerate(kinds)}, rows
    return found


def ply(form: str, elements, newline="\n") -> bytes:
    lines, body = ["ply", f"format {form} 1.0", "comment by no one", "comment timesplat fps 12.5"], b""
    for name, (kinds, rows) in elements.items():
        lines += [f"element {name} {len(rows)}", *(f"property {kind} {p}" for p, kind in kinds.items())]
        for row in rows:
            if form == "ascii":
                body += " ".join(map(repr, row)).encode() + newline.encode()
            else:
                body += struct.pack(FORMATS[form] + "".join(KINDS[k] for k in kinds.values()), *row)
    return newline.join([*lines, "end_header", ""]).encode() + body


@settings(max_examples=150, deadline=None)
@given(elements(), st.sampled_from(sorted(FORMATS)), st.sampled_from(["\n", "\r\n"]))
def test_every_kind_of_file_gives_its_numbers(elements, form, newline):
    tables = PlyTables(ply(form, elements, newline), "a.ply")
    assert tables.meta == {"fps": "12.5"} and list(tables.counts) == list(elements)
    for name, (kinds, rows) in elements.items():
        table = tables.table(name)
        assert tables.names(name) == list(table.dtype.names) == list(kinds) and len(table) == len(rows)
        for i, prop in enumerate(kinds):
            np.testing.assert_array_equal(table[prop], [row[i] for row in rows])


VERTEX = {"vertex": ({"x": "float", "y": "uchar"}, [(0.5, 1), (2, 3)])}


@pytest.mark.parametrize("form", FORMATS)
def test_what_follows_does_not_count(form):
    """Faces, with lists of any length, even where they are cut off."""
    data = ply(form, VERTEX).replace(b"end_header", b"element face 9\nproperty list uchar int v\nend_header") + b"3 0"
    table = PlyTables(data, "a.ply").table("vertex")
    assert table["x"].tolist() == [0.5, 2] and table["y"].tolist() == [1, 3]
    with pytest.raises(InputError, match=r"a\.ply: the header is damaged"):
        PlyTables(data, "a.ply").table("face")


@pytest.mark.parametrize(
    ("form", "old", "new", "says"),
    [
        ("ascii", b"2 3", b"2 ", "the file is truncated, 2 Gaussians were announced and there is data for 1;"),
        ("ascii", b"2 3", b"", "the file is truncated, 2 Gaussians were announced and there is data for 1;"),
        ("ascii", b"2 3", b"2 three", "its element vertex holds what is no number"),
        ("binary_big_endian", b"vertex 2", b"vertex 3", "3 Gaussians were announced and there is data for 2;"),
        ("binary_big_endian", b"vertex 2", b"vertex -2", "the header is damaged"),
        ("binary_big_endian", b"float x", b"list uchar float x", "the header is damaged"),
        ("binary_big_endian", b"float x", b"float y", "the header is damaged"),
        ("binary_big_endian", b"element vertex 2\n", b"", "the header is damaged"),
        ("binary_big_endian", b"element vertex", b"element point", "it has no vertex, but point;"),
        ("binary_big_endian", b"format", b"farmat", "the header is damaged"),
        ("binary_big_endian", b"end_header", b"end", "the header has no end"),
        ("binary_big_endian", b"ply\n", b"glTF", "it is not a .ply file"),
    ],
)
def test_damage_is_told_in_a_sentence(form, old, new, says):
    data = ply(form, VERTEX)
    assert old in data
    with pytest.raises(InputError) as e:
        PlyTables(data.replace(old, new, 1), "a.ply").table("vertex")
    assert str(e.value).startswith("a.ply: ") and says in str(e.value) and str(e.value).endswith(".")
