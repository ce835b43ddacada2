"""Unitree Go1 follows a velocity command, with rewards for a learner by gradients.

Robot, observations, variables and start are those of `go1_joystick_flat`, so that a policy of one
task acts in the other. The rewards of that task give a learner by gradients little to follow: they
are flat far from the command and clipped at zero, and the term "feet_clearance" has an infinite
slope at rest. Here, c is the commanded horizontal velocity, s = |c|, and v its actual value in axes
of the IMU, with the part a along c and the part b across it.
    progress  2 (s - sqrt((s - a)^2 + 0.01)), a constant slope up to the command, none beyond it
    sideways  -0.3 sqrt(b^2 + 0.01)
    turn      -0.3 sqrt((w_z - c_w)^2 + 0.01)
    height    z - 0.15 m, of the trunk
    alive     1
    effort    -0.005 |action|^2
    diagonal  -2 ((t_FR - t_RL)^2 + (t_FL - t_RR)^2), with the angle t of each leg's thigh, rad,
              and half as much of the calves: the two legs of a diagonal move alike
    opposed   -2.4 (t_FR + t_FL + t_RR + t_RL - 4 * 0.9)^2 / 4: one diagonal swings forward while
              the other swings back
Without the last two the robot learns to jump with all four feet at once; with them it trots.

The reward of a step is the sum of these and of the terms of `go1_joystick_flat`, without
"feet_height" and "stand_still", and with "feet_clearance" rounded off: the sum over the feet of
|h - 0.1| (v_xy^2 + 0.001)^(1/4). An episode also ends if z < 0.15 m, or if z_z of the IMU is below
0.6.

The curriculum of a training, at a progress p in 0..1:
    commands  until p = 0.15 all are forward, of 0.5 to 1.2 m/s; then a growing part, from p = 0.6
              on all, are those of `go1_joystick_flat`
    weights   those of "diagonal" and "opposed" grow from 0.15 to 1 times their values between
              p = 0.15 and 0.7, so that the robot moves before it trots; those of the terms of
              `go1_joystick_flat`, but for the two of tracking, grow from 0.3 to 1 times between
              p = 0.5 and 0.8

Source: Georgiev et al., *Adaptive horizon actor-critic for policy learning in contact-rich
differentiable simulation*, 2024, whose quadruped has terms of forward speed, height and effort. The
weights are ours.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.envs import terms
from rbjax.envs.episode import Params
from rbjax.envs.registry import register
from rbjax.envs.suite.go1 import BODY, FEET, HOME, IMU, SWING, go1_joystick_flat
from rbjax.envs.task import Reward, Task, Variable
from rbjax.envs.terms.frames import frame_at
from rbjax.lanes import Lane

#: the index in q of each leg's thigh; its calf has the next one
THIGH = {leg: 7 + 3 * i + 1 for i, leg in enumerate(FEET)}
TRACKING = ("tracking_lin_vel", "tracking_ang_vel")
LEFT_OUT = ("feet_clearance", "feet_height", "stand_still")
#: least height of the trunk, m, and least z_z of the IMU
LOW, UPRIGHT = 0.15, 0.6
#: commands of the beginning, m/s, and the progress in which random ones replace them
FORWARD, TURNING = (0.5, 1.2), (0.15, 0.6)
GAIT = ("diagonal", "opposed")
#: factor of weights at the beginning, and the progress in which it grows to 1
WEAK, GROWING = 0.3, (0.5, 0.8)
WEAK_GAIT, GAIT_GROWING = 0.15, (0.15, 0.7)


@register("go1_joystick_smooth")
def go1_joystick_smooth() -> Task:
    """A Go1 follows a velocity command, with rewards and a curriculum for a learner by gradients.

    Source: Georgiev et al., *Adaptive horizon actor-critic for policy learning in contact-rich
    differentiable simulation*, 2024, whose quadruped has terms of forward speed, height and effort.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.make("go1_joystick_smooth").action_size
        12
    """
    task = go1_joystick_flat()
    own = (
        Reward("progress", progress, 2.0),
        Reward("sideways", lambda transition: rounded(parts(transition)[2]), -0.3),
        Reward("turn", turn, -0.3),
        Reward("height", lambda transition: height(transition) - LOW),
        Reward("alive", lambda transition: 1.0),
        Reward("effort", lambda transition: (transition.action**2).sum(), -0.005),
        Reward("diagonal", diagonal, -2.0),
        Reward("opposed", opposed, -2.4),
        Reward("feet_clearance", clearance, -2.0),
    )
    kept = [r for r in task.rewards if r.name not in LEFT_OUT]
    growing = ["feet_clearance", *(r.name for r in kept if r.name not in TRACKING)]
    return dataclasses.replace(
        task,
        name="go1_joystick_smooth",
        rewards=(*own, *kept),
        terminations={
            "fallen": terms.fallen(IMU, UPRIGHT),
            "low": lambda transition: height(transition) < LOW,
        },
        variables=[mixed(v) if v.name == "command" else v for v in task.variables],
        values={**task.values, "command_mix": 1.0},
        curriculum=lambda params, progress: at(params, progress, growing),
        total_reward=lambda rewards, dt: sum(rewards.values()),
    )


def mixed(command: Variable) -> Variable:
    """Return the variable of a command that is drawn forward with probability 1 - `command_mix`."""
    assert command.update is not None
    change = command.update

    def is_any(key: jax.Array, params: Params) -> jax.Array:
        return jax.random.uniform(key) < params.values["command_mix"]

    def start(key: jax.Array, params: Params) -> jax.Array:
        choice, draw, speed = jax.random.split(key, 3)
        drawn = command.start(draw, params)
        ahead = jax.random.uniform(speed, minval=FORWARD[0], maxval=FORWARD[1])
        forward = jnp.zeros_like(drawn).at[0].set(ahead)
        return jnp.where(is_any(choice, params), drawn, forward)

    def update(key: jax.Array, transition: Any) -> jax.Array:
        choice, draw = jax.random.split(key)
        now = transition.variables[command.name]
        return jnp.where(is_any(choice, transition.params), change(draw, transition), now)

    return dataclasses.replace(command, start=start, update=update)


def at(params: Params, progress: Any, growing: Sequence[str]) -> Params:
    """Return the parameters at a progress in 0..1 of the training.

    growing: names of the rewards of `go1_joystick_flat` whose weights grow.
    """

    def share(begin: float, end: float) -> Any:
        return jnp.clip((progress - begin) / (end - begin), 0.0, 1.0)

    def like(x: Any, old: jax.Array) -> jax.Array:
        return jnp.asarray(x, old.dtype)

    mix = like(share(*TURNING), params.values["command_mix"])
    factors = dict.fromkeys(growing, WEAK + (1 - WEAK) * share(*GROWING))
    factors |= dict.fromkeys(GAIT, WEAK_GAIT + (1 - WEAK_GAIT) * share(*GAIT_GROWING))
    weights = {n: like(x * params.weights[n], params.weights[n]) for n, x in factors.items()}
    return params.replace(
        values={**params.values, "command_mix": mix}, weights={**params.weights, **weights}
    )


def parts(transition: Any) -> tuple[Lane, Lane, Lane]:
    """Return s, a and b, m/s."""
    c, v = transition.variables["command"], frame_at(transition.after, IMU).twist.lin
    s = jnp.sqrt(c[0] ** 2 + c[1] ** 2 + 1e-4)  # without a command, a direction of length zero
    x, y = c[0] / s, c[1] / s
    return s, x * v[0] + y * v[1], x * v[1] - y * v[0]


def rounded(x: Any) -> jax.Array:
    """Return |x|, rounded off at 0.1."""
    return jnp.sqrt(x * x + 0.01)


def progress(transition: Any) -> jax.Array:
    """Return the speed along the command, in m/s, limited to the commanded one."""
    s, along, _ = parts(transition)
    return s - rounded(s - along)


def turn(transition: Any) -> jax.Array:
    """Return the error of the yaw rate, rad/s."""
    w = frame_at(transition.after, IMU).twist.ang[2]
    return rounded(w - transition.variables["command"][2])


def height(transition: Any) -> Any:
    """Return the height of the trunk, m."""
    return transition.after.body(BODY).position[2]


def diagonal(transition: Any) -> Any:
    """Return the squared differences of thighs in a diagonal, plus half of those of calves."""
    q, found = transition.after.q, 0.0
    for one, other in (("FR", "RL"), ("FL", "RR")):
        i, j = THIGH[one], THIGH[other]
        found += (q[i] - q[j]) ** 2 + 0.5 * (q[i + 1] - q[j + 1]) ** 2
    return found


def opposed(transition: Any) -> Any:
    """Return a quarter of the squared sum of the thighs' angles from home, rad^2."""
    q = transition.after.q
    return sum(q[i] - HOME[1] for i in THIGH.values()) ** 2 / 4


def clearance(transition: Any) -> Any:
    """Return the sum of |h - 0.1| (v_xy^2 + 0.001)^(1/4) over the feet."""
    found = 0.0
    for foot in FEET:
        frame = frame_at(transition.after, foot)
        x, y, _ = frame.velocity
        found += jnp.abs(frame.position[2] - SWING) * (x * x + y * y + 1e-3) ** 0.25
    return found
