# SPDX-License-Identifier: GPL-3.0-or-later
"""One canonical cloud of Gaussians moved by control points, fitted to pictures alone."""
