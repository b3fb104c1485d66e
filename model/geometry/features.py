# SPDX-License-Identifier: GPL-3.0-or-later
"""What a network is told of pixels before it runs: Gaussians to start from, and named features as input channels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..gaussians import Gaussians4D
from ..layout import Layout

# The order is that of the checkpoints' weights.
LIFT_FEATURES = Layout({
    "distance": 1,  # along the ray, scaled
    "normal": 3,  # unit, world, towards the camera
    "motion": 3,  # world, at the view's own time, scaled
    "frames_before": 1,  # that the point is needed before its view's time, scaled
    "frames_after": 1,
    "agreeing_views": 1,  # how many saw the point where its track says, scaled
    "contradicted": 1,  # 1 where a view saw through it
    "alpha": 1,
})  # fmt: skip
SWEEP_FEATURES = Layout({
    "distance": 1,  # as above
    "spread": 1,  # standard deviation of the planar depth, normalised units
    "certainty": 1,  # 0..1, of the depth
    "alpha": 1,
    "lifetime": 1,  # frames that what the view sees must live, scaled
    "normal": 3,  # as above, as the next three
    "edge_offset": 1,  # 0 in the middle of the silhouette, 1 at its rim
    "frames_before": 1,
    "frames_after": 1,
    "agreeing_views": 1,
})  # fmt: skip
LAYOUTS = {"given": LIFT_FEATURES, "sweep": SWEEP_FEATURES}  # by a network's source of distance


@dataclass(frozen=True)
class FeatureScales:
    """Bring features to about -1..1."""

    distance: float = 2.7  # of a camera from the object's middle: there the feature is 0
    motion: float = 0.3  # factor of motion per unit of model time
    count: float = 0.25  # factor of frames and views


SCALES = FeatureScales()


@dataclass
class Features:
    """Extra input channels of V views."""

    values: Tensor  # (V,H,W,layout.width), zero where nothing is known
    layout: Layout

    @staticmethod
    def build(layout: Layout, valid: Tensor, **channels: Tensor) -> Features:
        """valid (V,H,W) bool with n pixels set; every channel of the layout by name, (n,) or (n,C) of these
        pixels."""
        values = torch.zeros(*valid.shape, layout.width)
        values[valid] = layout.join(**channels)
        return Features(values, layout)

    def __getitem__(self, name: str) -> Tensor:
        """(V,H,W), or (V,H,W,C) where the feature has several channels."""
        return self.layout.split(self.values)[name]

    def to(self, device) -> Features:
        return Features(self.values.to(device), self.layout)


@dataclass
class Geometry:
    """What is known of the pixels of V views before the network."""

    gaussians: Gaussians4D  # (M,) one or several per valid pixel: the pieces of its point's track
    pixel_index: Tensor  # (M,) the pixel that each belongs to, as an index into V·H·W, ascending
    max_shift: Tensor  # (V,H,W) how far along its ray the network may move it, normalised units
    features: Features  # of the V views

    def to(self, device) -> Geometry:
        return Geometry(*(x.to(device) for x in vars(self).values()))


def scaled_distance(distance: Tensor) -> Tensor:
    """distance (…) along a ray, normalised units -> (…) the feature: 0 at the object's middle, -1 at the camera."""
    return distance / SCALES.distance - 1
