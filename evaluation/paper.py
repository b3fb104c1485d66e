# SPDX-License-Identifier: GPL-3.0-or-later
"""Figures of the paper (4D-LRM, 2025) that the studies set beside their own: PSNR, LPIPS, SSIM as printed."""

# Table 3, varying views per frame: (inputs, views a frame, model) -> Objaverse4D (Test), Consistent4D (re-rendered)
VIEWS_PER_FRAME = {
    ("random", 1, "GS-LRM"): ((18.738, 0.165, 0.852), (17.201, 0.166, 0.846)),
    ("random", 1, "4D-LRM"): ((28.343, 0.040, 0.964), (30.513, 0.036, 0.972)),
    ("random", 2, "GS-LRM"): ((22.252, 0.105, 0.898), (22.425, 0.097, 0.904)),
    ("random", 2, "4D-LRM"): ((28.622, 0.051, 0.957), (30.601, 0.035, 0.973)),
    ("random", 3, "GS-LRM"): ((24.381, 0.083, 0.917), (24.661, 0.079, 0.924)),
    ("random", 3, "4D-LRM"): ((28.212, 0.052, 0.954), (30.554, 0.035, 0.972)),
    ("random", 4, "GS-LRM"): ((26.118, 0.070, 0.933), (26.126, 0.070, 0.935)),
    ("random", 4, "4D-LRM"): ((27.940, 0.053, 0.953), (30.445, 0.034, 0.972)),
    ("canonical", 4, "GS-LRM"): ((28.710, 0.047, 0.962), (30.067, 0.038, 0.967)),
    ("canonical", 4, "4D-LRM"): ((27.839, 0.055, 0.952), (30.850, 0.039, 0.968)),
}

# Appendix, GSO (static objects, times collapsed): (pixels, model) -> PSNR, LPIPS, SSIM
STATIC = {
    (512, "SparseNeuS"): (20.62, 0.199, 0.836),
    (512, "Triplane-LRM"): (26.54, 0.064, 0.893),
    (512, "Mesh-LRM"): (27.93, 0.081, 0.925),
    (512, "GS-LRM"): (30.52, 0.050, 0.952),
    (256, "LGM"): (21.44, 0.122, 0.832),
    (256, "GS-LRM"): (29.59, 0.051, 0.944),
    (256, "4D-LRM"): (27.35, 0.061, 0.929),
}

# Table 4, 4D generation on the original Consistent4D benchmark; the last one is given the true views of frame 1.
VIDEO = {
    "4D-LRM-Large": (20.094, 0.138, 0.885),
    "4D-LRM-Free": (23.777, 0.117, 0.916),
    "4D-LRM-Free, true first frame": (26.118, 0.055, 0.947),
}
