# SPDX-License-Identifier: GPL-3.0-or-later
"""What turns gradients into steps: AdamW as in the paper, or Muon for the matrices inside of the transformer."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import nn

from ...datagen.sequence import InputError

WEIGHT_DECAY = 0.05  # of matrices; vectors (norms) have none
LARGEST_WEIGHT = torch.finfo(torch.float16).max  # checkpoints hold half precision


@dataclass(frozen=True)
class GradientLimits:
    """Norms of the gradient of all weights together."""

    clip: float = 1.0  # longer ones are scaled to this
    skip: float = 20.0  # steps from this on are left out, once the warm-up is over


GRADIENT_LIMITS = GradientLimits()


def make_optimizers(network: nn.Module, kind: str) -> list[torch.optim.Optimizer]:
    """adamw: one AdamW (0.9, 0.95) for everything. muon: Newton-Schulz orthogonalised momentum for the blocks'
    matrices, its steps scaled to the size of AdamW's so that one rate serves both, and AdamW for the rest. Raises
    InputError where this torch has no Muon."""
    hidden = []
    if kind == "muon":
        if not hasattr(torch.optim, "Muon"):
            raise InputError(f"--optimiser muon: torch {torch.__version__} has none; install torch 2.9 or newer.")
        hidden = [p for p in network.blocks.parameters() if p.ndim == 2]
    rest = [p for p in network.parameters() if not any(p is h for h in hidden)]
    groups = [
        {"params": [p for p in rest if p.ndim > 1], "weight_decay": WEIGHT_DECAY},
        {"params": [p for p in rest if p.ndim <= 1], "weight_decay": 0.0},
    ]
    optimizers: list[torch.optim.Optimizer] = [torch.optim.AdamW(groups, betas=(0.9, 0.95))]
    if hidden:
        optimizers.append(torch.optim.Muon(hidden, weight_decay=WEIGHT_DECAY, adjust_lr_fn="match_rms_adamw"))
    return optimizers


def learning_rate(peak: float, step: int, warmup: int, progress: float) -> float:
    """Linear warm-up over `warmup` steps, then (and at once) a cosine down to 0 over progress 0..1."""
    return peak * min(1, (step + 1) / max(warmup, 1)) * 0.5 * (1 + math.cos(math.pi * min(progress, 1)))


def clip_and_step(optimizers: list[torch.optim.Optimizer], rate: float, warmed_up: bool) -> bool:
    """Clips the gradients and steps with this learning rate. Returns False, and changes no weight, where their norm is
    not finite or, once warmed up, beyond the limit. The gradients are gone either way."""
    parameters = [p for o in optimizers for group in o.param_groups for p in group["params"]]
    norm = float(nn.utils.clip_grad_norm_(parameters, GRADIENT_LIMITS.clip))
    usable = math.isfinite(norm) and (norm < GRADIENT_LIMITS.skip or not warmed_up)
    for optimizer in optimizers:
        if usable:
            for group in optimizer.param_groups:
                group["lr"] = rate
            optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    return usable


@torch.no_grad()
def weights_fit_checkpoint(network: nn.Module) -> bool:
    """Whether all weights are finite, also in the half precision of a checkpoint."""
    largest = torch.stack([torch.linalg.vector_norm(p, math.inf) for p in network.parameters()]).max()
    return float(largest) <= LARGEST_WEIGHT  # not if any is NaN
