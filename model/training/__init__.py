# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of the network on rendered clips. Nothing that reconstructs imports it."""
