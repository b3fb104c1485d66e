# SPDX-License-Identifier: GPL-3.0-or-later
"""Shared by the rasteriser's tests."""

import pytest
import torch


@pytest.fixture(autouse=True)
def one_thread():
    """The reference's small tensors are not worth torch's threads, which on a busy machine cost seconds."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
