# SPDX-License-Identifier: GPL-3.0-or-later
"""The CPU backend: compiled by numba, parallel over views and tiles, a block of 8 or 16 pixels at a time.

Per view: cull by time, opacity and depth and project the survivors (project.py); sort them by depth and bin them into
tiles (tiles.py); blend every tile front to back (blend.py). The backward pass walks the tile lists back to front
(blend.py) and goes from pixels back to the inputs by the chain rule (chain_rule.py). Every (tile, Gaussian) pair owns
one row of a gradient buffer, and they are summed in a fixed order: no atomics, and the same bits on every run and for
any number of threads.
"""

from .autograd import rasterize as rasterize
