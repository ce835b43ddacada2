"""Springs between points against MuJoCo's spatial tendons of two sites."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from tests.forces.against_mujoco import (
    AT_A_JUMP,
    DRIVERS,
    SEEDS,
    costs_nothing,
    energy_slope,
    error_of,
    slopes,
    states,
    tree,
    worst_error,
)
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY, GRADIENT

ARM = """
<mujoco><compiler angle="radian"/>
<default><geom contype="0" conaffinity="0" size="0.1" pos="0.1 0 0.05"/></default>
<worldbody><site name="wall" pos="0.5 0.2 0.1"/>
  <body><joint axis="0 1 0"/><geom/><site name="upper" pos="0.1 0.02 0"/>
    <body pos="0.2 0 0"><joint type="ball"/><geom/><site name="lower" pos="0.1 0 0.05"/>
      <body pos="0.1 0 0"><geom/><site name="welded" pos="0 0.1 0.05"/></body></body></body>
</worldbody>
<tendon>
  <spatial name="plain" stiffness="30" damping="2" springlength="0.1">
    <site site="upper"/><site site="lower"/></spatial>
  <spatial name="slack" stiffness="30 4 9" damping="2 0.3 0.4" springlength="0.3 0.6" {more}>
    <site site="wall"/><site site="welded"/></spatial>
  <spatial name="at rest" stiffness="3"><site site="welded"/><site site="wall"/></spatial>
</tendon></mujoco>
"""


def random_model(seed: int) -> mujoco.MjModel:
    spec, rng = tree(seed), np.random.default_rng(seed)
    for k, body in enumerate(spec.bodies):
        body.add_site(name=f"end{k}", pos=rng.uniform(-0.3, 0.3, 3))
    for k in range(3):
        i, j = rng.choice(len(spec.bodies), 2, replace=False)
        tendon = spec.add_tendon(name=f"spring{k}")
        tendon.stiffness[:] = rng.uniform(1, 9, 3) * [1, rng.integers(2), rng.integers(2)]
        tendon.damping[:] = rng.uniform(0, 3, 3) * rng.integers(0, 2, 3)
        low = rng.uniform(0, 0.6)
        tendon.springlength[:] = [(low, low), (low, low + 0.3), (0, low)][k]
        tendon.wrap_site(f"end{i}")
        tendon.wrap_site(f"end{j}")
    return spec.compile()


@pytest.mark.parametrize("seed", SEEDS)
def test_random_trees(seed: int) -> None:
    m = random_model(seed)
    assert not any("tendon" in word for word in load_quietly(m).dropped)
    assert worst_error(m) < F64_PARITY


@pytest.mark.parametrize("driver", DRIVERS)
def test_every_driver(driver: str) -> None:
    m = mujoco.MjModel.from_xml_string(ARM.format(more=""))
    assert worst_error(m, driver) < F64_PARITY


@pytest.mark.parametrize(
    ("more", "left_out"),
    [
        ('limited="true" range="0 1"', "tendon limits (slack)"),
        ('frictionloss="1"', "tendon friction loss (slack)"),
        ('armature="1"', "tendon armature (slack)"),
    ],
)
def test_limits_friction_and_armature_are_named(more: str, left_out: str) -> None:
    model = load_quietly(ARM.format(more=more), contacts=False)
    assert model.dropped == (left_out,)
    same = mujoco.MjModel.from_xml_string(ARM.format(more=""))
    assert error_of(model, same) < F64_PARITY


def test_disabled() -> None:
    for flag in ("spring", "damper"):
        text = ARM.format(more="").replace(
            "<default>", f'<option><flag {flag}="disable"/></option><default>'
        )
        assert worst_error(mujoco.MjModel.from_xml_string(text)) < F64_PARITY


def test_slopes() -> None:
    model = rb.load(ARM.format(more=""))
    q, v, _ = states(mujoco.MjModel.from_xml_string(ARM.format(more="")), 1)

    def f(at):
        tendons, q, v = at
        return rb.applied_forces(model.replace(tendons=tendons), rb.State(q, v))

    assert slopes(f, (model.tendons, q[0], v[0])) < GRADIENT
    force, slope = energy_slope(model, q[0])
    np.testing.assert_allclose(force, slope, atol=1e-11)


def ball_on_a_spring(at: list[float], **numbers) -> tuple[rb.Model, rb.State]:
    """A free body held to a point of the world, the spring's other end at `at` from that."""
    model = rb.load("free_body")
    here = rb.forces.Place.on(point=[0.3, 0.2, 0.1])
    spring = rb.forces.PointSpring.of(here, rb.forces.Place.on(body=0), **numbers)
    q = model.default_state().q.at[:3].set(here.position + jnp.array(at))
    return model.with_forces(spring), rb.State(q, jnp.zeros(6))


@pytest.mark.parametrize(
    ("at", "length"),
    [
        ([0.0, 0.0, 0.0], 0.0),  # the ends meet, where a spring of no length rests
        ([0.5, 0.0, 0.0], 0.5),  # no stretch
        ([0.5, 0.0, 0.0], (0.2, 0.5)),  # the ends of the slack
        ([0.5, 0.0, 0.0], (0.5, 0.8)),
    ],
)
def test_slopes_at_singular_points(at: list[float], length: object) -> None:
    """Derivatives of the spring; a damper has no direction where its ends meet."""
    damping = 0.0 if not any(at) else 2.0
    model, state = ball_on_a_spring(at, stiffness=[0.0, 5.0], damping=damping, length=length)

    def f(x):
        forces, q, v = x
        return rb.applied_forces(model.replace(forces=forces), rb.State(q, v))

    assert slopes(f, (model.forces, state.q, state.v), 3e-6) < AT_A_JUMP


def test_a_stretched_spring_whose_ends_meet_has_finite_slopes() -> None:
    model, state = ball_on_a_spring([0.0] * 3, stiffness=4.0, damping=1.0, length=0.5)

    def f(forces, q, v):
        return rb.applied_forces(model.replace(forces=forces), rb.State(q, v))

    slope = jax.jit(jax.jacrev(f, (0, 1, 2)))(model.forces, state.q, state.v)
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(slope))
    assert not np.any(f(model.forces, state.q, state.v))


def test_zeros_cost_nothing_and_other_models_have_none() -> None:
    model = rb.load("double_pendulum")
    assert model.forces == ()
    ends = (rb.forces.Place.on(), rb.forces.Place.on(body=1))
    assert costs_nothing(rb.forces.PointSpring.of(*ends), model)


def test_anchor_of_two_frames_or_of_what_is_no_name() -> None:
    with pytest.raises(rb.InputError, match="give one of them"):
        rb.forces.Place.on(body="a", site="b")
    for wrong in (True, 1.5):
        with pytest.raises(rb.InputError, match=r"site is .*, expected its name, its index, or"):
            rb.forces.Place.on(site=wrong)  # type: ignore[arg-type]
