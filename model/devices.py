# SPDX-License-Identifier: GPL-3.0-or-later
"""Which device torch computes on."""

from __future__ import annotations

import torch

from ..datagen.sequence import InputError


def check_device(device: str) -> None:
    """Raises InputError where torch cannot use a device of this name on this machine."""
    try:
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as e:
        reason = str(e).splitlines()[0]
        raise InputError(f"{device}: torch cannot use this device here ({reason}); choose cpu.") from None


def fitting_device(device: str) -> str:
    """The device that scenes are fitted on: this one if it is CUDA's, else the processor; there is no rasteriser for
    others, such as Apple's. Raises InputError as `check_device` does."""
    check_device(device)
    return device if torch.device(device).type == "cuda" else "cpu"
