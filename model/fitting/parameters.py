# SPDX-License-Identifier: GPL-3.0-or-later
"""What gradient descent changes: raw tensors with Adam's moments, and the Gaussians that raw tensors stand for."""

from __future__ import annotations

import math
from collections.abc import Collection

import numba
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..gaussians import Gaussians4D
from ..parallel import chunks, parallel_for

BETAS, EPSILON = (0.9, 0.99), 1e-10  # Adam's; a shorter memory than usual, for hundreds of steps
CHUNK = 1 << 16  # entries that a thread takes at once
LONG = 1000  # steps, beyond which the last rates of what settles are the lower
# Learning rates of Gaussians that are free to go anywhere, at the start and at the end of a fit.
RATES = {
    "xyz": (4e-3, 4e-4),
    "t": (2e-3, 2e-4),
    "velocity": (1e-2, 1e-3),
    "sigma_t": (1e-2, 1e-3),
    "scale": (2e-2, 5e-3),
    "rotation": (1e-2, 2e-3),
    "rgb": (2e-2, 4e-3),
    "opacity": (1e-1, 2e-2),
}


class Parameters:
    """Raw tensors by name, each with Adam's moments beside and a learning rate that decays exponentially. Rows can be
    added and taken away between steps.

    `parameters[name]` is the leaf that gradients reach."""

    def __init__(
        self,
        values: dict[str, Tensor],
        rates: dict[str, tuple[float, float]],
        common: Collection[str] = (),
        settling: Collection[str] = (),
        seldom: float = 0.0,
    ):
        """values: name -> tensor of any shape; rates: name -> learning rate at the start and at the end of the
        budget. common: names of what has no row for each Gaussian: `keep_rows` and `reset_moments` leave it alone.
        settling: names of what comes to rest in a long fit: beyond LONG steps its last rate falls as one over them.
        seldom: what is added to the divisor of Adam's steps, times a tensor's typical gradient (root mean square):
        entries that views hardly speak of, such as those of what is hidden, then move little, not as fast as all."""
        self.rates, self.common, self.settling = rates, frozenset(common), frozenset(settling)
        self.seldom = seldom
        self.values = {k: v.detach().clone().requires_grad_() for k, v in values.items()}
        self.moments = {k: (torch.zeros_like(v), torch.zeros_like(v)) for k, v in self.values.items()}
        self.steps = 0

    def __getitem__(self, name: str) -> Tensor:
        return self.values[name]

    @torch.no_grad()
    def step(self, fraction: float, steps: int = 0) -> None:
        """One step of Adam (Kingma and Ba 2015) along the gradients, `fraction` 0..1 of the budget being spent, which
        is so many `steps` in all, where that is known. Entries whose gradient is not finite count as 0."""
        self.steps += 1
        a, b = BETAS
        for k, v in self.values.items():
            first, last = self.rates[k]
            if k in self.settling:
                last *= LONG / max(steps, LONG)
            if v.grad is None or first == 0:
                continue
            (m, s), rate = self.moments[k], first * (last / first) ** fraction / (1 - a**self.steps)
            if v.device.type == "cpu" and v.dtype == torch.float32 and v.is_contiguous():
                flat = [x.detach().reshape(-1).numpy() for x in (v, v.grad, m, s)]  # of a gradient it may be a copy
                bias, least = 1 - b**self.steps, EPSILON
                if self.seldom:
                    now = np.square(np.nan_to_num(flat[1], nan=0, posinf=0, neginf=0)).mean()
                    least += self.seldom * math.sqrt((b * flat[3].mean() + (1 - b) * now) / bias)
                jobs = chunks(v.numel(), CHUNK)
                parallel_for(jobs, lambda i, j, x=flat, r=rate, c=bias, e=least: _adam(i, j, *x, r, c, e))
            else:
                g = v.grad.nan_to_num_(0, 0, 0)
                m.lerp_(g, 1 - a)
                s.mul_(b).addcmul_(g, g, value=1 - b)
                root, least = (s / (1 - b**self.steps)).sqrt_(), EPSILON
                if self.seldom:
                    least += self.seldom * root.square().mean().sqrt()
                v.addcdiv_(m, root.add_(least), value=-rate)
            v.grad = None

    @torch.no_grad()
    def keep_rows(self, keep: Tensor) -> None:
        """Keeps the rows `keep` ((K,) indices, repeats allowed, or a mask (N,)) of every tensor, with their gradients
        and moments."""
        for k, old in list(self.values.items()):
            if k in self.common:
                continue
            self.values[k] = old.detach()[keep].clone().requires_grad_()
            self.values[k].grad = None if old.grad is None else old.grad[keep]
            self.moments[k] = tuple(m[keep].clone() for m in self.moments[k])

    @torch.no_grad()
    def add_rows(self, new: dict[str, Tensor]) -> None:
        """Adds rows to every tensor that is not common, with gradients (where there are any) and moments of 0."""
        for k, rows in new.items():
            old, none = self.values[k], torch.zeros_like(rows)
            self.values[k] = torch.cat([old.detach(), rows]).requires_grad_()
            self.values[k].grad = None if old.grad is None else torch.cat([old.grad, none])
            self.moments[k] = tuple(torch.cat([m, none]) for m in self.moments[k])

    def replace(self, name: str, value: Tensor) -> None:
        """Puts other values in the place of those of this name; of any shape, with moments of 0 and no gradient."""
        self.values[name] = value.detach().clone().requires_grad_()
        self.moments[name] = (torch.zeros_like(value), torch.zeros_like(value))

    @torch.no_grad()
    def reset_moments(self, rows: Tensor) -> None:
        """Sets Adam's moments of these rows ((K,) indices or mask (N,)) to 0, as for newly made ones."""
        for name in self.moments.keys() - self.common:
            for m in self.moments[name]:
                m[rows] = 0


@numba.njit(cache=True, nogil=True)
def _adam(begin, end, value, gradient, mean, square, rate, bias, least):
    """Adam's step of the entries begin..end of flat arrays, in one pass over them."""
    a, b = np.float32(1 - BETAS[0]), np.float32(1 - BETAS[1])
    rate, bias, least = np.float32(rate), np.float32(1 / bias), np.float32(least)
    for i in range(begin, end):
        g = gradient[i]
        g = g if np.isfinite(g) else np.float32(0)
        mean[i] += a * (g - mean[i])
        square[i] += b * (g * g - square[i])
        value[i] -= rate * mean[i] / (np.sqrt(square[i] * bias) + least)


def activate(raw: dict[str, Tensor]) -> Gaussians4D:
    """Raw parameters, named and shaped as the fields of Gaussians4D (N,…), -> Gaussians (N,)."""
    return Gaussians4D(
        xyz=raw["xyz"],
        t=raw["t"],
        velocity=raw["velocity"],
        sigma_t=raw["sigma_t"].exp(),
        scale=raw["scale"].exp(),
        rotation=F.normalize(raw["rotation"], dim=-1),
        rgb=raw["rgb"],
        opacity=torch.sigmoid(raw["opacity"]),
    )


def raw_parameters(g: Gaussians4D, min_sigma_t: float = 1e-6, fade: float = 1.0) -> dict[str, Tensor]:
    """Gaussians (N,) -> the raw parameters of which `activate` makes them; σ_t is raised to `min_sigma_t`, opacity
    multiplied by `fade` and kept within 0.01..0.99."""
    return {
        "xyz": g.xyz,
        "t": g.t,
        "velocity": g.velocity,
        "sigma_t": g.sigma_t.clamp_min(min_sigma_t).log(),
        "scale": g.scale.clamp_min(1e-6).log(),
        "rotation": g.rotation,
        "rgb": g.rgb,
        "opacity": (fade * g.opacity).clamp(0.01, 0.99).logit(),
    }
