# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat stress`: where methods fail, on scenes and inputs whose difficulty is one number each."""
