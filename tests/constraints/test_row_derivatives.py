"""Derivatives of residual, Jacobian and multipliers, of each kind of constraint: forward against
central differences, reverse against forward, by state, time and all numbers of the constraint.

One program a kind has them all. (Rows go through `custom_jvp` rules and comparisons that are not
those of complex numbers, so there is no complex step.)
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc
from rbjax.model.solver_parameters import SOLIMP, SOLREF

GROUND = rc.Place.on(point=[0.1, -0.2, 0.05], axis=[1.0, 0.4, 2.0])
HAND = rc.Place.on(body="hand", point=[0.05, 0.1, -0.1], axis=[0.3, 1.0, 0.2])
ENDS = GROUND, HAND


@functools.cache
def limb() -> rb.Model:
    """A free body with a hinge, a hinge and a slide in turn, and a tendon."""
    return rb.load("""<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>
      <body name="base" pos="0 0 1"><freejoint/><geom size="0.1"/>
        <body name="arm" pos="0.2 0 0"><joint name="shoulder" axis="1 0 2"/><geom size="0.1"/>
          <body name="fore" pos="0.2 0 0.1"><joint name="elbow" axis="0 1 1"/><geom size="0.1"/>
            <body name="hand" pos="0.1 0.1 0"><joint name="slide" type="slide" axis="1 2 0"/>
              <geom size="0.1"/></body></body></body></body></worldbody>
      <tendon><fixed name="belt"><joint joint="shoulder" coef="0.7"/>
        <joint joint="elbow" coef="-1.2"/></fixed></tendon></mujoco>""")


def surface(x, numbers):
    return numbers[0] * x[0] ** 2 + jnp.sin(x[1]) * numbers[1] - x[2]


def curve(s, numbers):
    return jnp.stack([s, numbers[0] * s * s, numbers[1] * s])


def function(t, q, numbers):
    return jnp.stack([q[0] * q[8] - numbers[0] * t, q[4] * q[5] + jnp.sin(q[9] + numbers[1])])


def matrix(t, q, numbers):
    row = jnp.zeros(9).at[6].set(1.0)
    return row.at[7].set(numbers[0] * q[8]).at[0].set(jnp.cos(t))[None]


def rate(t, q, numbers):
    return (numbers[1] * q[1] + t)[None]


def swing(t):
    return 0.3 * jnp.sin(2 * t)


TWO = jnp.array([0.4, 0.7])
STARTS = jnp.linspace(-6.0, 6.0, 80)
MADE = {
    "Screw": lambda: rc.Screw(*ENDS, 0.3),
    "Distance": lambda: rc.Distance(*ENDS, 0.4),
    "QuaternionWeld": lambda: rc.QuaternionWeld(*ENDS, 1.5),
    "JointPolynomial": lambda: rc.JointPolynomial("elbow", "shoulder", [0.1, 0.5, 0.2, -0.3]),
    "TendonPolynomial": lambda: rc.TendonPolynomial("belt", None, [0.1, 0.5]),
    "Gear": lambda: rc.Gear("elbow", "shoulder", -2.0),
    "Rack": lambda: rc.Rack("slide", "elbow", 0.2),
    "Prescribed": lambda: rc.Prescribed("elbow", swing),
    "PointOnSurface": lambda: rc.PointOnSurface(*ENDS, surface, TWO),
    "PointOnCurve": lambda: rc.PointOnCurve(*ENDS, curve, STARTS, 0.2 * TWO),
    "Holonomic": lambda: rc.Holonomic(function, 2, TWO),
    "Pfaffian": lambda: rc.Pfaffian(matrix, rate, 1, TWO),
    "RollingSphere": lambda: rc.RollingSphere(*ENDS, 0.3),
    "RollingDisc": lambda: rc.RollingDisc(*ENDS, 0.3),
    "KnifeEdge": lambda: rc.KnifeEdge(*ENDS),
    "Soft": lambda: rc.Soft(rc.Inplane(*ENDS), SOLREF, SOLIMP, [1.0]),
}
QUICK = ("JointPolynomial",)


@pytest.mark.parametrize(
    "kind",
    [x if x in QUICK else pytest.param(x, marks=pytest.mark.slow) for x in rc.kinds()],
)
def test_derivatives(kind: str) -> None:
    one = MADE.get(kind, lambda: rc.kinds()[kind](*ENDS))()
    model = limb()
    state = model.random_state(jax.random.key(5))
    numbers, tree = jax.tree.flatten(one)
    at = {"dq": jnp.zeros(model.nv), "v": state.v, "t": jnp.array(0.3), "numbers": numbers}
    leaves, shape = jax.tree.flatten(at)
    keys = jax.random.split(jax.random.key(6), len(leaves))
    along = [jax.random.normal(k, x.shape) for k, x in zip(keys, leaves, strict=True)]
    along = jax.tree.unflatten(shape, along)

    def seen(x: dict) -> jax.Array:
        """All that is differentiated, in one array."""
        held = model.with_constraints(jax.tree.unflatten(tree, x["numbers"]))
        there = rb.State(rb.integrate(model, state.q, x["dq"]), x["v"])
        return jnp.concatenate([
            *rc.residual(held, there, t=x["t"]),
            rc.jacobian(held, there.q, t=x["t"]).ravel(),
            rc.multipliers(held, there, t=x["t"]),
        ])  # fmt: skip

    @jax.jit
    def found(s, w):
        x = jax.tree.map(lambda x, dx: x + s * dx, at, along)
        value, slope = jax.jvp(seen, (x,), (along,))
        (pulled,) = jax.vjp(seen, x)[1](w)
        back = sum(map(jnp.vdot, jax.tree.leaves(pulled), jax.tree.leaves(along)))
        return value, slope, back

    m = one.size
    w = np.asarray(jax.random.normal(jax.random.key(7), (3 * m + m * model.nv,)))
    value, slope, back = found(0.0, w)

    def central(h: float) -> jax.Array:
        return (found(h, w)[0] - found(-h, w)[0]) / (2 * h)

    quotient = (4 * central(1e-5) - central(2e-5)) / 3  # of order h^4: soft rows are stiff
    for part in np.split(np.arange(len(w)), [m, 2 * m, 2 * m + m * model.nv]):
        scale = 1e-7 * max(np.abs(slope[part]).max(), np.abs(value[part]).max(), 1.0)
        np.testing.assert_allclose(slope[part], quotient[part], rtol=0, atol=scale)
    assert abs(back - w @ slope) < 1e-12 * (np.abs(w) @ np.abs(slope))
    if kind != "Prescribed":  # its row says nothing of velocities beyond its own
        assert np.abs(slope[-m:]).max() > 1e-3  # multipliers
    assert np.abs(slope[:m]).max() > 1e-3 or kind in ("Pfaffian", "KnifeEdge")


def test_the_residual_s_gradient_where_a_loop_walks_the_tree() -> None:
    """Of one row; what its other numbers are made of has no cotangent."""
    model = rb.load("double_pendulum").replace(driver="rolled")
    tip = rc.Place.on(body="lower", point=[0.0, 0.0, -1.0])
    model = model.with_constraints(rc.Inplane(rc.Place.on(axis=[1.0, 0.0, 1.0]), tip))
    q = jnp.array([0.3, -0.8])

    @jax.jit
    def found(q):
        def value(q):
            return rc.residual(model, rb.State(q, jnp.zeros(2))).value[0]

        return jax.grad(value)(q), rc.jacobian(model, q)[0]

    np.testing.assert_allclose(*found(q), rtol=1e-14, atol=1e-15)
