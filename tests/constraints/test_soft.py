"""Rows that yield: their law, its derivatives, rigid rows beside them, what is refused."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.mechanisms import pendulum
from rbjax import constraints as rc
from rbjax.constraints.equations.soft_weights import soft_weights
from rbjax.constraints.formulation import formulation_of
from rbjax.constraints.methods.soft import compliant_motion
from tests.constraints.rows import check, tree


@functools.cache
def mixed() -> rb.Model:
    """A limb that is welded softly, and a coupling that is rigid."""
    model = tree(floating=False)
    ends = rc.places(model, "hand", "leg", point=[0.1, 0.2, 0.9], axis=[1, 2, -1])
    weld = rc.Soft.on(
        model, rc.QuaternionWeld(*ends, 1.5), solref=(0.1, 0.7), solimp=(0.3, 0.9, 2.0, 0.4, 3.0)
    )
    slide, hinge = (model.joint_names[model.topology.joint_kinds.index(k)] for k in
                    ("slide", "hinge"))  # fmt: skip
    return model.with_constraints(weld, rc.JointPolynomial(hinge, slide, [0.1, 2.0]))


@pytest.mark.slow
def test_rows_of_a_quaternion_weld() -> None:
    model = tree()
    ends = rc.places(model, "hand", "leg", point=[0.1, 0.2, 0.9], axis=[1, 2, -1])
    found = check(model.with_constraints(rc.QuaternionWeld(*ends, 1.5)), atol=1e-13)
    np.testing.assert_allclose(found["rest"], 0.0, rtol=0, atol=1e-15)


def test_a_bob_on_a_soft_rod() -> None:
    """Released at rest 1 % too far out: g'' is d times what is asked, and (1 - d) of free fall."""
    model = pendulum().with_constraints()
    (rod,) = model.constraints
    soft = rc.Soft(rod, [0.05, 0.8], [0.6, 0.6, 0.1, 0.5, 2.0], [1.0])  # 1 kg: A = 1
    model = model.replace(constraints=(soft,))
    state = rb.State(jnp.array([0.0, -1.01]), jnp.zeros(2))
    a, f = compliant_motion(model, 0.0, state, jnp.zeros(2), {})
    k = 1 / (0.6 * 0.05 * 0.8) ** 2
    asked = -0.6 * k * 0.01
    want = 0.6 * asked + 0.4 * 9.81  # outwards is down
    np.testing.assert_allclose(a, [0.0, -want], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(f, [want - 9.81], rtol=1e-12)


@pytest.mark.slow
def test_derivatives() -> None:
    """Forward against differences, reverse against forward, by state, force and softness."""
    model = mixed()
    weld, coupling = model.constraints
    weight = jnp.asarray(soft_weights(model)[0])
    state = model.random_state(jax.random.key(2))
    k1, k2, k3, k4 = jax.random.split(jax.random.key(3), 4)
    dq, dv, tau, w = (jax.random.normal(k, (model.nv,)) for k in (k1, k2, k3, k4))

    def along(s):
        other = weld.replace(
            solref=weld.solref * (1 + 0.1 * s),
            solimp=weld.solimp * (1 + 0.05 * s),
            weight=weight * (1 - 0.2 * s),
        )
        there = rb.State(rb.integrate(model, state.q, s * dq), state.v + s * dv)
        moved = model.replace(constraints=(other, coupling))
        return compliant_motion(moved, 0.0, there, tau * (1 + s), {})[0]

    forward = jax.jit(lambda s: jax.jvp(along, (s,), (1.0,)))
    (value, slope), h = forward(0.0), 1e-5
    quotient = (forward(h)[0] - forward(-h)[0]) / (2 * h)
    np.testing.assert_allclose(slope, quotient, rtol=1e-6, atol=1e-6 * np.abs(value).max())
    back = jax.jit(jax.grad(lambda s: along(s) @ w))(0.0)
    np.testing.assert_allclose(back, slope @ w, rtol=1e-9)


@pytest.mark.parametrize("power", [1.0, 1.5, 2.0])
def test_derivative_where_the_residual_is_zero(power: float) -> None:
    """R starts flat there, where its power is above one."""
    (rod,) = pendulum().constraints

    def R(g, power):
        soft = rc.Soft(rod, [0.02, 1.0], jnp.array([0.5, 0.9, 0.1, 0.5, power]), [1.0])
        return soft.soft_terms([rc.Row(g, g, rb.forces.Loads(), 0.0)], jnp.ones(1), float)[0][0]

    value, (slope, of_power) = jax.value_and_grad(R, (0, 1))(0.0, power)
    assert (value, slope, of_power) == (1.0, 0.0, 0.0)


@pytest.mark.slow
def test_rigid_rows_beside_soft_ones_stay_closed() -> None:
    model = mixed()
    rigid_projected = rc.Formulation(rc.Compliant(), projection=rc.Projection())
    assert formulation_of("rollout", model, None) == rigid_projected
    start = rc.Projection(iterations=8).project(
        model.replace(constraints=model.constraints[1:]), 0.0, model.default_state()
    )
    path = rb.rollout(model, start, None, 1e-3, steps=200, integrator="rk4")
    off = rc.residual(model, path.state(-1))
    assert abs(off.value[-1]) < 1e-14 and abs(off.rate[-1]) < 1e-13
    assert np.abs(off.value[:-1]).max() > 1e-6


@pytest.mark.parametrize(
    "given, words",
    [
        ({"of": 3}, "got int, expected a Constraint"),
        ({"solref": [0.02]}, r"shape \(1,\), expected \(2,\)"),
        ({"solref": [0.02, -1.0]}, "expected two numbers above zero"),
        ({"solimp": [0.9]}, r"shape \(1,\), expected \(5,\)"),
        ({"weight": [1.0, 2.0]}, r"shape \(2,\), expected \(1,\)"),
        ({"weight": [np.nan]}, "expected finite numbers"),
    ],
)
def test_wrong_inputs(given: dict, words: str) -> None:
    (rod,) = pendulum().constraints
    numbers = {"of": rod, "solref": [0.02, 1.0], "solimp": [0.9, 0.95, 1e-3, 0.5, 2.0]}
    with pytest.raises(rb.InputError, match=words):
        rc.Soft(**(numbers | {"weight": [1.0]} | given))
    with pytest.raises(rb.InputError, match="not soft already"):
        rc.Soft(rc.Soft(rod, **{k: numbers[k] for k in ("solref", "solimp")}, weight=[1.0]),
                [0.02, 1.0], numbers["solimp"], [1.0])  # fmt: skip
