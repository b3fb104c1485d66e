# SPDX-License-Identifier: GPL-3.0-or-later
"""Samples out of shards are those of the Sequences; processes that draw ahead change nothing."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from timesplat.cli import main
from timesplat.datagen.sequence import InputError
from timesplat.datagen.shards import MANIFEST, PackSettings, pack, read_manifest, write_manifest
from timesplat.model.training.config import TrainConfig
from timesplat.model.training.dataset import ClipDataset
from timesplat.model.training.prefetch import samples
from timesplat.model.training.shard_dataset import ShardDataset
from timesplat.model.training.trainer import Trainer, load_clips, make_network


@pytest.fixture
def shards(sphere_folder, tmp_path):
    pack(sphere_folder, tmp_path / "shards")
    return tmp_path / "shards"


def same(a, b) -> bool:
    """Whether two Views are the same, bit for bit."""
    return all(torch.equal(x, vars(b)[k]) for k, x in vars(a).items() if isinstance(x, torch.Tensor))


@pytest.mark.parametrize("sampling", ["setups", "static"])
def test_samples_are_those_of_the_sequences(shards, sphere_folder, tmp_path, sampling):
    ours = ShardDataset([shards], sampling=sampling)
    theirs = ClipDataset([sphere_folder], tmp_path / "cache", sampling=sampling)
    for seed in range(3):
        a, b = (clips.sample(np.random.default_rng(seed), targets=2, inputs=4) for clips in (ours, theirs))
        assert same(a.targets, b.targets) and a.name == b.name and torch.equal(a.inputs.rgb, b.inputs.rgb)
        on = a.inputs.alpha > 0  # that of the cache is rounded to halves, and known on the object alone
        torch.testing.assert_close(a.inputs.depth[on], b.inputs.depth[on], rtol=1e-3, atol=0)
        torch.testing.assert_close(a.inputs.flow[on], b.inputs.flow[on], rtol=1e-3, atol=1e-3)
        assert sampling != "static" or not (a.inputs.time.any() or a.inputs.flow.any())


def test_clips_are_drawn_by_the_mix(shards):
    (clip,) = read_manifest(shards / MANIFEST)
    write_manifest(shards / MANIFEST, [replace(clip, set=s, name=s) for s in ("hq4d", "4d", "4d", "3d")])
    clips = ShardDataset([shards], mix="200:50:1")
    assert str(clips) == "4 clips: 1 hq4d (79.7%), 2 4d (19.9%), 1 3d (0.4%)"
    rng, drawn = np.random.default_rng(0), []
    clips._read = lambda chosen, *_: drawn.append(chosen[1].name) or clip_sample
    clip_sample = ShardDataset([shards]).sample(np.random.default_rng(0), 1, 1)
    for _ in range(2000):
        clips.sample(rng, 1, 1)
    assert drawn.count("hq4d") / 2000 == pytest.approx(200 / 251, abs=0.03)
    with pytest.raises(InputError, match="none of the clips"):
        write_manifest(shards / MANIFEST, [replace(clip, set="3d")])
        ShardDataset([shards], mix="1:1:0")


def test_pictures_alone_do_where_depth_is_not_needed(sphere_folder, tmp_path):
    pack(sphere_folder, tmp_path / "out", PackSettings(passes=False))
    assert ShardDataset([tmp_path / "out"], has_depth=False).sample(np.random.default_rng(0), 2).inputs.depth is None
    with pytest.raises(InputError, match=r"packed without passes, .* or train with --source sweep"):
        ShardDataset([tmp_path / "out"])


def test_shards_and_sequences_do_not_mix(shards, sphere_folder, tmp_path):
    with pytest.raises(InputError, match="no shards, which the others are; pack it too"):
        load_clips(TrainConfig((shards, sphere_folder), tmp_path / "run"))


def draw(clips, workers, step=0, count=6, accumulate=2):
    stream = samples(
        clips, seed=3, step=step, rank=0, accumulate=accumulate, inputs=3, targets=2, workers=workers
    )  # fmt: skip
    found = [(sample, rng.random()) for sample, rng in itertools.islice(stream, count)]
    stream.close()
    return found


def test_processes_that_draw_ahead_change_nothing(shards):
    clips = ShardDataset([shards])
    state = torch.get_rng_state()
    alone, ahead = draw(clips, 0), draw(clips, 2)
    assert torch.equal(torch.get_rng_state(), state)
    later = draw(clips, 2, step=2, count=2)  # as a run that was resumed at step 2
    assert len({number for _, number in alone}) == len(alone)
    for (a, x), (b, y) in zip(alone, ahead, strict=True):
        assert x == y and same(a.inputs, b.inputs) and same(a.targets, b.targets)
    for (a, x), (b, y) in zip(alone[4:], later, strict=True):
        assert x == y and same(a.inputs, b.inputs)


@pytest.mark.parametrize("workers", [0, 1])
def test_what_is_damaged_is_named_also_by_a_process_beside(shards, workers):
    (clip,) = read_manifest(shards / MANIFEST)
    tar = shards / clip.shard
    tar.write_bytes(tar.read_bytes()[: clip.offset + clip.size])
    with pytest.raises(InputError, match=r"^.*shard-000000\.tar: it ends within"):
        draw(ShardDataset([shards]), workers)


def test_training_on_shards_goes_on_exactly(shards, tmp_path):
    def trainer(out: str, workers: int) -> Trainer:
        config = TrainConfig(
            (shards,), tmp_path / out, views=3, targets=1, perceptual=0, warmup=1, steps=4, workers=workers
        )
        return Trainer(make_network(config), load_clips(config), config)

    def weights(t: Trainer) -> torch.Tensor:
        return torch.cat([w.detach().flatten() for w in t.network.parameters()])

    whole, cut_off = trainer("whole", 0), trainer("parts", 1)
    for t in (whole, whole, whole, cut_off, cut_off):
        t.train_step()
    cut_off._save()
    resumed = trainer("parts", 1)
    resumed.train_step()
    for t in (cut_off, resumed):
        t.samples.close()
    assert torch.equal(weights(resumed), weights(whole)) and not torch.equal(weights(cut_off), weights(whole))


def test_fewer_than_no_processes_are_refused(shards, tmp_path, capsys):
    assert main(["train", str(shards), "--out", str(tmp_path / "x"), "--workers", "-1"]) == 2
    assert "--workers -1" in capsys.readouterr().err and not (tmp_path / "x").exists()
