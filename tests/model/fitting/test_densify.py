# SPDX-License-Identifier: GPL-3.0-or-later
"""Densification: the faint and the lost go, the hardest pulled are split in place, and never too many are made."""

import pytest
import torch

from timesplat.model.fitting.densify import EVERY, FAINT, SHARE, Densifier, Pace, densify
from timesplat.model.fitting.parameters import RATES, Parameters, activate


@pytest.fixture
def parameters():
    n = 100
    one, three = torch.zeros(n), torch.zeros(n, 3)
    raw = {"xyz": three, "t": one, "velocity": three, "sigma_t": one, "scale": three - 4.0}
    raw |= {"rotation": torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), "rgb": three, "opacity": one}
    return Parameters(raw, RATES)


def test_who_goes_and_who_is_split(parameters):
    p = parameters
    with torch.no_grad():
        p["opacity"][:10] = torch.tensor(0.5 * FAINT).logit()
        p["xyz"][10:20] = 3.0
    densify(p, torch.arange(100.0), torch.Generator().manual_seed(0), 1000)
    count = int(80 * SHARE)
    assert len(p["xyz"]) == 80 + count
    scale = activate(p.values).scale[:, 0]
    assert (scale < 0.7 * scale.max()).nonzero()[:, 0].tolist() == [*range(80 - count, 80 + count)]
    split = p["xyz"][80 - count : 80].detach().flip(0)  # the hardest pulled first
    torch.testing.assert_close(split, -p["xyz"][80:].detach())  # apart, about where they were
    assert split.abs().max() > 0


def test_the_limit_is_kept_and_gradients_add_up_in_between(parameters):
    p = parameters
    densifier = Densifier(p, torch.Generator().manual_seed(0), max_gaussians=101)
    for step in range(1, EVERY + 1):
        (p["xyz"].sum() * (step == 3)).backward()
        densifier.after_backward(step, 0.1)
        assert len(p["xyz"]) == (101 if step == EVERY else 100)
        if 3 <= step < EVERY:
            torch.testing.assert_close(densifier.grad_accum, torch.full((100,), 3**0.5))
        p["xyz"].grad = None
    assert densifier.grad_accum.tolist() == [0.0] * 101


def test_an_even_pace_leads_to_the_most_by_its_end(parameters):
    p, pace = parameters, Pace(every=10, since=0.2, until=0.6, share=None)
    densifier = Densifier(p, torch.Generator().manual_seed(0), 400, pace)
    counts = []
    for step in range(1, 201):
        p["xyz"].sum().backward()
        changed = densifier.after_backward(step, step / 200)
        assert changed == (step % 10 == 0 and 0.2 <= step / 200 < 0.6)
        counts.append(len(p["xyz"]))
        p["xyz"].grad = None
    assert counts[38] == 100 and 100 < counts[70] < 400 and counts[-1] == 400
