"""The measured order of every solver, over four halvings above rounding."""

import numpy as np
import pytest

import rbjax as rb
from tests.solvers.scenes import SOLVERS, program, scene

#: the coarsest number of steps, by order; multistep methods need more to leave their start behind
COARSE = {1: 64, 2: 32, 3: 24, 4: 12, 5: 6, 6: 3}
MULTISTEP = {1: 64, 2: 64, 3: 64, 4: 48, 5: 32, 6: 24}
WITHIN = 0.15
ROUNDING = 3e-15  # of the solutions and of their references

# One a family runs always, the others in the whole suite: a compilation each.
QUICK = """rk4 radau_iia3 kvaerno3 ros34pw2 adams_bashforth5 adams_moulton4 pece4 bdf2
generalized_alpha semi_implicit_euler variational_midpoint yoshida6 rkmk5 lie_generalized_alpha
rigid_body_splitting""".split()  # noqa: SIM905

NAMES = [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in SOLVERS]


def errors(name: str, steps: np.ndarray) -> np.ndarray:
    """Largest deviation at the end, for each number of steps."""
    s, run = scene(name), program(name)
    out = []
    for n in steps:
        y, ok = run(float(n), s.end, s.y0, s.args)
        assert ok, f"{name}: {n} steps did not succeed"
        out.append(np.abs(np.asarray(y) - s.exact).max())
    return np.array(out)


@pytest.mark.parametrize("name", NAMES)
def test_order(name: str) -> None:
    order = SOLVERS[name].order
    multistep = name.startswith(("adams", "pece", "bdf"))
    steps = (MULTISTEP if multistep else COARSE)[order] * 2 ** np.arange(5)
    found = errors(name, steps)
    assert found[-1] > ROUNDING, found
    rates = np.log2(found[:-1] / found[1:])
    assert abs(rates[2:].mean() - order) < WITHIN, (rates, found)  # the finer two halvings
    assert abs(rates - order).max() < 0.7, (rates, found)


def test_the_registry_is_whole() -> None:
    assert len(SOLVERS) >= 40
    assert list(SOLVERS) == list(rb.solvers.all()), "an order that stays"
    for name, entry in SOLVERS.items():
        assert entry.kind in ("ode", "second-order", "split", "lie"), name
        assert entry.make().order(scene(name).term) == entry.order, name
