# SPDX-License-Identifier: GPL-3.0-or-later
"""A network over Views: the geometry that it starts from, and what it makes of both."""

from __future__ import annotations

from .gaussians import Gaussians4D
from .views import Views, pad_to_multiple


def geometry_for(source: str, views: Views):
    """The Geometry that a network with this depth source ("given", "sweep" or "predicted") starts from; None for
    `predicted`."""
    if source == "given":
        from .geometry.lift import lift_geometry

        return lift_geometry(views)
    if source == "sweep":
        from .geometry.plane_sweep import sweep_geometry

        return sweep_geometry(views)
    return None


def apply_network(network, views: Views, device: str = "cpu", drop_empty=True, progress=None) -> Gaussians4D:
    """Views of any size -> what the network, which is on `device`, makes of them and of their Geometry, on the CPU.
    drop_empty: tokens only where the object is. `progress(fraction, text)` is called before each of the two."""
    report = progress or (lambda fraction, text: None)
    views = pad_to_multiple(views, network.config.patch)
    report(0.0, "looking for surfaces")
    geometry = geometry_for(network.config.source, views)
    report(0.5, "network")
    return network(views.to(device), geometry and geometry.to(device), drop_empty).to("cpu")
