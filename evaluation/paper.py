# SPDX-License-Identifier: GPL-3.0-or-later
"""Figures of the paper (4D-LRM, 2025) that tables and studies set beside their own: PSNR, LPIPS, SSIM as printed."""

from __future__ import annotations

from .protocol import TABLE

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

# The paper's tables 1 and 2: resolution | model | initialised from GS-LRM | PSNR LPIPS SSIM of each of TABLE.
CONSISTENT4D = """
128|4D-LRM-Base|No|29.233 0.047 0.961 29.194 0.047 0.961 25.014 0.071 0.926 25.788 0.081 0.926
128|4D-LRM-Large|No|30.274 0.038 0.969 30.260 0.038 0.969 25.904 0.061 0.935 26.525 0.070 0.934
128|4D-LRM-Large|Yes|31.023 0.031 0.974 30.917 0.031 0.973 28.703 0.042 0.959 28.789 0.049 0.957
256|SoM|-|25.586 0.055 0.906 - - - 22.756 0.089 0.941 17.637 0.208 0.875
256|GS-LRM (Per Fr.)|-|19.327 0.097 0.902 - - - 20.037 0.094 0.935 16.826 0.212 0.801
256|GS-LRM (All in)|-|21.606 0.086 0.925 21.590 0.086 0.925 20.641 0.100 0.909 19.665 0.132 0.897
256|4D-LRM-Base|No|27.443 0.062 0.952 27.394 0.062 0.953 23.429 0.088 0.918 23.882 0.096 0.916
256|4D-LRM-Large|No|27.860 0.049 0.959 27.822 0.048 0.959 25.095 0.069 0.934 25.776 0.073 0.934
256|4D-LRM-Free|Yes|30.396 0.036 0.973 30.376 0.036 0.973 26.184 0.061 0.943 26.337 0.067 0.939
256|4D-LRM-Large|Yes|32.177 0.028 0.980 32.145 0.028 0.980 27.664 0.050 0.957 27.990 0.057 0.954
"""
OBJAVERSE4D = """
128|4D-LRM-Base|No|27.374 0.068 0.937 27.287 0.068 0.937 25.496 0.075 0.924 24.174 0.112 0.893
128|4D-LRM-Large|No|28.489 0.055 0.949 28.440 0.055 0.949 26.312 0.064 0.934 25.023 0.096 0.905
128|4D-LRM-Large|Yes|29.251 0.042 0.959 29.169 0.043 0.958 28.676 0.043 0.957 27.586 0.064 0.939
256|GS-LRM (Per Frame)|-|18.796 0.164 0.854 - - - 19.729 0.143 0.911 18.300 0.176 0.845
256|GS-LRM (All in)|-|19.388 0.138 0.888 19.412 0.139 0.888 19.428 0.138 0.888 19.379 0.138 0.888
256|4D-LRM-Base|No|25.806 0.085 0.928 25.711 0.085 0.929 23.974 0.085 0.924 22.409 0.125 0.889
256|4D-LRM-Large|No|26.658 0.066 0.942 26.580 0.066 0.942 25.524 0.067 0.937 24.461 0.095 0.913
256|4D-LRM-Free|Yes|28.838 0.050 0.958 28.790 0.051 0.958 26.998 0.056 0.949 25.267 0.082 0.923
256|4D-LRM-Large|Yes|30.094 0.041 0.967 30.028 0.042 0.967 27.810 0.049 0.957 26.694 0.072 0.939
"""
TABLES = {"Consistent4D, re-rendered": CONSISTENT4D, "Objaverse4D (Test)": OBJAVERSE4D}


def paper_rows(text: str) -> list[tuple[int, str, str, dict[str, dict[str, float]]]]:
    """-> (resolution, model, initialised, {setup: {psnr, lpips, ssim}}) of every row; a setup without figures
    is missing."""
    rows = []
    for line in text.strip().splitlines():
        size, model, initialised, figures = line.split("|")
        values = figures.split()
        triples = {s: values[3 * i : 3 * i + 3] for i, s in enumerate(TABLE)}
        known = {
            s: dict(zip(("psnr", "lpips", "ssim"), map(float, v), strict=True))
            for s, v in triples.items()
            if v[0] != "-"
        }
        rows.append((int(size), model, initialised, known))
    return rows
