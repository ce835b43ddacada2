"""Orders: rooted trees, those in the registry, and measured ones."""

import diffrax
import pytest

import rbjax as rb
from rbjax import stability

WITHIN = 0.15
QUICK = {"rk4"}
NAMES = [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in rb.solvers.all()]


@pytest.mark.parametrize("name", NAMES)
def test_measured_order(name: str) -> None:
    found = stability.measured_order(name)
    assert abs(found.order - rb.solvers.all()[name].order) < WITHIN, found


def test_orders_of_diffrax_tableaus() -> None:
    expected = {
        diffrax.Midpoint: 2, diffrax.Ralston: 2, diffrax.Bosh3: 3, diffrax.Tsit5: 5,
        diffrax.Dopri5: 5, diffrax.Dopri8: 8, diffrax.Kvaerno3: 3, diffrax.ImplicitEuler: 1,
    }  # fmt: skip
    assert {s: stability.order_by_conditions(s()) for s in expected} == expected


def test_what_cannot_be_measured_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbjax.stability.theory.linear_analysis.FINEST", 16)
    with pytest.raises(rb.InputError, match="measured_order: RK4 has errors"):
        stability.measured_order("rk4")
