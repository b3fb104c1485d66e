# SPDX-License-Identifier: GPL-3.0-or-later
"""Devices: refused in one sentence, and fits on the processor where there is no rasteriser."""

import pytest

from timesplat.datagen.sequence import InputError
from timesplat.model.devices import check_device, fitting_device


def test_a_device_that_torch_does_not_have():
    check_device("cpu")
    for check in (check_device, fitting_device):
        with pytest.raises(InputError, match=r"^nonsense: torch cannot use this device here .*; choose cpu\.$"):
            check("nonsense")


def test_scenes_are_fitted_where_there_is_a_rasteriser():
    assert fitting_device("cpu") == "cpu" and fitting_device("meta") == "cpu"  # meta stands for Apple's here
