# SPDX-License-Identifier: GPL-3.0-or-later
"""Which rendered Sequences to train on, and as what: measured, decided, shown, and put right by hand."""
