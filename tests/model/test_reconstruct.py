"""Methods by name, checkpoints that are whole or refused, and what was on disk when it went wrong."""

import json

import pytest
import torch
from safetensors.torch import load_file, save_file

from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.model.network import Config, Network
from timesplat.model.reconstruct import METHODS, clip_of, load_network, reconstruct, save_network

TINY = Config(width=32, depth=1, heads=2, source="given")


@pytest.fixture
def checkpoint(tmp_path):
    torch.manual_seed(0)
    path = tmp_path / "tiny.safetensors"
    save_network(path, Network(TINY), {"steps": "0"})
    return path


def test_checkpoint_round_trip(checkpoint):
    torch.manual_seed(0)
    network, back = Network(TINY), load_network(checkpoint)
    assert back.config == TINY and not back.training
    for k, v in network.state_dict().items():
        torch.testing.assert_close(back.state_dict()[k], v.half().float(), rtol=0, atol=0)
    assert not list(checkpoint.parent.glob("*.tmp"))


@pytest.mark.parametrize("keep", [0, 7, 100, 0.5, 0.999])
def test_truncated_checkpoint_is_one_sentence(checkpoint, keep):
    data = checkpoint.read_bytes()
    checkpoint.write_bytes(data[: int(keep * len(data)) if isinstance(keep, float) else keep])
    with pytest.raises(InputError, match=r"tiny\.safetensors: not a whole Timesplat checkpoint"):
        load_network(checkpoint)


def test_checkpoint_with_nan_or_another_shape_or_no_config(checkpoint, tmp_path):
    tensors = load_file(checkpoint)
    meta = {"config": json.dumps({"width": 32, "depth": 1, "heads": 2, "source": "given"})}
    bad = dict(tensors)
    bad["embed.weight"] = torch.full_like(bad["embed.weight"], float("nan"))
    save_file(bad, tmp_path / "nan.safetensors", meta)
    with pytest.raises(InputError, match=r"embed\.weight hold NaN"):
        load_network(tmp_path / "nan.safetensors")
    save_file(tensors, tmp_path / "wide.safetensors", {"config": json.dumps({"width": 64, "depth": 1, "heads": 2})})
    with pytest.raises(InputError, match="not a whole Timesplat checkpoint"):
        load_network(tmp_path / "wide.safetensors")
    save_file(tensors, tmp_path / "bare.safetensors")
    with pytest.raises(InputError, match="not a whole Timesplat checkpoint"):
        load_network(tmp_path / "bare.safetensors")
    meta = {"config": json.dumps({"width": 32, "depth": 1, "heads": 2, "source": "given", "head": "kinematik"})}
    save_file(tensors, tmp_path / "typo.safetensors", meta)
    with pytest.raises(InputError, match=r"typo\.saf.*: not a whole Timesplat .*\(head kinematik: .*kinematic\); copy"):
        load_network(tmp_path / "typo.safetensors")
    with pytest.raises(InputError, match="no such checkpoint"):
        load_network(tmp_path / "none.safetensors")


@pytest.mark.parametrize("method", ["white", "hull", "lift"])
def test_methods_without_a_network(sphere_folder, method):
    seq = read_sequence(sphere_folder)
    g = reconstruct(seq, method, range(24))
    assert (len(g) > 500) == (method != "white")
    assert g.alive().all()
    assert clip_of(seq).frame_end == 23 and clip_of(seq).pixel > 0


@pytest.mark.parametrize(
    ("frames", "clip"),
    [
        (range(1001, 1025), (1001, 1024)),
        (range(-3, 45, 2), (-3, 43)),  # every second frame: it takes as long as in the scene
        ([5, 6, *[7] * 22], (5, 28)),  # a short clip: the scene holds its last frame
        ([9] * 24, (0, 23)),  # one moment, displaced
        ([1, 2, 4, *range(5, 26)], (0, 23)),
        (range(10), (0, 23)),
        ("1001", (0, 23)),
    ],
)
def test_the_clip_is_at_the_frames_of_the_scene(sphere_folder, frames, clip):
    seq = read_sequence(sphere_folder)
    seq.provenance["scene_frames"] = frames if isinstance(frames, str) else list(frames)
    found = clip_of(seq)
    step = frames.step if isinstance(frames, range) else 1
    assert (found.frame_start, found.frame_end, found.fps) == (*clip, seq.fps * step)


def test_untrained_guided_network_is_the_lift(sphere_folder, checkpoint):
    seq = read_sequence(sphere_folder)
    a, b = reconstruct(seq, "lift", range(24)), reconstruct(seq, "guided", range(24), checkpoint=checkpoint)
    torch.testing.assert_close(a.xyz, b.xyz, atol=1e-6, rtol=0)
    torch.testing.assert_close(a.opacity, b.opacity, atol=1e-4, rtol=0)


@pytest.mark.parametrize("method", ["guided", "sweep", "predicted", "rgb"])
def test_shipped_checkpoints_reconstruct(sphere_folder, method):
    g = reconstruct(read_sequence(sphere_folder), method, range(24))
    assert len(g) > 50  # `predicted` makes most of its Gaussians transparent, and the filters drop these
    assert all(torch.isfinite(getattr(g, k)).all() for k in ("xyz", "velocity", "sigma_t", "scale", "rotation", "rgb"))


def test_rgb_methods_read_no_passes(sphere_folder, tmp_path):
    import shutil

    folder = tmp_path / "bare"
    shutil.copytree(sphere_folder, folder)
    shutil.rmtree(folder / "passes")
    text = json.loads((folder / "transforms.json").read_text())
    for f in text["frames"]:
        del f["exr_path"]
    (folder / "transforms.json").write_text(json.dumps(text))
    seq = read_sequence(folder)
    assert len(reconstruct(seq, "rgb", range(24))) > 500
    with pytest.raises(InputError, match="has no depth pass"):
        reconstruct(seq, "lift", range(24))


def test_unknown_method_and_empty_views(sphere_folder, spheres, write_views, tmp_path):
    with pytest.raises(InputError, match="no such method"):
        reconstruct(read_sequence(sphere_folder), "magic")
    views = spheres([0], size=16)
    views.alpha = torch.zeros_like(views.alpha)
    with pytest.raises(InputError, match="no view shows the object"):
        reconstruct(write_views(views, tmp_path / "empty"), "lift")
    assert set(METHODS) >= {"white", "hull", "lift", "guided", "rgb", "sweep", "predicted"}


@pytest.mark.parametrize("method", ["gs-lrm-frame", "gs-lrm-all"])
def test_without_its_checkpoint_a_baseline_says_so(sphere_folder, tmp_path, monkeypatch, method):
    monkeypatch.setattr("timesplat.model.reconstruct.CHECKPOINTS", tmp_path)
    with pytest.raises(InputError, match=r"static\.safetensors: no such checkpoint"):
        reconstruct(read_sequence(sphere_folder), method)


def test_methods_that_fit_take_their_seconds_and_tell(sphere_folder):
    told = []
    g = reconstruct(read_sequence(sphere_folder), "4dgs", seconds=0.2, progress=lambda f, text: told.append((f, text)))
    assert g.alive().all() and told[-1][0] == pytest.approx(1) and told[-1][1].startswith("4dgs, step ")


@pytest.mark.parametrize("options", [{"method": "lift", "refine": 0.1}, {"method": "4dgs", "seconds": 0.1}])
def test_scenes_are_fitted_on_the_processor_where_the_device_has_no_rasteriser(sphere_folder, options):
    """As Apple's has none; torch's "meta" stands for it here."""
    seq = read_sequence(sphere_folder)
    scene = reconstruct(seq, indices=seq.select(rig="input"), device="meta", **options)
    assert len(scene) > 50 and scene.xyz.device.type == "cpu"
