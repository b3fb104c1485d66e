# SPDX-License-Identifier: GPL-3.0-or-later
"""Side wing: methods scored, compared and drawn. It may import everything; nothing imports it but the command line."""
