"""Rows against the derivatives of their residual along a path; the laws of their algebra."""

import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc
from tests.constraints.rows import check, tree

PAIRS = [
    rc.Spherical, rc.Revolute, rc.Cylindrical, rc.Prismatic, rc.Planar, rc.Universal, rc.Weld,
    rc.Inline, rc.Inplane, rc.Parallel, rc.Orthogonal,
]  # fmt: skip


def closed(kind: type, **numbers: float) -> rb.Model:
    """The tree with hand and leg joined, closed in its default state."""
    return tree().with_constraints(made(kind, **numbers))


def made(kind: type, **numbers: float) -> rc.Constraint:
    if kind is rc.Distance:
        ends = rc.places(tree(), "hand", "leg", point=[0.1, 0.2, 0.9], axis=[1, 2, -1])
        return rc.Distance(*ends, **numbers)
    return kind.between(tree(), "hand", "leg", point=[0.1, 0.2, 0.9], axis=[1, 2, -1], **numbers)


NUMBERS = {rc.Screw: {"pitch": 0.3}, rc.Distance: {"length": 0.4}}


def test_every_kind_of_row() -> None:
    """In one program; those of a weld are of the same kinds."""
    numbered = [made(kind, **numbers) for kind, numbers in NUMBERS.items()]
    found = check(tree().with_constraints(made(rc.Universal), *numbered))
    np.testing.assert_allclose(found["rest"][: rc.Universal.size], 0.0, rtol=0, atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("kind", PAIRS, ids=[x.__name__ for x in PAIRS])
def test_pairs(kind: type) -> None:
    found = check(closed(kind))
    np.testing.assert_allclose(found["rest"], 0.0, rtol=0, atol=1e-15)
    assert found["rest"].shape == (kind.size,)


@pytest.mark.slow
@pytest.mark.parametrize("kind", NUMBERS)
def test_pairs_with_numbers(kind: type) -> None:
    check(closed(kind, **NUMBERS[kind]))
