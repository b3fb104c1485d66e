"""The program as people call it: help that teaches, and one sentence and exit code 2 for what cannot be used."""

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from timesplat.cli import COMMANDS, main
from timesplat.datagen.sequence import InputError
from timesplat.model.io.ply import read_ply, write_ply

from .assets import assert_same, make_asset, tracked_asset


def refused(capsys, *argv, says: str, names: str = "") -> None:
    """The command exits with 2 and prints one line that holds `says` and `names`, no traceback."""
    assert main([str(a) for a in argv]) == 2
    err = capsys.readouterr().err.strip()
    assert says in err and names in err and "Traceback" not in err
    assert len(err.splitlines()) == 1, err


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command, capsys):
    with pytest.raises(SystemExit) as e:
        main([command, "--help"])
    assert e.value.code == 0 and len(capsys.readouterr().out) > 200


def test_help_starts_quickly_without_heavy_imports():
    code = "import sys, timesplat.cli as c\ntry: c.main(['--help'])\nexcept SystemExit: pass\n"
    code += "print([m for m in ('torch', 'bpy', 'numba', 'pxr') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout
    assert "timesplat demo" in out and out.strip().endswith("[]")


def test_road_from_sequence_to_usd(sphere_folder, tmp_path, capsys):
    ply, usd = tmp_path / "a.ply", tmp_path / "a.usdc"
    assert main(["reconstruct", str(sphere_folder), "--out", str(ply), "--method", "lift"]) == 0
    assert main(["export", str(ply), str(usd)]) == 0
    said = capsys.readouterr().out
    assert "Gaussians" in said and "coverage" in said and usd.stat().st_size > 10_000


def test_fewer_gaussians_than_were_asked_for_are_told(sphere_folder, tmp_path, capsys):
    for method, number, told in (("flow", "500000", True), ("flow", "50", False), ("deform", "500000", True)):
        command = ["reconstruct", str(sphere_folder), "--out", str(tmp_path / "a.ply"), "--method", method]
        assert main([*command, "--budget", number, "--steps", "3"]) == 0
        assert ("500,000 were asked for" in capsys.readouterr().out) == told


@pytest.mark.parametrize("errors_too", [False, True])
@pytest.mark.parametrize(
    ("words", "how"),
    [("--help", ""), ("export a.ply b.ply", ""), ("export a.ply b.ply", "1"), ("export a.ply b.obj", "")],
)
def test_a_reader_that_leaves_early_is_no_fault(tmp_path, words, how, errors_too):
    """`timesplat … | head -1`, and with `2>&1`: the code that a shell gives to SIGPIPE, no traceback, whole files."""
    write_ply(tmp_path / "a.ply", make_asset(3))
    reader, writer = os.pipe()
    os.close(reader)
    code = "import sys\nfrom timesplat.cli import main\nsys.exit(main(sys.argv[1:]))"
    more = {"stderr": writer if errors_too else subprocess.PIPE, "env": os.environ | {"PYTHONUNBUFFERED": how}}
    done = subprocess.run([sys.executable, "-c", code, *words.split()], stdout=writer, cwd=tmp_path, **more)
    os.close(writer)
    refused = "b.obj" in words
    assert done.returncode == (2 if refused and not errors_too else 141)
    if not errors_too:
        assert (b"b.obj: " in done.stderr and done.stderr.count(b"\n") == 1) if refused else done.stderr == b""
    assert ((tmp_path / "b.ply").exists()) == ("b.ply" in words)


def test_pictures_alone_are_fitted_as_well_as_is_sensible_unless_it_is_said_how_long(pictures, tmp_path, monkeypatch):
    from timesplat.model import reconstruct as module

    asked = []

    def stop(sequence, method, indices, options, progress, size=None):
        asked.append((method, options.quality, options.steps))
        raise InputError("enough")

    monkeypatch.setattr(module, "reconstruct", stop)
    command = ["reconstruct", str(pictures), "--out", str(tmp_path / "out.ply")]
    for told in ([], ["--steps", "7"], ["--seconds", "3"], ["--refine", "3"], ["--quality", "draft"]):
        assert main([*command, *told]) == 2
    named = [("deform", q, s) for q, s in (("balanced", None), (None, 7), (None, None), (None, None), ("draft", None))]
    assert asked == named


def test_missing_and_damaged_sequences(sphere_folder, tmp_path, capsys):
    out = tmp_path / "out" / "a.ply"
    out.parent.mkdir()

    def reconstruct(folder, says, *more):
        refused(capsys, "reconstruct", folder, "--out", out, "--method", "lift", *more, says=says, names=folder.name)
        assert not list(out.parent.iterdir())

    reconstruct(tmp_path / "nowhere", "no such file")
    broken = tmp_path / "broken"
    shutil.copytree(sphere_folder, broken)
    text = (broken / "transforms.json").read_text()
    (broken / "images" / "003.png").unlink()
    reconstruct(broken, "003.png: the file is missing")
    shutil.copy(sphere_folder / "images" / "003.png", broken / "images" / "003.png")
    (broken / "images" / "004.png").write_bytes(b"\x89PNG broken")
    reconstruct(broken, "004.png: the image cannot be read")
    shutil.copy(sphere_folder / "images" / "004.png", broken / "images" / "004.png")
    (broken / "passes" / "005.exr").write_bytes((broken / "passes" / "005.exr").read_bytes()[:500])
    reconstruct(broken, "005.exr")
    shutil.copy(sphere_folder / "passes" / "005.exr", broken / "passes" / "005.exr")
    data = json.loads(text)
    data["frames"][2]["transform_matrix"] = [[0.0] * 4] * 4
    (broken / "transforms.json").write_text(json.dumps(data))
    reconstruct(broken, "singular")
    data["frames"][2]["transform_matrix"] = [[float("nan")] * 4] * 4
    (broken / "transforms.json").write_text(json.dumps(data))
    reconstruct(broken, "not a finite 4x4 matrix")
    (broken / "transforms.json").write_text(text[: len(text) // 2])
    reconstruct(broken, "damaged")
    (broken / "transforms.json").write_text(text)
    reconstruct(broken, "no rig moon", "--rig", "moon")


def test_methods_and_checkpoints(sphere_folder, tmp_path, capsys):
    out = tmp_path / "a.ply"
    refused(capsys, "reconstruct", sphere_folder, "--out", out, "--method", "magic", says="no such method")
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes(b"\x10\0\0\0\0\0\0\0{")
    loaded = ("reconstruct", sphere_folder, "--out", out, "--checkpoint", bad)
    refused(capsys, *loaded, "--method", "guided", says="not a whole", names="bad.safe")
    refused(capsys, *loaded, says="flow is no network", names="bad.safe")
    refused(capsys, "reconstruct", sphere_folder, "--out", out, "--device", "abacus", says="cannot use this device")
    once = ("reconstruct", sphere_folder, "--out", out, "--quality", "draft")
    refused(capsys, *once, "--steps", "3", says="quality and steps: each says how long a fit goes on; give one of them")
    refused(capsys, *once, "--refine", "3", says="quality and refine: each says")
    refused(capsys, *once, "--seconds", "3", says="--seconds and --quality: each says")
    refused(capsys, *once[:4], "--steps", "3", "--seconds", "3", says="--seconds and --steps: each says")
    refused(capsys, *once[:4], "--quality", "superb", says="superb: no such quality; choose one of draft")
    refused(capsys, "train", sphere_folder, "--out", tmp_path / "run", "--device", "abacus", says="this device")
    refused(capsys, "train", sphere_folder, "--out", tmp_path / "run", "--rate", "0", says="--rate 0: give")
    refused(capsys, "evaluate", "x.glb", "--out", tmp_path / "e", "--methods", "lift,magic", says="no such method")
    refused(capsys, "train", tmp_path / "none", "--out", tmp_path / "run", says="no Sequence in it", names="none")
    assert not out.exists()


def test_assets_to_export(tmp_path, capsys):
    refused(capsys, "export", tmp_path / "no.ply", tmp_path / "a.usdc", says="no.ply")
    cut = tmp_path / "cut.ply"
    cut.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nend_header\n1234")
    refused(capsys, "export", cut, tmp_path / "a.usdc", says="cut.ply")
    assert not (tmp_path / "a.usdc").exists()


def test_pieces_are_exported_in_place_of_paths(tmp_path, capsys):
    write_ply(tmp_path / "a.ply", tracked_asset(9))
    assert main(["export", str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), "--pieces"]) == 0
    pieces = read_ply(tmp_path / "b.ply")
    assert pieces.paths is None and len(pieces) > 9 and f"{len(pieces)} Gaussians" in capsys.readouterr().out
    for moments in (("s.ply", "--frame", "12"), ("--sequence", "frames")):
        says = "--pieces is for what has time"
        refused(capsys, "export", tmp_path / "a.ply", *moments, "--pieces", says=says)


def test_other_programs_files_are_exported_and_how_they_lie_is_said(tmp_path, capsys):
    write_ply(tmp_path / "a.ply", make_asset())
    for words in ("a.ply a.splat --frame 20", "a.splat b.ply", "a.ply --sequence frames", "frames c.ply"):
        arguments = [w if w.startswith("--") or w.isdigit() else str(tmp_path / w) for w in words.split()]
        assert main(["export", *arguments]) == 0
        assert ("-Y is up in it" in capsys.readouterr().out) == (words in ("a.splat b.ply", "frames c.ply"))
    assert (tmp_path / "b.ply").stat().st_size > 1000 and read_ply(tmp_path / "c.ply").clip.frames == range(1, 25)
    refused(capsys, "export", tmp_path / "a.obj", tmp_path / "d.ply", says="its name must end in", names="a.obj")


def test_a_slice_of_a_slice_is_the_slice(tmp_path, capsys):
    """-Y is up in it, and is up again; in USD and in our .ply Z is, over the asset."""
    asset = make_asset(sigma=(9, 10))
    write_ply(tmp_path / "a.ply", asset)
    for words in ("a.ply s.ply --frame 20", "s.ply t.ply --frame 1", "s.ply z.ply", "s.ply kept.ply --up Z"):
        capsys.readouterr()
        assert main(["export", *(str(tmp_path / w) if w.endswith(".ply") else w for w in words.split())]) == 0
        assert ("it is turned so that Z is" in capsys.readouterr().out) == (words[0] == "s" and "--up" not in words)
    one, two, standing, kept = (read_ply(tmp_path / f"{n}.ply") for n in ("s", "t", "z", "kept"))
    assert_same(one, two, 1e-5, 2e-6)
    np.testing.assert_allclose(kept.xyz, one.xyz, atol=1e-6)
    world = asset.at(asset.frame_to_time(20))[0] * 2 + (1, 2, 3)
    np.testing.assert_allclose(standing.xyz + standing.clip.translation, world, atol=1e-5)


def test_what_is_left_out_is_said(tmp_path, capsys):
    write_ply(tmp_path / "a.ply", make_asset(9))
    assert main(["export", str(tmp_path / "a.ply"), str(tmp_path / "s.ply"), "--frame", "20"]) == 0
    data = bytearray((tmp_path / "s.ply").read_bytes())
    data[-56:-52] = np.float32(np.nan).tobytes()  # x of the last one
    (tmp_path / "s.ply").write_bytes(data)
    capsys.readouterr()
    assert main(["export", str(tmp_path / "s.ply"), str(tmp_path / "b.ply")]) == 0
    assert "Gaussians are left out: NaN, or beyond all bounds, in position" in capsys.readouterr().out


def test_files_of_one_moment_ask_which(tmp_path, capsys):
    write_ply(tmp_path / "a.ply", make_asset(9))
    for name in ("a.splat", "a.spz", "a.glb"):
        refused(capsys, "export", tmp_path / "a.ply", tmp_path / name, says="one moment; say which by --frame")
        assert main(["export", str(tmp_path / "a.ply"), str(tmp_path / name), "--frame", "20"]) == 0


def test_view_opens_a_page(tmp_path, capsys, monkeypatch):
    opened, answers = [], [True, False]
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or answers.pop(0))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    write_ply(tmp_path / "my fox.ply", make_asset(9))
    for says in ("9 Gaussians", "no browser was found"):
        assert main(["view", str(tmp_path / "my fox.ply")]) == 0
        assert says in capsys.readouterr().out
        assert opened[-1].startswith("file://") and opened[-1].endswith("/my%20fox.html")
    assert len(list(tmp_path.glob("timesplat-*/my fox.html"))) == 2
    refused(capsys, "view", tmp_path / "no.ply", says="no such file", names="no.ply")
    assert len(opened) == len(list(tmp_path.glob("timesplat-*"))) == 2


def test_files_that_no_renderer_takes(tmp_path, capsys):
    bad = tmp_path / "bad.glb"
    bad.write_bytes(b"glTF\x02\0\0\0 not really")
    for asset, says in ((tmp_path / "none.glb", "none.glb"), (bad, "bad.glb"), (tmp_path / "a.txt", "a.txt")):
        if asset.suffix == ".txt":
            asset.write_text("hello")
        code = main(["render", str(asset), "--out", str(tmp_path / "renders"), "--size", "32", "--samples", "1"])
        err = capsys.readouterr().err
        assert code == 2 and says in err and "Traceback" not in err
    refused(capsys, "demo", bad, "--out", tmp_path / "demo", says="bad.glb")
    left = {p.name for p in tmp_path.rglob("*") if p.is_file() and p.parent != tmp_path}
    assert left == {"index.csv", "index.parquet", "failed.json"}  # which say why
