"""Scenes that are odd or wrong: parameters outside of their ranges, deep overlap, geoms at one
place. The result is MuJoCo's, or finite with a small error."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.soft import detected
from rbjax.contact.solver.newton import solve, tolerance_of
from rbjax.model import State
from tests.tolerances import F64_PARITY, relative_error

pytestmark = pytest.mark.filterwarnings("ignore:.*a contact gains energy")

#: attributes of geoms that MuJoCo accepts; friction, solref, solimp, margin and gap are odd
ODD = (
    'friction="-1 -0.1 -0.01" priority="1"', 'friction="0 0 0" priority="1"',
    'friction="1e8 1 1" priority="1"', 'solref="-100 0.5"', 'solref="0.02 -1"',
    'solref="0 0" priority="1"', 'solref="-2000 -50"', 'solref="1e-9 1"', 'solref="0.02 0"',
    'solimp="2 -1 0 5 0.1"', 'solimp="0 0 0 0 0" priority="1"', 'solimp="0.9 0.95 -0.01 0.5 2"',
    'solimp="0.5 0.9 0.02 1 3"', 'solimp="0.5 0.9 0.02 0 3"', 'margin="-0.01"', 'gap="-0.02"',
    'margin="0.05" gap="0.02"', 'solmix="0" solref="0.05 1"', 'solmix="1e-20" solref="0.05 1"',
)  # fmt: skip


def odd(cone: str) -> mujoco.MjModel:
    """A ball for each kind of parameters, on joints of its own; depths from 1 mm to 2 radii."""
    joints = '<joint type="slide" axis="0 0 1"/><joint type="slide" axis="1 0 0"/>'
    bodies = "".join(
        f'<body pos="{k} 0 {0.099 - 0.01 * k}">{joints}<geom size=".1" contype="0" '
        f'condim="{(3, 4, 6)[k % 3]}" {given}/></body>'
        for k, given in enumerate(ODD)
    )
    m = mujoco.MjModel.from_xml_string(
        f'<mujoco><option cone="{cone}" impratio="3"/><worldbody><geom type="plane" '
        f'size="0 0 1"/>{bodies}</worldbody></mujoco>'
    )
    m.opt.tolerance, m.opt.ls_tolerance, m.opt.iterations, m.opt.ls_iterations = 0, 1e-12, 300, 100
    return m


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_odd_parameters_act_as_in_mujoco(cone) -> None:
    m = odd(cone)
    d = mujoco.MjData(m)
    d.qvel[:] = np.random.default_rng(0).normal(size=m.nv)
    mujoco.mj_forward(m, d)
    assert d.ncon >= len(ODD) - 2
    with pytest.warns(UserWarning, match=r"solref of mixed signs.* geoms \(.*, .*, .*\)"):
        model = rb.load(m, contacts=True)
    a = rb.acceleration(model, State(jnp.asarray(d.qpos), jnp.asarray(d.qvel)))
    pairs = np.abs(np.asarray(a) - d.qacc).reshape(-1, 2).max(1)
    wrong = [ODD[k] for k in np.flatnonzero(pairs > F64_PARITY * (1 + np.abs(d.qacc).max()))]
    assert not wrong


BALLS = """<mujoco><worldbody><geom type="plane" size="0 0 1"/>
  <body pos="0 0 .1"><freejoint/><geom size=".1"/></body>
  <body pos="0 0 .1"><freejoint/><geom size=".1"/></body>
  <body pos="0 0 .1"><freejoint/><geom type="capsule" size=".1 .1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_deep_overlap_and_geoms_at_one_place_give_finite_accelerations(dtype) -> None:
    """Balls and a capsule at one place, on the floor and far below it, at rest and fast."""
    model = rb.load(BALLS, contacts=True).astype(dtype)

    @jax.jit
    @rb.threads
    def found(q, v):
        problem = detected(model, q, v, jnp.zeros_like(v), None)
        return solve(problem)

    q = np.asarray(model.default_state().q)
    for height, speed in ((0.1, 0.0), (0.0, 0.0), (-100.0, 0.0), (-1e4, -1e3)):
        q = q.reshape(3, 7).copy()
        q[:, 2] = height
        v = np.full((3, 6), [0, 0, speed, 0, 0, 0])
        out = found(jnp.asarray(q.ravel(), dtype), jnp.asarray(v.ravel(), dtype))
        assert np.isfinite(out.x).all() and out.x.dtype == dtype
        assert float(out.error) <= 10 * tolerance_of(dtype)
        if height < 0:
            assert (np.asarray(out.x).reshape(3, 6)[:, 2] > 0).all()  # the floor pushes up


def test_a_leaf_that_is_not_finite_is_named() -> None:
    geoms = rb.load(BALLS, contacts=True).geoms
    for field in ("friction", "solref", "size", "margin"):
        with pytest.raises(rb.InputError, match=rf"Geoms.replace\({field}=.*got nan"):
            geoms.replace(**{field: getattr(geoms, field) * jnp.nan})


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("bad", [0.0, -0.1])
def test_a_size_that_is_not_positive_is_named(bad, dtype) -> None:
    geoms = rb.load(BALLS, contacts=True).astype(dtype).geoms
    with pytest.raises(rb.InputError, match=r"size of the sphere .*expected numbers above zero"):
        geoms.replace(size=geoms.size.at[1, 0].set(bad))
    geoms.replace(size=geoms.size.at[0].set(bad))  # a plane has no size
    geoms.replace(size=geoms.size.at[1, 2].set(bad))  # a sphere has one number


def test_a_reference_of_mixed_signs_is_named() -> None:
    model = rb.load(BALLS, contacts=True)
    geoms = model.geoms
    mixed = geoms.solref.at[1].set(jnp.array([-100.0, 0.5]))
    with pytest.warns(UserWarning, match=r"Geoms.replace\(solref=...\): mixed signs of .*0.02, 1"):
        geoms.replace(solref=mixed)
    geoms.replace(solref=geoms.solref.at[1].set(jnp.array([-100.0, -0.5])))


def test_touching_exactly_has_one_sided_derivatives() -> None:
    """A ball at the distance at which its contact begins: derivatives are finite."""
    text = BALLS[: BALLS.index("<body")] + (
        '<body pos="0 0 .1"><joint type="slide" axis="0 0 1"/><geom size=".1"/></body>'
        "</worldbody></mujoco>"
    )
    model = rb.load(text, contacts=True)

    def f(x):
        return rb.acceleration(model, State(x[:1], x[1:]))

    J = jax.jacfwd(f)(jnp.zeros(2))
    assert np.isfinite(J).all() and relative_error(J, jax.jacrev(f)(jnp.zeros(2)), floor=1.0) < 1e-9
