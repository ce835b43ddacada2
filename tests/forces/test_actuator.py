"""Actuators of every kind on random trees against MuJoCo C; their derivatives."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.forces.acting import loads, states
from rbjax.forces.context import Context
from tests.compiler.host import COMPILER, on_host
from tests.forces.actuated import Samples, actuation, errors, limbs, motion_errors, ours
from tests.oracles.random_actuators import random_actuated
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY, F64_TRANSFORM, GRADIENT, relative_error

SEEDS = [pytest.param(k, marks=() if k == 3 else pytest.mark.slow) for k in range(20)]
MOTION = 1e-9  # of 50 steps


@pytest.mark.parametrize("seed", SEEDS)
def test_random_actuators(seed):
    m = mujoco.MjModel.from_xml_string(random_actuated(seed))
    assert load_quietly(m).nx == m.na
    assert max(errors(m)) < F64_PARITY
    assert max(motion_errors(m, 20)) < MOTION


MIXED = [
    '<general joint="h" gear="2" dyntype="filterexact" dynprm="0.07" gaintype="affine"'
    ' gainprm="1 2 3" biastype="affine" biasprm="1 2 3"/>',
    '<muscle tendon="rope" lengthrange="0.5 2.5" force="20" tausmooth="0.9"/>',
    '<pid joint="k" kp="3" kv="0.5" ki="0.7" input="pos ff"/>',
    '<dcmotor joint="s" motorconst="0.5 0.6" resistance="2" inductance="0.3 0" cogging=".1 4 .3"'
    ' thermal="2 3 0 0.04 25 20" lugre="30 0.2 0.3 0.4 0.9" input="pos voltage"'
    ' controller="1.1 0.2 0.3 0 0 90"/>',
    '<position site="s4" refsite="s1" gear="1 2 3 0.1 0.2 0.3" kp="2" kv="1"/>',
    '<general cranksite="s2" slidersite="s3" cranklength="3" biastype="affine" biasprm="1 2 3"/>',
    '<orientation joint="b" kp="3" kv="0.1"/>',
    '<motor joint="h" gear="3"/>',
]


@pytest.mark.slow
def test_drivers_agree_and_a_model_may_be_an_argument():
    m = limbs(*MIXED)
    model, samples = load_quietly(m), Samples.of(m, 5)
    expected = ours(model.replace(driver="unrolled"), samples)
    for driver in ("rolled", "limbs"):
        for a, b in zip(ours(model.replace(driver=driver), samples), expected, strict=True):
            assert relative_error(a, b) < F64_TRANSFORM
    state = jax.tree.map(lambda x: x[0], samples.state(model))
    run = jax.jit(actuation)
    for a, b in zip(run(model, state, jnp.asarray(samples.u[0])), expected, strict=True):
        assert relative_error(a, b[0]) < F64_TRANSFORM


def test_derivatives_by_numbers_and_controls():
    m = limbs(*MIXED)
    model, samples = load_quietly(m), Samples.of(m, 1)
    state, u = samples.state(model), jnp.asarray(samples.u[0])
    state = jax.tree.map(lambda x: x[0], state)
    rng = np.random.default_rng(0)
    weights = [jnp.asarray(rng.normal(size=n)) for n in (m.nv, m.na)]

    def loss(forces, u, x):
        context = Context.of(model.replace(forces=forces), 0.0, state.replace(x=x), u)
        tau = jnp.stack([jnp.asarray(a, float) for a in loads(context.model, context)[0]])
        return (tau * weights[0]).sum() + (states(context.model, context) * weights[1]).sum()

    at = (model.forces, u, state.x)
    slopes = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(*at)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(slopes))

    def direction(x):  # a limit that is infinite stays so
        return jnp.where(jnp.isfinite(x), jnp.asarray(rng.normal(size=x.shape)), 0.0)

    along, run = jax.tree.map(direction, at), jax.jit(loss)
    for part in range(3):
        toward = [d if k == part else jax.tree.map(jnp.zeros_like, d) for k, d in enumerate(along)]
        h = 5e-7
        ends = [run(*jax.tree.map(lambda x, d, s=s: x + s * d, at, tuple(toward))) for s in (h, -h)]
        products = jax.tree.map(lambda a, b: (a * b).sum(), slopes, tuple(toward))
        slope = sum(jax.tree.leaves(products))
        assert relative_error(slope, (ends[0] - ends[1]) / (2 * h)) < GRADIENT


PENDULUM = """
<mujoco><option timestep="0.01"/><worldbody><body><joint name="j"/><geom size="0.1" pos="0 0 -1"/>
</body></worldbody><actuator>
<muscle joint="j" lengthrange="-1 1" force="20" tausmooth="0.5"/>
<dcmotor joint="j" motorconst="0.5 0.6" resistance="2" inductance="0.3 0"/></actuator></mujoco>
"""


def test_a_gradient_through_a_motion():
    model = load_quietly(PENDULUM)
    state = model.default_state()

    def end(u):
        return rb.rollout(model, state, jnp.tile(u, (5, 1))).q[-1, 0]

    u, h = jnp.array([0.3, -0.2]), 1e-5
    slope = jax.jit(jax.grad(end))(u)
    run = jax.jit(end)
    differences = [(run(u + e) - run(u - e)) / (2 * h) for e in h * jnp.eye(2)]
    np.testing.assert_allclose(slope, differences, rtol=1e-6)


@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler for the emitted program")
def test_as_a_gpu_thread():
    m = limbs(*MIXED)
    model, samples = load_quietly(m).replace(driver="limbs"), Samples.of(m, 4)

    def one(q, v, x, u):
        return actuation(model, rb.State(q, v, x), u)

    given = (jnp.asarray(x) for x in (samples.q, samples.v, samples.x, samples.u))
    for a, b in zip(on_host(one, *given), ours(model, samples), strict=True):
        assert relative_error(a, b) < F64_TRANSFORM


def test_a_model_without_such_actuators_has_no_elements():
    assert all(rb.load(scene).forces == () for scene in rb.scenes())


def test_forces_of_joints_are_held_in_their_ranges():
    m = limbs('<position site="s4" refsite="s2" gear="0 0 0 9 8 7" kp="9"/>', '<motor joint="h"/>')
    m.jnt_actfrclimited[1], m.jnt_actfrcrange[1] = True, [-0.5, 0.4]
    assert max(errors(m, 20)) < F64_PARITY
