"""Where figures come from: revision, uncommitted changes, hashes."""

import os
import subprocess

from timesplat.evaluation.provenance import Provenance, machine, revision


def git(folder, *words):
    who = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
    return subprocess.check_output(["git", "-C", str(folder), *who, *words], text=True).strip()


def test_a_checkout_is_named_and_its_changes_are_seen(tmp_path):
    assert revision(tmp_path) == (None, None)
    git(tmp_path, "init", "-q")
    (tmp_path / "a").write_text("1")
    git(tmp_path, "add", "a")
    git(tmp_path, "commit", "-qm", "first")
    head = git(tmp_path, "rev-parse", "HEAD")
    assert revision(tmp_path) == (head[:12], True)
    (tmp_path / "a").write_text("2")
    assert revision(tmp_path) == (head[:12], False)
    (tmp_path / "inside").mkdir()
    assert revision(tmp_path / "inside") == (None, None)  # somebody else's checkout


def test_checkpoints_are_told_apart_by_their_bytes(tmp_path):
    (tmp_path / "a.safetensors").write_bytes(b"abc")
    made = Provenance.of("timesplat x", [tmp_path / "a.safetensors", tmp_path / "none.safetensors"])
    assert made.checkpoints == {"a.safetensors": "ba7816bf8f01"}  # of SHA-256("abc"), FIPS 180-2
    assert "a.safetensors ba7816bf8f01" in str(made)


def test_the_machine_is_named_where_affinity_does_not_exist(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)  # as on macOS and Windows
    assert machine()["cores"] == os.cpu_count()
