# SPDX-License-Identifier: GPL-3.0-or-later
"""The file of surface tracks: a round trip, and what is refused."""

import json

import numpy as np
import pytest

from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.datagen.track_file import SurfaceTracks, read_tracks, write_tracks


def some(n=5, frames=3) -> SurfaceTracks:
    rng = np.random.default_rng(0)
    q = rng.normal(size=(n, frames, 4))
    return SurfaceTracks(
        rng.normal(size=(n, frames, 3)).astype(np.float32),
        (q / np.linalg.norm(q, axis=-1, keepdims=True)).astype(np.float16),
        np.zeros(n, np.int32),
        np.full(n, frames - 1, np.int32),
        rng.uniform(0.1, 1, n).astype(np.float32),
    )


def test_round_trip(tmp_path):
    write_tracks(tmp_path / "t.npz", some())
    back = read_tracks(tmp_path / "t.npz", 3)
    for name, a in vars(some()).items():
        assert np.array_equal(a, getattr(back, name)) and a.dtype == getattr(back, name).dtype


@pytest.mark.parametrize(
    ("what", "change"),
    [
        ("position", {"position": np.full((5, 3, 3), np.nan, np.float32)}),
        ("rotation", {"rotation": np.zeros((5, 3, 4), np.float16)}),
        ("first", {"first": np.full(5, 7, np.int32)}),
        ("area", {"area": np.zeros(5, np.float32)}),
        ("position", {"position": np.zeros((5, 2, 3), np.float32)}),
    ],
)
def test_what_is_wrong_is_said(tmp_path, what, change):
    np.savez(tmp_path / "t.npz", **vars(some()) | change)
    with pytest.raises(ValueError, match=what):
        read_tracks(tmp_path / "t.npz", 3)


def test_a_pickle_or_half_a_file_is_refused(tmp_path):
    np.savez(tmp_path / "t.npz", **vars(some()) | {"area": np.array([print] * 5, object)})
    with pytest.raises(ValueError, match=r"[Pp]ickle|Object"):
        read_tracks(tmp_path / "t.npz", 3)
    write_tracks(tmp_path / "t.npz", some())
    whole = (tmp_path / "t.npz").read_bytes()
    (tmp_path / "t.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError):
        read_tracks(tmp_path / "t.npz", 3)
    with pytest.raises(ValueError, match="missing"):
        np.savez(tmp_path / "t.npz", position=some().position)
        read_tracks(tmp_path / "t.npz", 3)


def test_a_sequence_names_it(tmp_path):
    (tmp_path / "a.png").write_bytes(b"")
    frame = {"frame": 0, "file_path": "a.png", "transform_matrix": np.eye(4).tolist(), "fl_x": 1, "fl_y": 1}
    text = {"w": 8, "h": 8, "frame_end": 2, "frames": [frame], "tracks_path": "tracks.npz", "untracked": ["Smoke"]}
    (tmp_path / "transforms.json").write_text(json.dumps(text))
    with pytest.raises(InputError, match=r"tracks\.npz: the file is missing"):
        read_sequence(tmp_path)
    write_tracks(tmp_path / "tracks.npz", some())
    seq = read_sequence(tmp_path)
    assert len(seq.load_tracks()) == 5 and seq.untracked == ["Smoke"]
    write_tracks(tmp_path / "tracks.npz", some(frames=4))
    with pytest.raises(InputError, match=r"tracks\.npz: the tracks cannot be read \(position"):
        seq.load_tracks()
    (tmp_path / "transforms.json").write_text(json.dumps(text | {"tracks_path": "../tracks.npz"}))
    with pytest.raises(InputError, match="outside"):
        read_sequence(tmp_path)
