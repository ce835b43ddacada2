"""Mocap bodies, whose pose is a leaf of the model, against MuJoCo C: contacts, a weld, steps in
which they move, derivatives by the pose."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY, GRADIENT, relative_error

TEXT = """<mujoco><option tolerance="0" timestep=".002"/><worldbody>
<geom type="plane" size="0 0 1"/>
<body name="paddle" mocap="true" pos="-.25 0 .1" quat=".98 0 .1 0">
  <geom type="box" size=".05 .2 .1"/></body>
<body name="ball" pos="0 0 .098"><freejoint/><geom size=".1" mass="1"/></body>
<body name="hand" mocap="true" pos="0 1 .5"/>
<body name="held" pos="0 1 .5"><freejoint/><geom type="box" size=".05 .05 .05" mass="1"/></body>
</worldbody><equality><weld body1="hand" body2="held"/></equality></mujoco>"""


def test_a_pair_of_geoms_that_no_joint_moves_is_left_out() -> None:
    pairs = """<contact><pair geom1="floor" geom2="paddle" friction="2 2 .1 .1 .1"/>
      <pair geom1="floor" geom2="ball" friction=".3 .3 .1 .1 .1"/></contact>"""
    text = f"""<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/>
      <body mocap="true"><geom name="paddle" size=".1"/></body>
      <body><freejoint/><geom name="ball" size=".1"/></body></worldbody>{pairs}</mujoco>"""
    geoms = load_quietly(text).geoms
    assert geoms.pairs[0] == (0, 2) and (0, 1) not in geoms.pairs
    assert geoms.pair_friction.tolist() == [[0.3, 0.3, 0.1, 0.1, 0.1]]


def with_poses(model: rb.Model, positions: jax.Array, orientations: jax.Array) -> rb.Model:
    rows = jnp.array([model.body("paddle"), model.body("hand")])
    bodies = model.bodies.replace(
        position=model.bodies.position.at[rows].set(positions),
        orientation=model.bodies.orientation.at[rows].set(orientations),
    )
    return model.replace(bodies=bodies)


def poses(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """The paddle pushes the ball, the hand moves and turns."""
    t = np.arange(steps)[:, None] * 0.002
    paddle = np.array([-0.25, 0, 0.1]) + t * [0.6, 0.1, 0]
    hand = np.array([0, 1, 0.5]) + t * [0.2, 0, 0.3]
    turn = np.concatenate([np.cos(t), 0 * t, 0 * t, np.sin(t)], 1)
    still = np.broadcast_to([0.98, 0, 0.1, 0], (steps, 4)) / np.hypot(0.98, 0.1)
    return np.stack([paddle, hand], 1), np.stack([still, turn], 1)


def test_steps_with_mocap_bodies_that_move_are_those_of_mujoco() -> None:
    m = mujoco.MjModel.from_xml_string(TEXT)
    m.opt.ls_tolerance, m.opt.iterations = 1e-12, 200
    model, d = load_quietly(TEXT), mujoco.MjData(m)
    assert model.dropped == () and (0, 1) not in model.geoms.pairs  # the plane and the paddle
    p, r = poses(200)
    want, touching = [], 0
    for position, orientation in zip(p, r, strict=True):
        d.mocap_pos[:], d.mocap_quat[:] = position, orientation
        mujoco.mj_step(m, d)
        want.append(d.qpos.copy())
        touching += any({1, 2} == {*map(int, c.geom)} for c in d.contact)
    assert touching > 20

    def step(state: rb.State, pose: tuple) -> tuple[rb.State, jax.Array]:
        state = rb.step(with_poses(model, *pose), state, dt=0.002)
        return state, state.q

    run = jax.jit(rb.threads(lambda p, r: jax.lax.scan(step, model.default_state(), (p, r))[1]))
    np.testing.assert_allclose(run(jnp.asarray(p), jnp.asarray(r)), want, atol=F64_PARITY)


def test_the_derivative_by_the_pose() -> None:
    model = load_quietly(TEXT)
    p, r = (jnp.asarray(x[90]) for x in poses(91))
    state = model.default_state()

    def f(p: jax.Array, r: jax.Array) -> jax.Array:
        return rb.acceleration(with_poses(model, p, r), state)

    rng = np.random.default_rng(0)
    at, to = (p, r), tuple(jnp.asarray(rng.normal(size=x.shape)) for x in (p, r))
    value, rate = jax.jit(lambda to: jax.jvp(f, at, to))(to)
    ends = [jax.jit(f)(*(x + s * y for x, y in zip(at, to, strict=True))) for s in (1e-7, -1e-7)]
    assert jnp.abs(value[:6]).max() > 1 and jnp.abs(rate[6:]).max() > 1
    assert relative_error(rate, (ends[0] - ends[1]) / 2e-7, floor=1.0) < 100 * GRADIENT
