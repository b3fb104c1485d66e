# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians fitted to pictures by gradient descent: the loop, refinement, merging and budgets."""
