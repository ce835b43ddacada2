"""The motions of robots with joints, one function a clip: a size to its frames."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from docs.generate.pictures.painting import COUNT, FPS, TIMES, robot_frames
from rbjax.plotting import Camera

Size = tuple[int, int]
Frames = Iterator[np.ndarray]
POLICY = Path(__file__).parents[3] / "notebooks" / "data" / "go1_policy"


def walking_policy(size: Size) -> Frames:
    """A Go1 walks in a circle under a trained policy, with velocity commands."""
    env, policy = rb.envs.learning.load_policy(POLICY)
    command = jnp.array([0.8, 0.0, 0.9])  # m/s, m/s, rad/s

    def step(carry: tuple, key: jax.Array) -> tuple:
        obs, state = carry
        given = {"command": command, "command_steps": jnp.asarray(1e6)}
        state = state.replace(variables=state.variables | given)
        obs, state, *_ = env.step_once(key, state, policy(obs))
        return (obs, state), state.state.q

    keys = jax.random.split(jax.random.key(0), 50 + 4 * COUNT)
    q = np.asarray(jax.lax.scan(step, env.reset(keys[0]), keys)[1], float)
    model = rb.load(rb.write_mjcf(env.task.model))
    source = Path(rb.envs.__file__).parent / "robots" / "go1.xml"
    view = Camera(-60, 18)
    q = q[50 :: round(1 / (FPS * env.dt))][:COUNT]
    return robot_frames(model, q, size, source=source, camera=view, follow=True, zoom=1.05)


GRIPPER = """<mujoco><option cone="elliptic"/><default><geom friction="0.8"/></default><worldbody>
  <geom type="plane" size="0.3 0.3 1"/>
  <body name="hand" pos="0 0 0.16"><joint name="lift" type="slide" axis="0 0 1"/>
    <joint name="turn" axis="0 0 1"/>
    <geom type="box" size="0.07 0.02 0.015" mass="0.5" contype="0" conaffinity="0"
      rgba="0.3 0.34 0.4 1"/>
    <body name="left" pos="-0.05 0 -0.07"><joint name="left" type="slide" axis="1 0 0"/>
      <geom type="box" size="0.006 0.015 0.055" mass="0.1" rgba="0.16 0.4 0.7 1"/></body>
    <body name="right" pos="0.05 0 -0.07"><joint name="right" type="slide" axis="-1 0 0"/>
      <geom type="box" size="0.006 0.015 0.055" mass="0.1" rgba="0.16 0.4 0.7 1"/></body></body>
  <body name="cube" pos="0 0 0.025"><freejoint/>
    <geom type="box" size="0.025 0.025 0.025" mass="0.2" rgba="0.93 0.5 0.15 1"/></body></worldbody>
  <contact><exclude body1="left" body2="right"/></contact>
  <actuator><position joint="lift" kp="2000" kv="110"/><position joint="turn" kp="5" kv="0.2"/>
    <motor joint="left"/><motor joint="right"/></actuator></mujoco>"""


def contact(size: Size) -> Frames:
    """Two fingers grasp a cube by friction, lift it, turn it and put it down."""
    model = rb.load(GRIPPER)
    dt = 0.002
    t = dt * jnp.arange(round(TIMES[-1] / dt) + 40)

    def ramp(start: float, seconds: float) -> jax.Array:
        s = jnp.clip((t - start) / seconds, 0.0, 1.0)
        return s * s * (3 - 2 * s)

    height = 0.15 * (ramp(0.4, 0.8) - ramp(2.6, 0.8))
    turn = 1.2 * (ramp(1.0, 0.8) - ramp(2.0, 0.8))
    grip = jnp.full(len(t), 5.0)
    ctrl = jnp.stack([height, turn, grip, grip], -1)
    start = model.default_state()
    path = rb.rollout(model, start, ctrl, dt, contact="coulomb", save_every=round(1 / (FPS * dt)))
    return robot_frames(
        model, np.asarray(path.q)[:COUNT], size, source=GRIPPER, camera=Camera(-65, 14), zoom=1.1
    )


def flexible(size: Size) -> Frames:
    """A rubber cable of two beams, held at one end, falls and swings."""
    rubber = rb.flexible.circle(0.02, E=2e6, nu=0.48, density=1100.0)
    part = rb.flexible.beam(0.75, rubber, {"k_y": 2}, damping=0.01)
    cable = rb.load("<mujoco/>").with_beam("a", part).with_beam("b", part, "a")
    path = rb.rollout(
        cable, cable.default_state(), None, 1e-3, steps=80 * COUNT, integrator="discrete",
        save_every=40,
    )  # fmt: skip
    q = np.asarray(path.q)[:COUNT]  # in half the speed of the motion
    return robot_frames(cable, q, size, camera=Camera(-75, 16), zoom=1.1)


def swing_up(size: Size) -> Frames:
    """A cart-pole swings up under bounds, and a regulator holds it."""
    from rbjax.control import Control, Cost, Problem, StateError, feedback, lqr_at, solve

    cart, dt = rb.load("cart_pole"), 0.05
    up, down = cart.keyframe("up"), cart.keyframe("down")
    costs = [Cost(Control(), 0.02)]
    problem = Problem(
        cart, 60, dt, bounds=(-6.0, 6.0), running=costs, terminal=[Cost(StateError(up), 100.0)]
    )
    plan = solve(problem, down)
    Q, R = jnp.array([10.0, 10.0, 1.0, 1.0]), jnp.array([0.1])
    hold = feedback(cart, up, jnp.zeros(1), lqr_at(cart, up, jnp.zeros(1), Q, R, dt=0.01).K)
    follow = plan.policy()
    path = rb.rollout(
        cart, rb.State(down.q.at[1].add(0.05), down.v),
        lambda t, s: jnp.where(t < plan.duration, follow(t, s), hold(t, s)),
        0.01, steps=8 * COUNT, save_every=8,
    )  # fmt: skip
    q = np.asarray(path.q)[:COUNT]
    return robot_frames(cart, q, size, source="cart_pole", camera=Camera(-80, 10), zoom=1.1)


def loops(size: Size) -> Frames:
    """A delta robot, three closed loops, whose motors have prescribed motions."""
    model = rb.load("delta")
    names = [n for n in model.joint_names if n.startswith(("shoulder", "motor", "upper"))][:3]
    home = model.keyframe("home")
    width = 2 * np.pi / TIMES[-1]

    def motion(k: int) -> rb.constraints.Constraint:
        at = float(home.q[model.q_slice(names[k])][0])
        return rb.constraints.Prescribed(
            names[k],
            lambda t: at + 0.35 * (jnp.sin(2 * width * t + 2.0944 * k) - jnp.sin(2.0944 * k)),
        )

    driven = model.with_constraints(*(motion(k) for k in range(3)))
    start = rb.constraints.assemble(driven, home).state
    path = rb.rollout(driven, start, None, 0.002, steps=40 * COUNT, save_every=40)
    return robot_frames(model, np.asarray(path.q)[:COUNT], size, source="delta", zoom=1.12)


def tumbling_body(size: Size) -> Frames:
    """A handle that spins about its intermediate axis turns over, again and again."""
    handle = """<mujoco><option gravity="0 0 0"/><worldbody><body name="handle"><freejoint/>
      <geom type="cylinder" size="0.01 0.05" euler="90 0 0" density="2700" rgba="0.16 0.4 0.7 1"
        contype="0" conaffinity="0"/>
      <geom type="cylinder" size="0.01 0.025" euler="0 90 0" pos="0.025 0 0" density="2700"
        rgba="0.93 0.5 0.15 1" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""
    model = rb.load(handle)
    start = model.default_state()
    turned = jnp.array([np.cos(np.pi / 4), 0.0, -np.sin(np.pi / 4), 0.0])  # the stem upwards
    start = rb.State(start.q.at[3:7].set(turned), start.v.at[3:6].set(jnp.array([12.0, 0.0, 0.12])))
    path = rb.rollout(model, start, None, 0.002, steps=40 * COUNT, integrator="rk4", save_every=40)
    q = np.asarray(path.q)[:COUNT].copy()
    q[:, :3] = 0.0  # the view follows
    return robot_frames(model, q, size, source=handle, camera=Camera(-60, 20))


def through_a_gate(size: Size) -> Frames:
    """A quadrotor flies through a gate that leans by 60 degrees."""
    from rbjax.control import Control, Cost, Pose, Problem, StateError, Velocity, solve

    quad = rb.load("quadrotor")
    hover, thrust = quad.keyframe("hover"), 9.81 / 4

    def at(x: float) -> rb.State:
        return rb.State(hover.q.at[0].set(x), hover.v)

    c, s = np.cos(np.pi / 3), np.sin(np.pi / 3)
    R = jnp.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    gate = Pose(R, jnp.array([0.0, 0.0, 1.4]), body="frame")

    def at_gate(model, t, state, ctrl):
        return 60.0 * jnp.exp(-(((t - 1.0) / 0.04) ** 2)) * gate(model, t, state, ctrl)

    problem = Problem(
        quad, 80, 0.025, running=[Cost(Velocity(), 0.02), Cost(Control(thrust), 0.02), at_gate],
        terminal=[Cost(StateError(at(2.0)), 100.0)],
    )  # fmt: skip
    flight = solve(problem, at(-2.0), ctrl=jnp.full((80, 4), thrust))
    k = np.clip(np.round(np.linspace(0, 80, COUNT)).astype(int), 0, 80)  # half speed
    drawn = rb.ModelBuilder("quadrotor").spec
    for y, z, half in ((0, 0.2, (0.02, 0.5, 0.03)), (0.47, 0, (0.02, 0.03, 0.2))):
        for sign in (-1, 1):
            drawn.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX, size=half, rgba=(0.8, 0.2, 0.2, 1),
                pos=np.asarray(R) @ (0, sign * y, sign * z) + (0, 0, 1.4),
                quat=(np.cos(np.pi / 6), np.sin(np.pi / 6), 0, 0),
            )  # fmt: skip
    return robot_frames(
        quad, np.asarray(flight.states.q)[k], size, source=drawn, camera=Camera(-60, 12),
        trace=("frame",), follow=False, zoom=1.1, shift=(0.0, 0.0, 0.15),
    )  # fmt: skip
