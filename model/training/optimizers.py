# SPDX-License-Identifier: GPL-3.0-or-later
"""What turns gradients into steps: AdamW as in the paper, or Muon for the matrices inside of the transformer."""

from __future__ import annotations

import math

import torch
from torch import nn

from ...datagen.sequence import InputError

KINDS = ("adamw", "muon")
CLIP = 1.0  # gradient norm; steps beyond 20 times that are skipped
LARGEST = torch.finfo(torch.float16).max  # weight: checkpoints hold half precision
DECAY = 0.05  # weight decay of matrices; vectors (norms) have none


def make_optimisers(network: nn.Module, kind: str) -> list[torch.optim.Optimizer]:
    """adamw: one AdamW (0.9, 0.95) for everything. muon: Newton-Schulz orthogonalised momentum for the blocks'
    matrices, its steps scaled to the size of AdamW's so that one rate serves both, and AdamW for the rest."""
    hidden = []
    if kind == "muon":
        if not hasattr(torch.optim, "Muon"):
            raise InputError(f"--optimiser muon: torch {torch.__version__} has none; install torch 2.9 or newer.")
        hidden = [p for p in network.blocks.parameters() if p.ndim == 2]
    rest = [p for p in network.parameters() if not any(p is h for h in hidden)]
    groups = [
        {"params": [p for p in rest if p.ndim > 1], "weight_decay": DECAY},
        {"params": [p for p in rest if p.ndim <= 1], "weight_decay": 0.0},
    ]
    found: list[torch.optim.Optimizer] = [torch.optim.AdamW(groups, betas=(0.9, 0.95))]
    if hidden:
        found.append(torch.optim.Muon(hidden, weight_decay=DECAY, adjust_lr_fn="match_rms_adamw"))
    return found


def learning_rate(peak: float, step: int, warmup: int, progress: float) -> float:
    """Linear warm-up over `warmup` steps, then (and at once) a cosine down to 0 over progress 0..1."""
    return peak * min(1, (step + 1) / max(warmup, 1)) * 0.5 * (1 + math.cos(math.pi * min(progress, 1)))


def take_step(optimisers: list[torch.optim.Optimizer], rate: float, warm: bool) -> bool:
    """Clips the gradients to a norm of CLIP and steps. Returns False, and changes no weight, where the norm is not
    finite or, once `warm`, beyond 20 times CLIP. The gradients are gone either way."""
    parameters = [p for o in optimisers for group in o.param_groups for p in group["params"]]
    norm = float(nn.utils.clip_grad_norm_(parameters, CLIP))
    sound = math.isfinite(norm) and (norm < 20 * CLIP or not warm)
    for optimiser in optimisers:
        if sound:
            for group in optimiser.param_groups:
                group["lr"] = rate
            optimiser.step()
        optimiser.zero_grad(set_to_none=True)
    return sound


@torch.no_grad()
def sound_weights(network: nn.Module) -> bool:
    """Whether all weights are finite, also once they are in a checkpoint."""
    greatest = torch.stack([torch.linalg.vector_norm(p, math.inf) for p in network.parameters()]).max()
    return float(greatest) <= LARGEST  # not if any is NaN
