"""Cases of the terms of environments as functions of a transition, and of networks and policies."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax import envs
from rbjax.envs import learning, terms
from rbjax.forces import Context
from tests.composing import cast
from tests.public.grid import Case

LEG = """<body name="{0}" pos="0 {1} 0"><joint name="{0}" axis="0 1 0" range="-1 1"/>
<geom name="{0} foot" type="sphere" size=".05" pos="0.02 0 -.3" mass=".5"/>
<site name="{0} sole" pos="0.02 0 -.35"/></body>"""
WALKER = f"""<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/>
<body name="trunk" pos="0 0 .35"><freejoint/><geom name="chest" type="box" size=".1 .1 .05"
mass="3" contype="0" conaffinity="0"/><site name="imu"/>{LEG.format("left", 0.1)}
{LEG.format("right", -0.1)}</body></worldbody><actuator><motor name="left" joint="left" gear="2"/>
<motor name="right" joint="right" gear="2"/></actuator></mujoco>"""
MODEL = rb.load(WALKER, contacts=True)
FEET = terms.Feet(
    ("left sole", "right sole"), (("left foot", "floor"), ("right foot", "floor"))
)  # fmt: skip
VARIABLES = {
    "command": np.array([0.5, -0.2, 0.3]), "phase": np.array([0.4, -1.2]),
    "gait_rate": np.array(1.3), "air_time": np.array([0.3, 0.1]),
    "swing_peak": np.array([0.05, 0.08]),
}  # fmt: skip
RNG = np.random.default_rng(8)
# the feet are near the floor; attitudes are turned about all axes
Q = np.concatenate([
    np.array([[0.0, 0.0, 0.33], [0.2, 0.1, 0.36], [0.1, 0.3, 0.345]]),
    *[x / np.linalg.norm(x, axis=1, keepdims=True)
      for x in [np.concatenate([np.ones((3, 1)), 0.1 * RNG.normal(size=(3, 3))], 1)]],
    0.3 * RNG.normal(size=(3, 2)),
], 1)  # fmt: skip
V, U, A = RNG.normal(size=(3, 8)), RNG.uniform(-1, 1, (3, 2)), RNG.uniform(-1, 1, (3, 2))


def of_transition(read: Callable[[Any], Any], model: rb.Model = MODEL, **changes: Any) -> Case:
    """A term as a function of q, v, the controls and the action after a control step."""

    def make(dtype: Any, given: rb.Model = model) -> Callable[..., Any]:
        model = given.astype(dtype)
        variables = cast({k: jnp.asarray(x) for k, x in VARIABLES.items()}, dtype)

        def value(q: Any, v: Any, ctrl: Any, action: Any) -> Any:
            state = rb.State(q, v)
            zero = jnp.zeros(2, q.dtype)
            found = read(envs.Transition(
                state, Context.of(model, 0.0, state, ctrl), action, zero, ctrl, zero, variables,
                None, jnp.asarray(0.02, q.dtype), jnp.int32(3),
            ))  # fmt: skip
            return jnp.asarray(found, q.dtype)

        return value

    return Case(make, [Q, V, U, A], **changes)


HOME = (0.1, -0.1)
#: terms whose value is true or false, and has no derivative
FLAT = {"touching": terms.touching(FEET.pairs), "any_touching": terms.any_touching(FEET.pairs),
        "fallen": terms.fallen("imu"), "terminated": terms.terminated}  # fmt: skip
SMOOTH = {
    "gravity_direction": terms.gravity_direction("imu"), "tilt": terms.tilt("imu"),
    "axis_error": terms.axis_error("imu", (0.1, 0.0, 0.9)), "forces": terms.forces,
    "force_norms": terms.force_norms, "absolute_forces": terms.absolute_forces,
    "squared_forces": terms.squared_forces, "power": terms.power,
    "action_rate": terms.action_rate, "phase_cosines": terms.phase_cosines,
    "follow_phase": terms.follow_phase(FEET, 0.1, "trunk"),
    "joint_offsets": terms.joint_offsets(HOME), "joint_velocities": terms.joint_velocities(2),
    "pose_error": terms.pose_error(HOME, (1.0, 0.5)),
    "pose_similarity": terms.pose_similarity(HOME),
    "joint_deviation": terms.joint_deviation(HOME), "stand_still": terms.stand_still(HOME),
    "joint_limit_violation": terms.joint_limit_violation((-0.1, -0.1), (0.05, 0.05)),
    "track_velocity": terms.track_velocity("imu"), "track_yaw_rate": terms.track_yaw_rate("imu"),
    "vertical_velocity": terms.vertical_velocity("imu", "left"),
    "roll_and_pitch_rate": terms.roll_and_pitch_rate("trunk"),
}  # fmt: skip


def of_rewards(total: Callable[..., Any]) -> Case:
    def function(x: Any) -> Any:
        return total({"a": x[0], "b": x[1], "c": x[2]}, jnp.asarray(0.02, x.dtype))

    return Case(lambda dtype: function, [RNG.normal(size=(3, 3))])


def in_dtype(made: Callable[[], Any], n: int) -> Case:
    """A network, policy or critic of n observations."""
    return Case(
        lambda dtype: functools.partial(call, cast(made(), dtype)), [RNG.normal(size=(3, n))]
    )


def call(made: Any, obs: Any) -> Any:
    return made(obs)


@functools.cache
def pole() -> envs.Environment:
    return envs.make("cart_pole_balance", kernel=False)


KEY = jax.random.key(0)
ENVS = {
    **{name: of_transition(term) for name, term in SMOOTH.items()},
    **{name: of_transition(term, derivatives=False) for name, term in FLAT.items()},
    # without contacts, whose solution is on the grid of `rb.contact`
    "joint_acceleration": of_transition(terms.joint_acceleration(2), MODEL.replace(contact=None)),
    "sum_of_rewards": of_rewards(envs.sum_of_rewards),
    "product_of_rewards": of_rewards(terms.product_of_rewards),
    "clipped_sum": of_rewards(terms.clipped_sum(-0.01, 1.0, times_dt=True)),
    "tolerance": Case(lambda dtype: lambda x: terms.tolerance(x, (0.0, 0.5), 0.7),
                      [RNG.normal(size=3)]),
    "height_of_phase": Case(lambda dtype: lambda p: terms.height_of_phase(p, 0.1), [0.9 * A]),
    "network": in_dtype(lambda: learning.network(KEY, (3, 4, 2), last=1.0), 3),
    "new_policy": in_dtype(lambda: learning.new_policy(pole(), KEY, hidden=(4,)), 5),
    "new_critic": in_dtype(lambda: learning.new_critic(pole(), KEY, hidden=(4,)), 5),
}  # fmt: skip
