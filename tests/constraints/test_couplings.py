"""Couplings against the derivatives of their residual along a path, and against their formulas."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc
from tests.constraints.rows import everything

MASS = '<inertial pos="0 0 0.1" mass="2" diaginertia="0.1 0.2 0.25"/>'


@functools.cache
def chain() -> rb.Model:
    """A slide, two hinges and a ball, two of them with a reference of their own."""
    return rb.load(f"""<mujoco><compiler angle="radian"/><worldbody>
      <body><joint name="rail" type="slide" ref="0.4"/>{MASS}
        <body><joint name="first" ref="-0.3"/>{MASS}
          <body><joint name="second" axis="0 1 0"/>{MASS}
            <body><joint name="ball" type="ball"/>{MASS}</body></body></body></body>
      </worldbody></mujoco>""")


POLYNOMIAL = (0.1, -2.0, 0.3, 0.5, -0.7)
COUPLINGS = {  # a coupling, and its residual by rail, first and second, less their references
    "polynomial": (
        rc.JointPolynomial("first", "rail", POLYNOMIAL),
        lambda x, a, b, t: a - sum(c * x**k for k, c in enumerate(POLYNOMIAL)),
    ),
    "a constant with a driver": (
        rc.JointPolynomial("first", "rail", [0.2]), lambda x, a, b, t: a - 0.2,
    ),
    "held": (rc.JointPolynomial("rail", None, [0.2]), lambda x, a, b, t: x - 0.2),
    "gear": (rc.Gear("second", "first", -2.5), lambda x, a, b, t: b + 2.5 * a),
    "rack": (rc.Rack("rail", "first", 0.05), lambda x, a, b, t: x - 0.05 * a),
    "prescribed": (
        rc.Prescribed("first", lambda t: jnp.sin(3 * t) + t**3),
        lambda x, a, b, t: a - 0.3 - np.sin(3 * t) - t**3,
    ),
}  # fmt: skip


def test_couplings() -> None:
    """Value, gradient, rate and acceleration, all of them in one model."""
    model = chain().with_constraints(*(coupling for coupling, _ in COUPLINGS.values()))
    found = jax.jit(lambda: everything(model))()
    for name, want in found["want"].items():
        np.testing.assert_allclose(found["own"][name], want, atol=2e-13, err_msg=name)
    q = np.array(model.random_state(jax.random.key(3)).q - model.joints.reference)[:3]
    own = dict(zip(COUPLINGS, found["own"]["value"].tolist(), strict=True))
    for name, (_, residual) in COUPLINGS.items():
        assert own[name] == pytest.approx(residual(*q, 0.3), abs=1e-14), name
    assert np.abs(found["own"]["acceleration"]).min() > 1e-3


def test_numbers_are_leaves() -> None:
    """The derivative of a polynomial's value by its coefficients: -x^k."""
    model = chain().with_constraints(COUPLINGS["polynomial"][0])
    state = model.random_state(jax.random.key(0))

    def value(c):
        (coupling,) = model.constraints
        context = rb.forces.Context.of(model, 0.0, state, None)
        return coupling.replace(coefficients=c).rows(context)[0].value

    x = float(state.q[0] - 0.4)
    got = jax.grad(value)(model.constraints[0].coefficients)
    np.testing.assert_allclose(got, [-(x**k) for k in range(5)], atol=1e-14)


@pytest.mark.parametrize(
    ("coupling", "words"),
    [
        (rc.Gear("rail", "first", 1.0), "'rail', a slide, expected a hinge"),
        (rc.Rack("first", "rail", 1.0), "'rail', a slide, expected a hinge"),
        (rc.JointPolynomial("ball", None, [0.0]), "'ball', a ball, expected a joint of one"),
        (rc.Prescribed("ball", jnp.sin), "'ball', a ball, expected a joint of one"),
    ],
    ids=lambda x: type(x).__name__,
)
def test_joints_that_cannot_be_coupled(coupling: rc.Constraint, words: str) -> None:
    model = chain()
    with pytest.raises(rb.InputError, match=words):
        coupling.rows(rb.forces.Context.of(model, 0.0, model.default_state(), None))
