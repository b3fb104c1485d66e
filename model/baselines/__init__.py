# SPDX-License-Identifier: GPL-3.0-or-later
"""What the network is measured against, each from the same Views and through the same evaluator.

`hull.py` costs nothing (`white`, `hull`); `gs_lrm.py` is a network that knows no time; `four_dgs.py` and
`som.py` fit one scene at a time, on the loop of `model/fitting/loop.py`.
"""
