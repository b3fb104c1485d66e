# SPDX-License-Identifier: GPL-3.0-or-later
"""The limits that all backends share, those of gsplat's "classic" mode, so that a model trained with one renders the
same with another; and the paper's inference filter."""

NEAR_PLANE = 0.01  # nearest depth of a centre
BLUR = 0.1  # px², added to the 2D covariance's diagonal: about what a pixel averages over (3DGS adds 0.3)
WIDER = 0.3  # px: σ by which what was found, or learnt, with 0.3 px² is widened, to look as it did or a little sharper
SLOPE_MARGIN = 0.3  # the Jacobian's slopes are clamped to the image widened by this share of half its size
ALPHA_MIN, ALPHA_MAX = 1 / 255, 0.999  # fainter is not drawn, denser is clamped
TRANSMITTANCE_MIN = 1e-4  # a pixel stops before its transmittance gets this low
INFERENCE_MIN = 0.05  # what the marginal and the weighted opacity must reach for inference (paper, appendix A.2)
