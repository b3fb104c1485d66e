# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the CPU backend's kernels find what in the arrays that they hand on, and the numbers that they share."""

from __future__ import annotations

import math

from numpy import float32

from ..constants import ALPHA_MIN

TILE = 64  # pixels a side
LOG2E = math.log2(math.e)
LOG_ALPHA_MIN = float32(math.log2(ALPHA_MIN))  # to base 2, as all logarithms of alpha

# One row per Gaussian that a view shows, in the order of the input. (u, v) = L d whitens the pixel offset d = (dx, dy),
# L = [[UX, UY], [0, VY]], scaled so that alpha = 2^(LOG - u² - v²). INVERSE = 1 / UX; SLOPE = UY / UX.
# REACH: half sides of the box where alpha >= 1/255; TILT: dy of its rightmost point. Then the depth.
MX, MY, UX, UY, VY, LOG, RED, GREEN, BLUE, REACH_X, REACH_Y, TILT, INVERSE, SLOPE, DEPTH = range(15)
PARAMS = 16
# Sums over pixels, per (tile, Gaussian) pair: d/d(r, g, b), then of h = dL/d(ln alpha) the moments in u and v.
H, HU, HV, HUU, HUV, HVV = range(3, 9)
SUMS = 9
