# SPDX-License-Identifier: GPL-3.0-or-later
"""Quaternions against matrices, and the closed form of eigenvectors against LAPACK's."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import normalize

from timesplat.model.rotations import (
    eigh3,
    isoclinic_rotation,
    quaternion_from_matrix,
    quaternion_multiply,
    rotation_matrix,
    scale_rotation_from_covariance,
)


def test_isoclinic_rotation_is_the_papers_matrix_product():
    """Entry by entry for q_l = i/√2 + 1/√2 and q_r = j: worked out by hand from the printed matrices."""
    h = 0.5**0.5
    R = isoclinic_rotation(torch.tensor([h, h, 0, 0]), torch.tensor([0.0, 0, 1, 0]))
    L = torch.tensor([[h, -h, 0, 0], [h, h, 0, 0], [0, 0, h, -h], [0, 0, h, h]])
    right = torch.tensor([[0.0, 0, -1, 0], [0, 0, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]])
    torch.testing.assert_close(R, L @ right)


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_quaternion_inverts_rotation_matrix(seed):
    q = normalize(torch.randn(8, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)), dim=-1)
    back = quaternion_from_matrix(rotation_matrix(q))
    torch.testing.assert_close((back * q).sum(-1).abs(), torch.ones(8, dtype=q.dtype))


@pytest.mark.parametrize("q", [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0.5, 0.5, -0.5, 0.5]])
def test_quaternion_of_half_turns(q):
    q = torch.tensor(q, dtype=torch.float64)
    torch.testing.assert_close(
        (quaternion_from_matrix(rotation_matrix(q)) * q).sum().abs(), torch.ones((), dtype=q.dtype)
    )


def test_quaternion_product_turns_first_by_the_second():
    a, b = normalize(torch.randn(2, 7, 4, dtype=torch.float64), dim=-1)
    torch.testing.assert_close(rotation_matrix(quaternion_multiply(a, b)), rotation_matrix(a) @ rotation_matrix(b))


def test_scale_and_rotation_rebuild_the_covariance():
    generator = torch.Generator().manual_seed(0)
    axes = rotation_matrix(normalize(torch.randn(100, 4, dtype=torch.float64, generator=generator), dim=-1))
    cov = axes * (0.2 * torch.rand(100, 1, 3, dtype=torch.float64, generator=generator) + 0.003) ** 2 @ axes.mT
    scale, q = scale_rotation_from_covariance(cov)
    M = rotation_matrix(q) * scale[:, None, :]
    torch.testing.assert_close(M @ M.mT, cov, rtol=1e-8, atol=1e-12)


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**31), small=st.integers(-6, 0), middle=st.floats(0, 1))
def test_closed_form_axes_are_lapacks(seed, small, middle):
    """Of needles, discs, balls and all between; sides from 1 to 1e-6."""
    generator = torch.Generator().manual_seed(seed)
    R = rotation_matrix(normalize(torch.randn(16, 4, dtype=torch.float64, generator=generator), dim=-1))
    sides = 10.0 ** torch.tensor([small, small * (1 - middle), 0.0], dtype=torch.float64)
    sides = sides[torch.randperm(3, generator=generator)]
    A = R @ torch.diag(sides) @ R.mT
    A = 0.5 * (A + A.mT)
    values, vectors = eigh3(A)
    torch.testing.assert_close(values, torch.linalg.eigvalsh(A), rtol=1e-9, atol=1e-14)
    torch.testing.assert_close(vectors @ torch.diag_embed(values) @ vectors.mT, A, rtol=0, atol=1e-14)
    torch.testing.assert_close(vectors.mT @ vectors, torch.eye(3, dtype=A.dtype).expand_as(A), rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(vectors), torch.ones(16, dtype=A.dtype))


@pytest.mark.parametrize("sides", [(1, 1, 1), (2, 2, 1), (1, 2, 2), (0, 0, 1), (0, 1, 1), (0, 0, 0), (3, 1, 2)])
def test_axes_of_equal_and_no_sides(sides):
    A = torch.diag(torch.tensor(sides, dtype=torch.float64))
    values, vectors = eigh3(A)
    assert values.tolist() == pytest.approx(sorted(sides), abs=1e-15)
    torch.testing.assert_close(vectors @ torch.diag(values) @ vectors.mT, A, rtol=0, atol=1e-15)
    assert float(torch.linalg.det(vectors)) == pytest.approx(1)
