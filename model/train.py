# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of the network on rendered clips: `timesplat train DATA… --out RUN`.

A RUN folder holds `log.jsonl` (a line per report), `state.pt` (all that an exact resume needs) and
`network.safetensors` (the averaged weights, ready for `--checkpoint`). Calling it again goes on.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import time
from dataclasses import replace

import numpy as np
import torch
from tqdm import tqdm

from ..datagen.sequence import InputError
from .data import Clips, Sample
from .gaussians import Gaussians4D
from .lift import lift_geometry
from .losses import geometric, photometric
from .network import PRESETS, Network, load_matching
from .rasterize import render
from .reconstruct import check_device, geometry_for, load_network, save_network

WARMUP = 100  # steps of linear warm-up
EMA = 0.998  # per step; the shipped weights are this average
CLIP = 1.0  # gradient norm; steps beyond 20 times that are skipped


def run(args: argparse.Namespace) -> int:
    """Trains as the arguments of `timesplat train` say (see cli.py); returns 0."""
    check_device(args.device)
    clips = Clips(args.data, args.cache, args.shrink)
    chosen = {k: getattr(args, k) for k in ("head", "source", "depth_range", "time", "free")}
    config = replace(PRESETS[args.preset], **chosen)
    torch.manual_seed(args.seed)
    network = Network(config)
    if args.init:
        load_matching(network, load_network(args.init))
    Trainer(network.to(args.device), clips, args).run()
    return 0


class Trainer:
    """The state of a run: network, average, optimiser, and how far it has come."""

    def __init__(self, network: Network, clips: Clips, args: argparse.Namespace):
        self.network, self.clips, self.args = network, clips, args
        self.average = {k: v.detach().clone() for k, v in network.state_dict().items()}
        matrices = [p for p in network.parameters() if p.ndim > 1]
        others = [p for p in network.parameters() if p.ndim <= 1]
        groups = [{"params": matrices, "weight_decay": 0.05}, {"params": others, "weight_decay": 0.0}]
        self.optimiser = torch.optim.AdamW(groups, lr=args.rate, betas=(0.9, 0.95))
        self.step, self.seconds, self.skipped = 0, 0.0, 0
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
        """Trains to the end; an interrupt (Ctrl-C) ends it after the step at hand, with the state saved."""
        previous = signal.signal(signal.SIGINT, lambda *_: setattr(self, "stopped", True))
        try:
            self._loop()
        finally:
            signal.signal(signal.SIGINT, previous)
        if self.stopped:
            raise KeyboardInterrupt

    def _loop(self) -> None:
        args, start, base = self.args, time.perf_counter(), self.seconds
        bar = tqdm(
            total=1.0, disable=None, bar_format="{l_bar}{bar}| {elapsed}<{remaining}{postfix}", desc=args.out.name
        )
        recent: list[tuple[float, float]] = []
        shares = np.zeros(4)
        while self.progress() < 1 and not self.stopped:
            recent.append(self.train_step(shares))
            self.seconds = base + time.perf_counter() - start
            if self.step % 20 == 0:
                loss, psnr = np.mean(recent, axis=0)
                rate = len(recent) * args.accumulate / max(shares.sum(), 1e-9)
                split = dict(
                    zip(("data", "geometry", "network", "raster"), (shares / shares.sum()).round(2), strict=True)
                )
                line = {"step": self.step, "seconds": round(self.seconds), "loss": round(float(loss), 5)}
                line |= {
                    "psnr": round(float(psnr), 3),
                    "samples_per_s": round(rate, 2),
                    "skipped": self.skipped,
                }
                with open(args.out / "log.jsonl", "a") as f:
                    f.write(json.dumps(line | {"share": {k: float(v) for k, v in split.items()}}) + "\n")
                bar.set_postfix_str(f" step {self.step} loss {loss:.4f} psnr {psnr:.2f} {rate:.2f} samples/s")
                recent, shares = [], np.zeros(4)
            bar.update(self.progress() - bar.n)
            if self.step % 200 == 0:
                self.save()
        self.save()
        bar.close()

    def train_step(self, shares: np.ndarray) -> tuple[float, float]:
        """One optimiser step over `accumulate` samples -> mean loss and PSNR of the targets. Seeded by the
        step's number, so that a resumed run draws what an unbroken one would have."""
        args = self.args
        rng = np.random.default_rng((args.seed, self.step))
        self.network.train()
        losses, scores = [], []
        for _ in range(args.accumulate):
            clock = [time.perf_counter()]
            sample = self.clips.sample(rng, args.targets, args.views)
            clock.append(time.perf_counter())
            loss, score, clock2 = self.sample_loss(sample, rng)
            (loss / args.accumulate).backward()
            clock += [*clock2, time.perf_counter()]
            spent = np.diff(clock)  # the backward pass is split in the forward's proportion
            forward = spent[2] + spent[3]
            shares += [spent[0], spent[1], *(spent[2:4] * (1 + spent[4] / max(forward, 1e-9)))]
            losses.append(float(loss.detach()))
            scores.append(score)
        norm = float(torch.nn.utils.clip_grad_norm_(self.network.parameters(), CLIP))
        rate = args.rate * min(1, (self.step + 1) / WARMUP) * 0.5 * (1 + math.cos(math.pi * min(self.progress(), 1)))
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        if math.isfinite(norm) and (norm < 20 * CLIP or self.step < WARMUP):
            self.optimiser.step()
        else:
            self.skipped += 1
        self.optimiser.zero_grad(set_to_none=True)
        self.step += 1
        decay = min(EMA, self.step / (self.step + 10))
        for k, v in self.network.state_dict().items():
            self.average[k].lerp_(v, 1 - decay)
        return float(np.mean(losses)), float(np.mean(scores))

    def sample_loss(self, sample: Sample, rng: np.random.Generator):
        """-> loss, PSNR of the target views over white, and the times at which stages ended."""
        args, network = self.args, self.network
        geometry = geometry_for(network.config.source, sample.inputs)
        truth = None
        if args.geometric and network.config.source != "given":
            truth = [x.to(args.device) for x in self.pixel_truth(sample.inputs, geometry)]
        inputs, targets = sample.inputs.to(args.device), sample.targets.to(args.device)
        geometry = geometry and geometry.to(args.device)
        clock = [time.perf_counter()]
        with torch.autocast(args.device.split(":")[0], torch.bfloat16, enabled=args.bf16):
            g = network(inputs, geometry)
        clock.append(time.perf_counter())
        background = torch.tensor(rng.uniform(0, 1, 3) if rng.random() < 0.5 else np.ones(3)).float().to(args.device)
        height, width = targets.size
        rgb, alpha = render(g, targets.c2w, targets.intrinsics, targets.time, width, height, background=background)
        loss = photometric(rgb, alpha, targets, background)
        if truth is not None:
            weight = args.geometric * (1 - 0.9 * min(1, 2 * self.progress()))
            loss = loss + weight * geometric(g[: len(truth[0])], *truth)
        clock.append(time.perf_counter())
        with torch.no_grad():
            mse = (rgb - targets.over(background)).square().mean((1, 2, 3)).clamp_min(1e-10)
            score = float((-10 * torch.log10(mse)).mean())
        return loss, score, clock

    def pixel_truth(self, inputs, geometry) -> tuple[torch.Tensor, Gaussians4D, torch.Tensor]:
        """For each of the network's Gaussians: the time of its view, what the lift of the renderer's depth says
        of its pixel, and whether that is known."""
        truth = lift_geometry(inputs)
        if geometry is not None:
            owner = geometry.owner
        else:
            row = self.network.rows(inputs, self.network.kept_patches(inputs))
            kept = (row >= 0).nonzero()[:, 0]
            owner = kept[torch.argsort(row[kept])]
        view_time = inputs.time[:, None, None].expand_as(inputs.alpha).flatten()
        away = (truth.gaussians.t - view_time[truth.owner]).abs()
        order = torch.argsort(away, descending=True, stable=True)
        piece = torch.full((len(view_time),), -1)
        piece.numpy()[truth.owner[order].numpy()] = order.numpy()  # of a pixel's pieces the one of its own time
        return view_time[owner], truth.gaussians[piece[owner]], piece[owner] >= 0

    def save(self) -> None:
        state = {
            "network": self.network.state_dict(),
            "average": self.average,
            "optimiser": self.optimiser.state_dict(),
            "progress": {"step": self.step, "seconds": self.seconds, "skipped": self.skipped},
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
            self.average = state["average"]
            self.optimiser.load_state_dict(state["optimiser"])
        except Exception as e:
            raise InputError(f"{self.state}: this run cannot be resumed ({e}); choose another --out.") from None
        for k, v in state["progress"].items():
            setattr(self, k, v)
