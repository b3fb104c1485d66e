# SPDX-License-Identifier: GPL-3.0-or-later
"""Other programs' splats: read against bytes of another program and a reference of plain loops; and files that are
anything else."""

import base64
import contextlib
import gzip
import math
import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from timesplat.datagen.sequence import InputError
from timesplat.model.io.asset import SH_C0, STATIC_SIGMA_T, Asset, check
from timesplat.model.io.files import read_asset
from timesplat.model.io.ply import PROPERTIES_3DGS, PROPERTIES_4D, write_ply

from ...assets import make_asset

# Three Gaussians, written by gsply 0.4.6, a reader and writer of others, and what it reads from them.
XYZ = [[0.5, -1.25, 2], [0, 3, -0.125], [-2, 1, 1]]
LOG_SCALE = [[-3, -4, -5], [-2, -2.5, -6], [-1, -3, -3]]
ROTATION = [
    [0.923689, 0.102399, -0.307197, 0.204798],
    [-0.102399, 0.203414, 0.968324, 0.102399],
    [-0.226938, 0.339024, -0.113469, 0.905918],
]
LOGIT = [-0.99164, 0.504556, 3.008156]
SH = [[0.509804, -0.509804, 0.013072], [1.503268, -1.503268, 0.196079], [-0.091503, 0.300654, 0.901961]]
SPZ_3 = (  # with spherical harmonics of degree 1
    "ABzY8W9$NJ0RQuI4-Q~vU|;}YMjjx+!NBn5KZ61T2pBLh{QJ-F;6H-^0}#2+|2#RTVW(SrP4}XLgn)($hY1A*Qz}*;@zOH%T;dhkzW_G?0N~_!<!1l@00"
)
SPZ_4 = (
    "PDfKv1ONa40{{R301N;HAOHXW000000000000000Bme*a000008vp<R000003;+NC000000{{R3000005&!@I000002><{9000005&!@I000002><{9"
    "000006#xJL000003;+NC00000D77#BARE~L000O80POz&AOHXW001xm0RH~~;Qs&+000mGD77#BAOjfy07akkD77#BAPGqT0F!KhxkiV4i=rsCFa011"
    "NdN$FU{HW~K#*{7D77#BAPivu0F-#E#7ZhLNu)|yj{"
)
BOUNDS = ("x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b")
COMPRESSED = (
    b"\x00\x00\x00\xc0\x00\x00\xa0\xbf\x00\x00\x00\xbe\x00\x00\x00?\x00\x00@@\x00\x00\x00@\x00\x00@\xc0\x00\x00\x80\xc0"
    b"\x00\x00\xc0\xc0\x00\x00\x80\xbf\x00\x00 \xc0\x00\x00@\xc0\x87\x8e\xf1>\xa0g\x9d=\x00\x00\x00?\x0cSl?6\xaa\x15?"
    b"\xa1\xfe@?\xff\x07\xe0\xff\x94\x86\xa4$\xaa\x02\x00\x00E\x00\x8e`\x00\xf8\xdf\xccINj\x9b\x00\xf8\x1f\x80\x9f9"
    b"\x00\xff<\xf4\x10\x00\xae\xd5\xcb\xd5\xffW\xf5\xff\xf3\xff\xff\x00"
)


def compressed(data=COMPRESSED, chunks=1, count=3) -> bytes:
    names = [f"{m}_{b}" for k in range(0, 9, 3) for m in ("min", "max") for b in BOUNDS[k : k + 3]]
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}"]
    lines += [f"property float {n}" for n in names] + [f"element vertex {count}"]
    lines += [f"property uint packed_{n}" for n in ("position", "rotation", "scale", "color")]
    return "\n".join([*lines, "end_header", ""]).encode() + data


def expect(asset: Asset, xyz, log_scale, rotation, logit, sh, atol=2e-6):
    np.testing.assert_allclose(asset.xyz, xyz, atol=atol)
    np.testing.assert_allclose(np.log(asset.scale), log_scale, atol=atol)
    np.testing.assert_allclose(asset.rotation, rotation, atol=atol)
    np.testing.assert_allclose(asset.opacity, 1 / (1 + np.exp(-np.array(logit))), atol=atol)
    np.testing.assert_allclose(asset.rgb, 0.5 + SH_C0 * np.array(sh), atol=atol)
    assert not asset.velocity.any() and not asset.t.any() and (asset.sigma_t == STATIC_SIGMA_T).all()


def test_what_another_program_wrote_is_read_as_it_reads_it(tmp_path):
    (tmp_path / "3.spz").write_bytes(base64.b85decode(SPZ_3))
    (tmp_path / "4.spz").write_bytes(base64.b85decode(SPZ_4))
    (tmp_path / "c.ply").write_bytes(compressed())
    pytest.importorskip("zstandard")
    for version, note in ((3, True), (4, False)):
        loaded = read_asset(tmp_path / f"{version}.spz")
        assert loaded.up == "Y" and bool(loaded.note) == note
        expect(loaded.asset, XYZ, LOG_SCALE, ROTATION, LOGIT, SH)
    loaded = read_asset(tmp_path / "c.ply")
    assert loaded.up == "-Y" and not loaded.note
    expect(
        loaded.asset,
        [[0.5, -1.25, 2], [4.89e-04, 3, -0.125], [-2, 1.001711, 1.000305]],
        [[-3, -4, -5.000489], [-1.999511, -2.5, -6], [-1, -3, -3]],
        [
            [0.923385, 0.10299, -0.307588, 0.205289],
            [-0.101608, 0.203907, 0.968387, 0.101608],
            [-0.226025, 0.339384, -0.112667, 0.906111],
        ],
        LOGIT,
        [[0.502353, -0.497647, 0], [1.5, -1.5, 0.201176], [-0.1, 0.3, 0.9]],
    )


def spz(version: int, n=40, seed=1, fraction=11) -> tuple[bytes, list[tuple]]:
    """A file of random bytes, and its Gaussians from it by plain loops: (xyz, log scale, q, opacity, rgb)."""
    r = np.random.default_rng(seed)
    three, four = version < 3, version >= 3
    sizes = {"xyz": 6 if version == 1 else 9, "alpha": 1, "colour": 3, "scale": 3, "turn": 3 if three else 4}
    part = {k: [bytes(r.integers(0, 256, s, dtype=np.uint8)) for _ in range(n)] for k, s in sizes.items()}
    half = [np.float16(r.normal(0, 9, 3)).tobytes() for _ in range(n)]
    part["xyz"] = half if version == 1 else part["xyz"]
    known = []
    for i in range(n):
        p, t = part["xyz"][i], part["turn"][i]
        if version == 1:
            xyz = struct.unpack("<3e", p)
        else:
            xyz = [int.from_bytes(p[3 * k : 3 * k + 3], "little", signed=True) / 2**fraction for k in range(3)]
        if four:
            word, q = int.from_bytes(t, "little"), [0.0] * 4
            for k in range(4):
                if k != word >> 30:
                    after = sum(1 for j in range(k + 1, 4) if j != word >> 30)
                    bits = (word >> (10 * after)) & 1023
                    q[k] = (-1 if bits & 512 else 1) * (bits & 511) / 511 * math.sqrt(0.5)
            q[word >> 30] = math.sqrt(max(0, 1 - sum(c * c for c in q)))
        else:
            q = [b / 127.5 - 1 for b in t]
            q.append(math.sqrt(max(0, 1 - sum(c * c for c in q))))
        length = math.sqrt(sum(c * c for c in q))
        x, y, z, w = (c / length for c in q)
        rgb = [0.5 + SH_C0 * (c / 255 - 0.5) / 0.15 for c in part["colour"][i]]
        known.append((xyz, [s / 16 - 10 for s in part["scale"][i]], (w, x, y, z), part["alpha"][i][0] / 255, rgb))
    head = struct.pack("<4sIIBBBB", b"NGSP", version, n, 2, fraction, 0, 0)
    return head + b"".join(b"".join(part[k]) for k in sizes) + bytes(24 * n), known


@pytest.mark.parametrize("version", [1, 2, 3])
def test_spz_against_plain_loops(tmp_path, version):
    data, known = spz(version)
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(data))
    loaded = read_asset(path)
    for name, column in zip(("xyz", None, "rotation", "opacity", "rgb"), zip(*known, strict=True), strict=True):
        got = getattr(loaded.asset, name) if name else np.log(loaded.asset.scale)
        np.testing.assert_allclose(got, np.array(column), rtol=1e-6, atol=2e-6, err_msg=str(name))
    assert "spherical harmonics" in loaded.note


def splat(n=20, seed=2) -> tuple[bytes, Asset]:
    asset, rows = make_asset(n, seed), []
    for i in range(n):
        q = [round(c * 128 + 128) for c in asset.rotation[i]]
        rgba = [int(c * 255) for c in (*asset.rgb[i], asset.opacity[i])]
        values = (*asset.xyz[i], *asset.scale[i])
        rows.append(struct.pack("<6f8B", *values, *rgba, *(min(c, 255) for c in q)))
    return b"".join(rows), asset


def test_splat(tmp_path):
    data, asset = splat()
    (tmp_path / "a.SPLAT").write_bytes(data)
    got = read_asset(tmp_path / "a.SPLAT")
    np.testing.assert_array_equal(got.asset.xyz, asset.xyz)
    np.testing.assert_array_equal(got.asset.scale, asset.scale)
    np.testing.assert_allclose(got.asset.rotation, asset.rotation, atol=0.012)
    np.testing.assert_allclose(got.asset.rgb, asset.rgb, atol=1 / 255 + 1e-6)
    np.testing.assert_allclose(got.asset.opacity, asset.opacity, atol=1 / 255 + 1e-6)
    assert got.up == "-Y"


NAMES = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 f_rest_0 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
PLAIN = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
PLAIN += "".join(f"property float {p}\n" for p in NAMES.split()) + "end_header\n"
PLAIN = PLAIN.encode() + np.ones(18, "<f4").tobytes()


def test_ply_tells_whose_it_is_and_what_is_left_out(tmp_path):
    asset = make_asset(9)
    write_ply(tmp_path / "ours.ply", asset)
    assert (read_asset(tmp_path / "ours.ply").up, read_asset(tmp_path / "ours.ply").note) == ("Z", "")
    (tmp_path / "plain.ply").write_bytes(PLAIN)
    plain = read_asset(tmp_path / "plain.ply")
    assert plain.up == "-Y" and "spherical harmonics" in plain.note


@pytest.mark.parametrize(("says", "up"), [("z", "Z"), ("Y", "Y"), ("sideways", "-Y")])
def test_a_ply_may_say_what_is_up(tmp_path, says, up):
    (tmp_path / "a.ply").write_bytes(PLAIN.replace(b"element", f"comment Vertical Axis: {says}\nelement".encode(), 1))
    assert read_asset(tmp_path / "a.ply").up == up


def plain(rows: np.ndarray) -> bytes:
    return PLAIN.replace(b"vertex 1", f"vertex {len(rows)}".encode())[:-72] + rows.astype("<f4").tobytes()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    ("name", "word"),
    [("x", "position"), ("f_dc_1", "colour"), ("opacity", "opacity"), ("scale_0", "scale"), ("rot_2", "rotation")],
)
def test_gaussians_that_are_no_numbers_are_left_out_of_a_ply(tmp_path, name, word, value):
    rows = np.random.default_rng(0).normal(size=(9, 18))
    rows[4, NAMES.split().index(name)] = value
    (tmp_path / "a.ply").write_bytes(plain(rows))
    loaded = read_asset(tmp_path / "a.ply")
    if (name == "opacity" and np.isinf(value)) or (name == "scale_0" and value == -np.inf):  # a logit, a logarithm
        assert len(loaded.asset) == 9 and "left out:" not in loaded.note
        assert name != "opacity" or loaded.asset.opacity[4] == (value > 0)
        return
    np.testing.assert_array_equal(loaded.asset.xyz, np.delete(rows, 4, 0)[:, :3].astype(np.float32))
    assert loaded.note.startswith(f"1 of 9 Gaussians are left out: NaN, or beyond all bounds, in {word}.")
    assert "spherical harmonics" in loaded.note


def test_gaussians_that_are_no_numbers_are_left_out_of_a_splat(tmp_path):
    data, asset = splat(20)
    data = bytearray(data)
    data[32 * 7 : 32 * 7 + 4] = struct.pack("<f", math.nan)
    (tmp_path / "a.splat").write_bytes(data)
    loaded = read_asset(tmp_path / "a.splat")
    np.testing.assert_array_equal(loaded.asset.xyz, np.delete(asset.xyz, 7, 0))
    assert loaded.note == "1 of 20 Gaussians are left out: NaN, or beyond all bounds, in position."


def test_a_zero_quaternion_does_not_turn(tmp_path):
    rows = np.random.default_rng(0).normal(size=(9, 18))
    rows[4, -4:] = 0
    (tmp_path / "a.ply").write_bytes(plain(rows))
    loaded = read_asset(tmp_path / "a.ply")
    assert loaded.asset.rotation[4].tolist() == [1, 0, 0, 0] and "left out:" not in loaded.note


# ---------------------------------------------------------------- what is something else


JPEG, PNG = b"\xff\xd8\xff\xe0" + bytes(124), b"\x89PNG\r\n\x1a\n" + bytes(120)
MESH = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nelement face 1\nproperty list uchar int v\n"
MESH += b"end_header\n0\n"
CLOUD = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n\0\0\0\0"


def ours(**values) -> bytes:
    """One Gaussian in a .ply of ours whose comments say something else."""
    meta = {"version": 1, "fps": 24, "frame_start": 0, "frame_end": 9, "scale": 1, "translation": "0 0 0"} | values
    head = ["ply", "format binary_little_endian 1.0", *(f"comment timesplat {k} {v}" for k, v in meta.items())]
    head += ["element vertex 1", *(f"property float {p}" for p in PROPERTIES_3DGS + PROPERTIES_4D), "end_header", ""]
    return "\n".join(head).encode() + bytes(76)


@pytest.mark.parametrize(
    ("name", "data", "what"),
    [
        ("a.ply", ours(frame_end=60_000), "frames run from 0 to 60000, which is too many"),
        ("a.ply", ours(frame_start=-9_999_999_999, frame_end=-9_999_999_999), "too many or too far"),
        ("a.ply", ours(fps="1e300"), "fps and scale must be positive"),
        ("a.ply", ours(scale="1e-300"), "fps and scale must be positive"),
        ("a.ply", ours(translation="0 0 1e39"), "these and translation finite"),
        ("a.ply", ours(frame_end="9" * 5000), "the clip's comments are damaged"),
        ("a.ply", ours().replace(b"format", b"farmat"), "the header is damaged (it names no format)"),
        ("a.ply", PNG, "it is a PNG picture, not a Gaussian splat .ply"),
        ("a.ply", MESH, "it is a polygon mesh, not Gaussians"),
        ("a.ply", CLOUD, "it is a plain point cloud, not Gaussians"),
        ("a.ply", b"", "it is not a .ply file"),
        ("a.ply", compressed()[:-1], "truncated"),
        ("a.ply", compressed(count=300), "truncated, 300 Gaussians were announced"),
        ("a.ply", compressed(chunks=0, data=COMPRESSED[72:]), "0 chunks do not belong to 3"),
        ("a.ply", compressed(count=-1), "damaged"),
        ("a.ply", compressed(COMPRESSED[:24] + b"\0\0\xc0\x7f" + COMPRESSED[28:]), "holds NaN"),
        ("a.splat", b"", "it is empty"),
        ("a.splat", JPEG, "it is a JPEG picture, not a Gaussian splat .splat"),
        ("a.splat", splat()[0][:-7], "truncated or not a .splat"),
        ("a.splat", bytes(64), "make no sense"),
        ("a.splat", struct.pack("<6f8B", *[float("nan")] * 6, *range(8)), "make no sense"),
        ("a.spz", JPEG, "it is a JPEG picture, not a Gaussian splat .spz"),
        ("a.spz", b"hello", "it is not an .spz file"),
        ("a.spz", b"", "it is not an .spz file"),
        ("a.spz", gzip.compress(b"a letter to a friend, packed"), "what is packed is not .spz"),
        ("a.spz", base64.b85decode(SPZ_3)[:-20], "truncated or damaged"),
        ("a.spz", gzip.compress(spz(2)[0][:300]), "40 Gaussians were announced"),
        ("a.spz", gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 9, 1, 0, 12, 0, 0)), "version 9, known are 1 to 4"),
        ("a.spz", gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 1 << 31, 0, 12, 0, 0)), "it claims 2,147,483,648"),
        ("a.spz", base64.b85decode(SPZ_4)[:100], "truncated or damaged"),
        ("a.spz", b"NGSP", "truncated or damaged"),
        ("a.obj", b"", "its name must end in .ply, .splat, .spz"),
    ],
)
def test_a_wrong_file_gets_a_sentence(tmp_path, name, data, what):
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(InputError) as e:
        read_asset(path)
    said = str(e.value)
    assert said.startswith(f"{path}: ") and what in said and said.endswith(".") and "\n" not in said


def test_a_decompression_bomb_is_not_unpacked(tmp_path):
    """200 MB of zeros behind a header that announces ten Gaussians, or as many as that; or more than there are."""
    path = tmp_path / "a.spz"
    for count, size in ((10, 1 << 20), (9_999_999, 1 << 20), (9_999_999, 1 << 12), (90_000, 1 << 12)):
        with gzip.open(path, "wb", 1) as f:
            f.write(struct.pack("<4sIIBBBB", b"NGSP", 3, count, 0, 12, 0, 0))
            for _ in range(200):
                f.write(bytes(size))
        tracemalloc.start()
        if count == 10:
            assert len(read_asset(path).asset) == 10
        else:
            with pytest.raises(InputError, match=f"{count} Gaussians were announced"):
                read_asset(path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 20e6


WHOLE = {
    "a.splat": splat()[0],
    "a.spz": gzip.compress(spz(3)[0]),
    "b.spz": base64.b85decode(SPZ_4),
    "c.spz": None,  # damage inside the gzip stream, under a whole check sum
    "a.ply": compressed(),
    "b.ply": PLAIN,
}


@settings(max_examples=300, deadline=None)
@given(st.data(), st.sampled_from(sorted(WHOLE)))
def test_damage_is_an_input_error_or_a_sound_asset(tmp_path_factory, data, name):
    whole = spz(3)[0] if name == "c.spz" else WHOLE[name]
    damaged = bytearray(whole[: data.draw(st.integers(0, len(whole)))] if data.draw(st.booleans()) else whole)
    for _ in range(data.draw(st.integers(0, 4))):
        if damaged:
            at = data.draw(st.integers(0, min(len(damaged), 700) - 1))
            damaged[at] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes(gzip.compress(damaged) if name == "c.spz" else damaged)
    try:
        loaded = read_asset(path)
    except InputError as e:
        assert str(e).startswith(f"{path}: ") and "\n" not in str(e)
    else:
        check(loaded.asset)
    with contextlib.suppress(OSError):
        path.unlink()
