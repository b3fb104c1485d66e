# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of the network on rendered clips: `timesplat train DATA… --out RUN`."""

from __future__ import annotations

import json
import math
import signal
import time
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from ...datagen.sequence import InputError
from ..checkpoints_io import load_network, save_network
from ..devices import check_device
from ..gaussians import Gaussians4D
from ..inference import geometry_for
from ..network import PRESETS, Config, Network, load_matching
from ..views import BACKGROUND, Views
from . import distributed
from .config import TrainConfig
from .dataset import ClipDataset, Sample
from .deferred import DetachedScene
from .losses import PixelTruth, geometric_loss, load_perceptual_loss, photometric_loss, pixel_truth
from .optimizers import clip_and_step, learning_rate, weights_fit_checkpoint
from .prefetch import samples
from .reporting import StageTimer, StepResult, report_line
from .run_state import RunState
from .shard_dataset import ShardDataset, holds_shards
from .view_sampling import DEFAULT_COUNTS


@dataclass(frozen=True)
class Intervals:
    """In steps."""

    report: int = 20  # between two lines of the log
    save: int = 200
    patience: int = 100  # that may pass in a row without a change of the weights


INTERVALS = Intervals()


def train(config: TrainConfig) -> None:
    """Trains to the end, and goes on where the run folder stands; under torchrun as one of several processes.

    The folder holds `log.jsonl` (a line per report), `state.pt` (all that an exact resume needs) and
    `network.safetensors` (the averaged weights, ready for `--checkpoint`). The paper's own training (section 4.1,
    appendix) is `--preset large --sampling paper --warmup 2000 --bf16 --checkpointing --accumulate N`; what differs by
    default was better at the scale of one machine. Raises InputError for data, devices and run folders that cannot be
    used, KeyboardInterrupt once an interrupted run is saved."""
    check_device(config.device)
    config = replace(config, device=distributed.start(config.device))
    try:
        clips = load_clips(config)
        if not distributed.rank():
            print(clips)
        Trainer(make_network(config).to(config.device), clips, config).run()
    finally:
        distributed.end()


def load_clips(config: TrainConfig) -> ClipDataset:
    """The clips; of Sequences one process packs, the others then find them packed. Raises InputError."""
    has_depth = network_config(config).source == "given" or config.geometric > 0
    sharded = [holds_shards(folder) for folder in config.data]
    if any(sharded):
        if not all(sharded):
            raise InputError(f"{config.data[sharded.index(False)]}: no shards, which the others are; pack it too.")
        return ShardDataset(config.data, config.shrink, config.sampling, config.mix, has_depth)
    if distributed.rank():
        distributed.barrier()
    how = (config.shrink, config.sampling, config.mix, has_depth, config.reading)
    clips = ClipDataset(config.data, config.cache, *how)
    if not distributed.rank():
        distributed.barrier()
    return clips


def network_config(config: TrainConfig) -> Config:
    """That of the preset, changed in what options were given. Raises InputError where they do not go together."""
    options = {k: getattr(config, k) for k in ("head", "source", "depth_range", "time", "free", "motion")}
    return replace(PRESETS[config.preset], **{k: v for k, v in options.items() if v is not None})


def make_network(config: TrainConfig) -> Network:
    """With random weights by the seed, or those of --init. Raises InputError where these are another network's."""
    torch.manual_seed(config.seed)
    network = Network(network_config(config))
    if config.init:
        load_matching(network, load_network(config.init))
    return network


class Trainer:
    """A run from where its folder stands: the state, the data, and the loop over steps."""

    def __init__(self, network: Network, clips: ClipDataset, config: TrainConfig):
        """network: on config.device, at its first weights. Raises InputError for a run that cannot be resumed, or
        weights of the perceptual loss that cannot be read."""
        self.network, self.clips, self.config = network, clips, config
        network.checkpointing = config.checkpointing
        inputs, targets = DEFAULT_COUNTS[config.sampling]
        self.inputs, self.targets = config.views or inputs, config.targets or targets
        self.perceptual_loss = load_perceptual_loss() if config.perceptual else None
        if self.perceptual_loss:
            self.perceptual_loss.to(config.device)
        self.state = RunState.begin(network, config.optimizer)
        self.timer = StageTimer(config.device)
        self.idle_steps = 0  # how many in a row have changed nothing, the last one included
        self.interrupted = False  # by Ctrl-C
        self.stopped = False  # for one of the processes was interrupted, and all know of it
        self.state_path = config.out / "state.pt"
        config.out.mkdir(parents=True, exist_ok=True)
        if self.state_path.exists():
            self.state.load(self.state_path, config.device)
        self.samples = samples(
            clips,
            seed=config.seed,
            step=self.state.step,
            rank=distributed.rank(),
            accumulate=config.accumulate,
            inputs=self.inputs,
            targets=self.targets,
            workers=config.workers,
        )

    def progress(self) -> float:
        """0..1, by the clock where minutes are given, else by steps."""
        done = self.state.step / self.config.steps
        return max(self.state.seconds / (60 * self.config.minutes), done) if self.config.minutes else done

    def run(self) -> None:
        """Trains to the end; an interrupt (Ctrl-C) ends it after the step at hand, with the state saved. Raises
        KeyboardInterrupt then, and InputError where weights, or losses for long, are not finite: the saved state is
        the last good one then."""
        previous = signal.signal(signal.SIGINT, lambda *_: setattr(self, "interrupted", True))
        try:
            self._loop()
        finally:
            self.samples.close()
            signal.signal(signal.SIGINT, previous)
        if self.interrupted or self.stopped:
            raise KeyboardInterrupt

    def _loop(self) -> None:
        state = self.state
        wall, cpu = state.seconds - time.perf_counter(), state.cpu_seconds - time.process_time()
        layout = "{l_bar}{bar}| {elapsed}<{remaining}{postfix}"
        quiet = True if distributed.rank() else None
        results: list[StepResult] = []  # since the last report
        save_due = False
        with tqdm(total=1.0, disable=quiet, bar_format=layout, desc=self.config.out.name) as bar:
            while self.progress() < 1 and not self.stopped:
                results.append(self.train_step())
                mine = [wall + time.perf_counter(), self.interrupted, results[-1].learned]
                state.seconds, stopped, learned = distributed.reduce_max(mine, self.config.device)
                state.cpu_seconds = cpu + time.process_time()
                self.stopped = bool(stopped)
                self.idle_steps = 0 if learned else self.idle_steps + 1
                if state.step % INTERVALS.report == 0:
                    line = self._report(results)
                    text = " {step} loss {loss:.4f} psnr {psnr:.2f} {samples_per_s} samples/s"
                    text += ", {share[data]:.0%} data wait"
                    bar.set_postfix_str(text.format(**line))
                    results = []
                bar.update(self.progress() - bar.n)
                if self.idle_steps >= INTERVALS.patience:
                    raise self._ran_away(f"{self.idle_steps} steps without a sound loss and gradient")
                save_due |= state.step % INTERVALS.save == 0
                if save_due and not self.idle_steps:
                    self._save()
                    save_due = False
            if self.idle_steps < INTERVALS.report:
                self._save()
            elif not self.stopped:
                raise self._ran_away(f"its last {self.idle_steps} steps were without a sound loss and gradient")

    def _report(self, results: list[StepResult]) -> dict:
        """Writes a line of the log, and times the stages anew."""
        samples = len(results) * self.config.accumulate * distributed.world_size()
        line = report_line(self.state, results, samples, self.timer)
        self.timer.reset()
        if not distributed.rank():
            with open(self.config.out / "log.jsonl", "a") as f:
                f.write(json.dumps(line) + "\n")
        return line

    def _save(self) -> None:
        if distributed.rank():
            return
        state = self.state
        state.save(self.state_path)
        notes = {"steps": str(state.step), "hours": f"{state.seconds / 3600:.2f}", "seed": str(self.config.seed)}
        save_network(self.config.out / "network.safetensors", state.averaged_network(), notes)

    def _ran_away(self, how: str) -> InputError:
        """What ends a run that is past help; nothing was saved since it was not."""
        kept = "; it goes on from its last good state" if self.state_path.exists() else ""
        return InputError(
            f"{self.config.out}: training ran away at step {self.state.step} ({how}){kept}; "
            f"give a lower --rate than {self.config.rate:g}."
        )

    def train_step(self) -> StepResult:
        """One step of the optimizers over `accumulate` samples, see `samples`. Raises InputError where a weight has
        outgrown what a checkpoint holds."""
        config, state = self.config, self.state
        self.network.train()
        found = []
        for _ in range(config.accumulate):
            with self.timer.stage("data"):
                sample, rng = next(self.samples)
            found.append(self.backward_sample(sample, rng))
        distributed.average_gradients(self.network)
        rate = learning_rate(config.rate, state.step, config.warmup, self.progress())
        stepped = clip_and_step(state.optimizers, rate, warmed_up=state.step >= config.warmup)
        state.skipped_steps += not stepped
        state.step += 1
        if not weights_fit_checkpoint(self.network):
            raise self._ran_away("weights beyond what a checkpoint holds")
        state.update_average()
        finite = [x for x in found if x is not None]
        state.nonfinite_samples += len(found) - len(finite)
        loss, psnr = np.mean(finite or [(math.nan, math.nan)], axis=0).tolist()
        return StepResult(loss, psnr, learned=stepped and bool(finite))

    def backward_sample(self, sample: Sample, rng: np.random.Generator) -> tuple[float, float] | None:
        """Adds a sample's share of the step's gradients to the network's. Returns its loss and the PSNR of its targets
        in dB; None, and no gradients, where the loss is not finite."""
        config, network, timer = self.config, self.network, self.timer
        with timer.stage("geometry"):
            geometry = geometry_for(network.config.source, sample.inputs)
            truth = None
            if config.geometric and network.config.source != "given":
                truth = pixel_truth(network, sample.inputs, geometry).to(config.device)
            inputs, targets = sample.inputs.to(config.device), sample.targets.to(config.device)
            geometry = geometry and geometry.to(config.device)
        with timer.stage("network"):
            with torch.autocast(config.device.split(":")[0], torch.bfloat16, enabled=config.bf16):
                g = network(inputs, geometry)
            scene_loss = self.scene_loss(g, truth)
        with timer.stage("raster"):
            background = torch.tensor(random_background(rng)).float().to(config.device)
            scene = DetachedScene(g)
            loss, psnr = math.nan, math.nan
            if scene.is_finite():
                picture_loss = partial(self.picture_loss, background=background)
                loss, psnr = scene.backward_views(targets, background, picture_loss)
            loss += 0.0 if scene_loss is None else float(scene_loss.detach())
        with timer.stage("network"):
            if math.isfinite(loss):
                scene.backward_network(1 / config.accumulate, scene_loss)
        return (loss, psnr) if math.isfinite(loss) else None

    def picture_loss(self, rgb: Tensor, alpha: Tensor, targets: Views, background: Tensor) -> Tensor:
        """What is asked of pictures rgb (C,H,W,3) over a background (3,), and alpha (C,H,W), of C target views."""
        loss = photometric_loss(rgb, alpha, targets, background)
        if self.perceptual_loss:
            loss = loss + self.config.perceptual * self.perceptual_loss(rgb, targets.over(background))
        return loss

    def scene_loss(self, g: Gaussians4D, truth: PixelTruth | None) -> Tensor | None:
        """What is asked of the Gaussians themselves: to be where depth has them (less and less of it), and to be
        no more opaque than they need to (mean opacity)."""
        loss = None
        if truth is not None:
            weight = self.config.geometric * (1 - 0.9 * min(1, 2 * self.progress()))
            loss = weight * geometric_loss(g[: len(truth)], truth)  # free Gaussians come last
        if self.config.opacity:
            loss = self.config.opacity * g.opacity.mean() + (0.0 if loss is None else loss)
        return loss


def random_background(rng: np.random.Generator) -> np.ndarray:
    """(3,) a colour at random half of the time, else white."""
    return rng.uniform(0, 1, 3) if rng.random() < 0.5 else np.full(3, BACKGROUND)
