# SPDX-License-Identifier: GPL-3.0-or-later
"""What is known of pixels before any network: depth, motion, coverage; from renderers' passes or photographs."""
