# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of the network on rendered clips: `timesplat train DATA… --out RUN`.

A RUN folder holds `log.jsonl` (a line per report), `state.pt` (all that an exact resume needs) and
`network.safetensors` (the averaged weights, ready for `--checkpoint`). Calling it again goes on. The paper's own
training (section 4.1, appendix) is `--preset large --sampling paper --warmup 2000 --bf16 --checkpointing
--accumulate N` under torchrun; what differs by default was better at the scale of one machine.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import sys
import time
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from ...datagen.sequence import InputError
from ..gaussians import Gaussians4D
from ..geometry.lift import lift_geometry
from ..network import PRESETS, Config, Network, load_matching
from ..reconstruct import check_device, geometry_for, load_network, save_network
from ..views import Views
from . import distributed
from .dataset import Clips, Sample
from .deferred import Cut
from .losses import geometric, load_perceptual, photometric
from .optimizers import learning_rate, make_optimisers, sound_weights, take_step
from .view_sampling import VIEWS

EMA = 0.998  # per step; the shipped weights are this average
REPORT = 20  # steps between two lines of the log
PATIENCE = 100  # steps in a row that may change nothing
STAGES = ("data", "geometry", "network", "raster")  # what a step's time is spent on


def run(args: argparse.Namespace) -> int:
    """Trains as the arguments of `timesplat train` say (see cli.py); returns 0."""
    if not 0 < args.rate < math.inf:
        raise InputError(f"--rate {args.rate:g}: give a number above 0.")
    check_device(args.device)
    args.device = distributed.start(args.device)
    try:
        clips = load_clips(args)
        if not distributed.rank():
            print(clips)
        Trainer(make_network(args).to(args.device), clips, args).run()
    finally:
        distributed.end()
    return 0


def load_clips(args: argparse.Namespace) -> Clips:
    """The clips; one process packs, the others then find them packed."""
    if distributed.rank():
        distributed.wait()
    passes = network_config(args).source == "given" or args.geometric > 0
    clips = Clips(args.data, args.cache, args.shrink, args.sampling, args.mix, passes)
    if not distributed.rank():
        distributed.wait()
    return clips


def network_config(args: argparse.Namespace) -> Config:
    """That of the preset, changed in what options were given. Raises InputError where they do not go together."""
    options = {k: getattr(args, k) for k in ("head", "source", "depth_range", "time", "free", "motion")}
    return replace(PRESETS[args.preset], **{k: v for k, v in options.items() if v is not None})


def make_network(args: argparse.Namespace) -> Network:
    """With random weights by the seed, or those of --init."""
    config = network_config(args)
    if config.motion == "hexplane" and args.geometric:
        raise InputError("--geometric compares velocities, and a HexPlane has none; leave it out.")
    torch.manual_seed(args.seed)
    network = Network(config)
    if args.init:
        load_matching(network, load_network(args.init))
    return network


class Trainer:
    """The state of a run: network, average, optimisers, and how far it has come."""

    def __init__(self, network: Network, clips: Clips, args: argparse.Namespace):
        self.network, self.clips, self.args = network, clips, args
        network.checkpointing = args.checkpointing
        self.views, self.targets = (
            a or b for a, b in zip((args.views, args.targets), VIEWS[args.sampling], strict=True)
        )
        self.perceptual = load_perceptual() if args.perceptual else None
        if self.perceptual:
            self.perceptual.to(args.device)
        self.average = {k: v.detach().clone() for k, v in network.state_dict().items()}
        self.optimisers = make_optimisers(network, args.optimiser)
        self.step, self.seconds, self.cpu = 0, 0.0, 0.0
        self.skipped, self.bad = 0, 0  # steps whose gradient was not sound; samples whose loss was not finite
        self.learnt, self.idle = False, 0  # whether the last step changed anything; those in a row that did not
        self.stopped = False
        self.state = args.out / "state.pt"
        args.out.mkdir(parents=True, exist_ok=True)
        if self.state.exists():
            self.resume()

    def progress(self) -> float:
        """0..1, by the clock where minutes are given, else by steps."""
        if self.args.minutes:
            return max(self.seconds / (60 * self.args.minutes), self.step / self.args.steps)
        return self.step / self.args.steps

    def run(self) -> None:
        """Trains to the end; an interrupt (Ctrl-C) ends it after the step at hand, with the state saved. Raises
        InputError where weights, or losses for long, are not finite: the state is the last good one then."""
        previous = signal.signal(signal.SIGINT, lambda *_: setattr(self, "stopped", True))
        try:
            self._loop()
        finally:
            signal.signal(signal.SIGINT, previous)
        if self.stopped:
            raise KeyboardInterrupt

    def _loop(self) -> None:
        args, wall, cpu = self.args, self.seconds - time.perf_counter(), self.cpu - time.process_time()
        layout = "{l_bar}{bar}| {elapsed}<{remaining}{postfix}"
        quiet = True if distributed.rank() else None
        recent: list[tuple[float, float]] = []
        shares, due = np.zeros(len(STAGES)), False
        with tqdm(total=1.0, disable=quiet, bar_format=layout, desc=args.out.name) as bar:
            while self.progress() < 1 and not self.stopped:
                recent.append(self.train_step(shares))
                told = [wall + time.perf_counter(), self.stopped, self.learnt]
                seconds, stopped, learnt = distributed.greatest(told, args.device)
                self.seconds, self.stopped, self.cpu = seconds, bool(stopped), cpu + time.process_time()
                self.idle = 0 if learnt else self.idle + 1
                if self.step % REPORT == 0:
                    line = self.report(recent, shares)
                    text = " {step} loss {loss:.4f} psnr {psnr:.2f} {samples_per_s} samples/s"
                    bar.set_postfix_str(text.format(**line))
                    recent, shares = [], np.zeros(len(STAGES))
                bar.update(self.progress() - bar.n)
                if self.idle >= PATIENCE:
                    raise self.ran_away(f"{self.idle} steps without a sound loss and gradient")
                due |= self.step % 200 == 0
                if due and not self.idle:
                    self.save()
                    due = False
            if self.idle < REPORT:
                self.save()
            elif not self.stopped:
                raise self.ran_away(f"its last {self.idle} steps were without a sound loss and gradient")

    def ran_away(self, how: str) -> InputError:
        """What ends a run that is past help; nothing was saved since it was not."""
        kept = "; it goes on from its last good state" if self.state.exists() else ""
        return InputError(
            f"{self.args.out}: training ran away at step {self.step} ({how}){kept}; "
            f"give a lower --rate than {self.args.rate:g}."
        )

    def report(self, recent: list[tuple[float, float]], shares: np.ndarray) -> dict:
        """A line of the log: means since the last one; seconds by the clock and of processor time (under load only
        the latter compares) since the start of the run; memory in MB, the highest so far."""
        loss, psnr = np.mean([r for r in recent if math.isfinite(r[0])] or [(math.nan, math.nan)], axis=0)
        samples = len(recent) * self.args.accumulate * distributed.size()
        line = {"step": self.step, "seconds": round(self.seconds, 1), "cpu_seconds": round(self.cpu, 1)}
        line |= {"loss": round(float(loss), 5), "psnr": round(float(psnr), 3)}
        line |= {"samples_per_s": round(samples / max(shares.sum(), 1e-9), 2), "memory": peak_memory()}
        if self.args.device.startswith("cuda"):
            line["cuda_memory"] = round(torch.cuda.max_memory_allocated(self.args.device) / 2**20)
        line |= {"skipped": self.skipped, "bad": self.bad}
        line["share"] = dict(zip(STAGES, (shares / shares.sum()).round(2).tolist(), strict=True))
        if not distributed.rank():
            with open(self.args.out / "log.jsonl", "a") as f:
                f.write(json.dumps(line) + "\n")
        return line

    def train_step(self, shares: np.ndarray) -> tuple[float, float]:
        """One optimiser step over `accumulate` samples -> mean loss and PSNR of the targets, NaN if all were bad.
        Samples are seeded by the step and their number in it, over all processes: a resumed run draws what an
        unbroken one would have, and two processes what one with twice the samples would."""
        args = self.args
        self.network.train()
        results = []
        for n in range(args.accumulate):
            rng = np.random.default_rng((args.seed, self.step, distributed.rank() * args.accumulate + n))
            clock = [self.now()]
            sample = self.clips.sample(rng, self.targets, self.views)
            clock.append(self.now())
            results.append(self.learn(sample, rng, clock))
            data, geometry, forward, raster, backward = np.diff(clock)
            shares += [data, geometry, forward + backward, raster]
        distributed.average_gradients(self.network)
        rate = learning_rate(args.rate, self.step, args.warmup, self.progress())
        stepped = take_step(self.optimisers, rate, warm=self.step >= args.warmup)
        self.skipped += not stepped
        self.step += 1
        if not sound_weights(self.network):
            raise self.ran_away("weights beyond what a checkpoint holds")
        decay = min(EMA, self.step / (self.step + 10))
        for k, v in self.network.state_dict().items():
            self.average[k].lerp_(v, 1 - decay)
        good = [r for r in results if r is not None]
        self.bad += len(results) - len(good)
        self.learnt = stepped and bool(good)
        return tuple(np.mean(good or [(np.nan, np.nan)], axis=0).tolist())

    def learn(self, sample: Sample, rng: np.random.Generator, clock: list[float]) -> tuple[float, float] | None:
        """Adds a sample's gradients to the network's. Returns its loss and the PSNR of its targets; None, and no
        gradients, where the loss is not finite. Appends the times at which stages ended to the clock."""
        args, network = self.args, self.network
        geometry = geometry_for(network.config.source, sample.inputs)
        truth = None
        if args.geometric and network.config.source != "given":
            truth = [x.to(args.device) for x in self.pixel_truth(sample.inputs, geometry)]
        inputs, targets = sample.inputs.to(args.device), sample.targets.to(args.device)
        geometry = geometry and geometry.to(args.device)
        clock.append(self.now())
        with torch.autocast(args.device.split(":")[0], torch.bfloat16, enabled=args.bf16):
            g = network(inputs, geometry)
        more = self.scene_loss(g, truth)
        clock.append(self.now())
        colour = rng.uniform(0, 1, 3) if rng.random() < 0.5 else np.ones(3)
        background = torch.tensor(colour).float().to(args.device)

        def picture_loss(rgb: Tensor, alpha: Tensor, few: Views) -> Tensor:
            loss = photometric(rgb, alpha, few, background)
            if self.perceptual:
                loss = loss + args.perceptual * self.perceptual(rgb, few.over(background))
            return loss

        cut = Cut(g)
        loss, psnr = cut.views_loss(targets, background, picture_loss) if cut.finite() else (math.nan, math.nan)
        loss += 0.0 if more is None else float(more.detach())
        clock.append(self.now())
        if math.isfinite(loss):
            cut.backward(1 / args.accumulate, more)
        clock.append(self.now())
        return (loss, psnr) if math.isfinite(loss) else None

    def now(self) -> float:
        """Seconds, once the device has done what it was given."""
        if self.args.device.startswith("cuda"):
            torch.cuda.synchronize()
        return time.perf_counter()

    def scene_loss(self, g: Gaussians4D, truth) -> Tensor | None:
        """What is asked of the Gaussians themselves: to be where depth has them (less and less of it), and to be
        no more opaque than they need to (mean opacity)."""
        more = None
        if truth is not None:
            weight = self.args.geometric * (1 - 0.9 * min(1, 2 * self.progress()))
            more = weight * geometric(g[: len(truth[0])], *truth)  # free Gaussians come last
        if self.args.opacity:
            more = self.args.opacity * g.opacity.mean() + (0.0 if more is None else more)
        return more

    def pixel_truth(self, inputs, geometry) -> tuple[torch.Tensor, Gaussians4D, torch.Tensor]:
        """For each of the network's Gaussians: the time of its view, what the lift of the renderer's depth says
        of its pixel, and whether that is known."""
        truth = lift_geometry(inputs)
        if geometry is not None:
            owner = geometry.pixel_index
        else:
            place = self.network.pixel_places(inputs, self.network.kept_patches(inputs))
            kept = (place >= 0).nonzero()[:, 0]
            owner = kept[torch.argsort(place[kept])]
        view_time = inputs.time[:, None, None].expand_as(inputs.alpha).flatten()
        away = (truth.gaussians.t - view_time[truth.pixel_index]).abs()
        order = torch.argsort(away, descending=True, stable=True)
        piece = torch.full((len(view_time),), -1)
        piece.numpy()[truth.pixel_index[order].numpy()] = order.numpy()  # of a pixel's pieces the one of its own time
        return view_time[owner], truth.gaussians[piece[owner]], piece[owner] >= 0

    def save(self) -> None:
        if distributed.rank():
            return
        state = {
            "network": self.network.state_dict(),
            "average": self.average,
            "optimisers": [o.state_dict() for o in self.optimisers],
            "progress": {k: getattr(self, k) for k in ("step", "seconds", "cpu", "skipped", "bad")},
        }
        tmp = self.state.with_suffix(".tmp")
        torch.save(state, tmp)
        os.replace(tmp, self.state)
        averaged = Network(self.network.config)
        averaged.load_state_dict(self.average)
        notes = {"steps": str(self.step), "hours": f"{self.seconds / 3600:.2f}", "seed": str(self.args.seed)}
        save_network(self.args.out / "network.safetensors", averaged, notes)

    def resume(self) -> None:
        try:
            state = torch.load(self.state, map_location=self.args.device, weights_only=True)
            self.network.load_state_dict(state["network"])
            if not sound_weights(self.network):
                raise ValueError("its weights are not finite")
            self.average = state["average"]
            for optimiser, saved in zip(self.optimisers, state["optimisers"], strict=True):
                optimiser.load_state_dict(saved)
        except Exception as e:
            raise InputError(f"{self.state}: this run cannot be resumed ({e}); choose another --out.") from None
        for k, v in state["progress"].items():
            setattr(self, k, v)


def peak_memory() -> int:
    """MB that this process has held at most; 0 where the system does not say (Windows)."""
    try:
        import resource
    except ImportError:
        return 0
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit)
