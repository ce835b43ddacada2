"""Lengths, speeds and moment arms of actuators against MuJoCo C."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rbjax.forces.context import Context
from tests.forces.actuated import Samples, limbs
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY, GRADIENT, relative_error

GEAR = "0.5 -1.5 0.7 0.3 1.1 -0.4"
TRANSMISSIONS = [
    'joint="h" gear="2"',
    'joint="s" gear="-1.3"',
    'joint="b" gear="1 2 -3"',
    f'joint="f" gear="{GEAR}"',
    'jointinparent="b" gear="1 2 -3"',
    f'jointinparent="f" gear="{GEAR}"',
    f'site="s4" gear="{GEAR}"',
    f'site="s4" refsite="s2" gear="{GEAR}"',
    f'site="s3" refsite="s4" gear="{GEAR}"',
    f'site="s1" refsite="w" gear="{GEAR}"',
    f'site="w" refsite="s1" gear="{GEAR}"',
    'site="s4" refsite="s1" gear="0 0 0 1 2 3"',
    'site="s4" refsite="s4" gear="1 2 3 1 2 3"',
    'cranksite="s2" slidersite="s3" cranklength="1.9" gear="1.3"',
    'cranksite="s4" slidersite="w" cranklength="0.01" gear="-1.3"',
    'cranksite="w" slidersite="s1" cranklength="4" gear="-1.3"',
    'tendon="band" gear="1.4"',
    'tendon="rope" gear="-0.8"',
]


def reaches(m: mujoco.MjModel, driver: str):
    """A function of a state: lengths, speeds and moment arms (n, nv) of all actuators."""
    model = load_quietly(m).replace(driver=driver)

    def one(state):
        context = Context.of(model, 0.0, state, None)
        found = [element.transmission.reach(context) for element in model.forces]
        lengths = jnp.stack([jnp.asarray(x.length, float) for x in found])
        speeds = jnp.stack([jnp.asarray(x.speed(context), float) for x in found])
        arms = [jnp.stack([jnp.asarray(x.arms.get(i, 0.0), float) for i in range(m.nv)])
                for x in found]  # fmt: skip
        return lengths, speeds, jnp.stack(arms)

    return model, one


# with an integrator each is an element, the affine forces at joints and sites too
ROBOT = limbs(*(f'<general {t} dyntype="integrator"/>' for t in TRANSMISSIONS))


@pytest.mark.parametrize(
    "driver", ["rolled", *(pytest.param(x, marks=pytest.mark.slow) for x in ("unrolled", "limbs"))]
)
def test_against_mujoco(driver):
    model, one = reaches(ROBOT, driver)
    samples = Samples.of(ROBOT, 100)
    found = jax.jit(jax.vmap(one))(samples.state(model))
    data = mujoco.MjData(ROBOT)
    for k, (q, v) in enumerate(zip(samples.q, samples.v, strict=True)):
        data.qpos, data.qvel = q, v
        mujoco.mj_forward(ROBOT, data)
        moment = np.zeros((ROBOT.nu, ROBOT.nv))
        mujoco.mju_sparse2dense(
            moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr,
            data.moment_colind,
        )  # fmt: skip
        expected = (data.actuator_length, data.actuator_velocity, moment)
        for a, b in zip(found, expected, strict=True):
            assert relative_error(a[k], b) < F64_PARITY


def test_arms_are_gradients_where_lengths_are_in_space():
    model, one = reaches(ROBOT, "unrolled")
    samples = Samples.of(ROBOT, 3)
    state = jax.tree.map(lambda x: x[0], samples.state(model))
    in_space = [i for i, t in enumerate(TRANSMISSIONS) if t.startswith(("tendon", "crank"))]

    def moved(h):
        q = np.array(state.q)
        mujoco.mj_integratePos(ROBOT, q, np.array(state.v), h)
        return np.array(jax.jit(one)(state.replace(q=q))[0])

    h = 1e-5
    slope = (moved(h) - moved(-h)) / (2 * h)
    speeds = jax.jit(one)(state)[1]
    assert relative_error(speeds[jnp.array(in_space)], slope[in_space]) < GRADIENT
