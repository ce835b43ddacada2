"""Rows against the derivatives of their residual along a path; the laws of their algebra."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc
from rbjax.constraints.system import gradient_matrix, rows_of
from rbjax.forces import Instant
from tests.quickly import quick_jit

PAIRS = [
    rc.Spherical, rc.Revolute, rc.Cylindrical, rc.Prismatic, rc.Planar, rc.Universal, rc.Weld,
    rc.Inline, rc.Inplane, rc.Parallel, rc.Orthogonal,
]  # fmt: skip


@functools.cache
def tree() -> rb.Model:
    """A floating base with a ball, a slide and a hinge: frames on all kinds of paths."""
    return rb.load("""<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>
      <body name="base" pos="0 0 1"><freejoint/><geom size="0.1"/>
        <body name="arm" pos="0.2 0 0"><joint type="ball"/><geom size="0.1"/>
          <body name="hand" pos="0.1 0.1 0"><joint type="slide" axis="1 2 0"/><geom size="0.1"/>
          </body></body>
        <body name="leg" pos="-0.2 0 0"><joint axis="0 1 1"/><geom size="0.1"/></body>
      </body></worldbody></mujoco>""")


def closed(kind: type, **numbers: float) -> rb.Model:
    """The tree with hand and leg joined, closed in its default state."""
    made = kind.between(tree(), "hand", "leg", point=[0.1, 0.2, 0.9], axis=[1, 2, -1], **numbers)
    return tree().with_constraints(made)


def everything(model: rb.Model) -> dict[str, jax.Array]:
    """What rows say of themselves, and the same by differentiation."""
    state = model.random_state(jax.random.key(3))
    a = jax.random.normal(jax.random.key(4), (model.nv,))

    def seen(q, v, t=0.3):
        return Instant.of(model, t, rb.State(q, v), None)

    def residual(q, t=0.3):
        return jnp.stack([jnp.asarray(row.value) for row in rows_of(model, seen(q, state.v, t))])

    def path(s):
        return residual(rb.integrate(model, state.q, s * state.v + s * s / 2 * a), 0.3 + s)

    now = seen(state.q, state.v).accelerating(a)
    rows = rows_of(model, now)
    along = lambda s: jax.jvp(path, (s,), (1.0,))  # noqa: E731
    (value, rate), (_, acceleration) = jax.jvp(along, (0.0,), (1.0,))
    G = jax.jacfwd(lambda dq: residual(rb.integrate(model, state.q, dq)))(jnp.zeros(model.nv))
    own = {
        name: jnp.stack([jnp.asarray(getattr(row, name)) for row in rows])
        for name in ("value", "rate", "acceleration")
    }
    found = dict(value=value, rate=rate, acceleration=acceleration, gradient=G)
    at_rest = residual(model.default_state().q)
    return {"own": own | {"gradient": gradient_matrix(now, rows)}, "want": found, "rest": at_rest}


@pytest.mark.parametrize("kind", PAIRS, ids=lambda kind: kind.__name__)
def test_pairs(kind: type) -> None:
    model = closed(kind)
    found = quick_jit(lambda: everything(model))()
    for name, want in found["want"].items():
        np.testing.assert_allclose(found["own"][name], want, atol=2e-14, err_msg=name)
    np.testing.assert_allclose(found["rest"], 0.0, atol=1e-15)
    assert found["rest"].shape == (kind.size,)


@pytest.mark.parametrize(
    "kind, numbers", [(rc.Screw, {"pitch": 0.3}), (rc.Distance, {"length": 0.4})]
)
def test_pairs_with_numbers(kind: type, numbers: dict) -> None:
    model = closed(kind, **numbers)
    found = quick_jit(lambda: everything(model))()
    for name, want in found["want"].items():
        np.testing.assert_allclose(found["own"][name], want, atol=2e-14, err_msg=name)
