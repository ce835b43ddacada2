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
    made = kind.between(tree(), "hand", "leg", point=[0.1, 0.2, 0.9], axis=[1, 2, -1], **numbers)
    return tree().with_constraints(made)


#: with every kind of row among them
QUICK = (rc.Universal, rc.Weld)


@pytest.mark.parametrize(
    "kind",
    [x if x in QUICK else pytest.param(x, marks=pytest.mark.slow) for x in PAIRS],
    ids=[x.__name__ for x in PAIRS],
)
def test_pairs(kind: type) -> None:
    found = check(closed(kind))
    np.testing.assert_allclose(found["rest"], 0.0, rtol=0, atol=1e-15)
    assert found["rest"].shape == (kind.size,)


@pytest.mark.parametrize(
    "kind, numbers", [(rc.Screw, {"pitch": 0.3}), (rc.Distance, {"length": 0.4})]
)
def test_pairs_with_numbers(kind: type, numbers: dict) -> None:
    check(closed(kind, **numbers))
