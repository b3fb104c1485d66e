# SPDX-License-Identifier: GPL-3.0-or-later
"""The differentiable rasteriser of 4D Gaussians: one function, `render`; backends for the CPU and for CUDA, and a slow
reference in which what is computed is written down (reference.py).

Every backend is a module with the function `rasterize(gaussians, cameras, options)`, where the Gaussians are a
Gaussians4D without batch dimensions and the rest is in inputs.py -> rgb (C,height,width,3), alpha (C,height,width).
"""

from .render import BACKENDS as BACKENDS
from .render import render as render
