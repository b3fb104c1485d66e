# SPDX-License-Identifier: GPL-3.0-or-later
"""Procedural animated objects, drawn from a seed: training data that needs no licence and no download."""
