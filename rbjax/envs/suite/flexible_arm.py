"""`damp_flexible_arm`: an arm that bends moves its payload to a goal and damps its own swing.

A motor turns a hub about the vertical. A strip of steel is clamped to the hub and carries a payload
(`rbjax.flexible`, planar bending, three coordinates). Its deflection under a force P across its tip
and its curvature at the hub are

    delta = P L^3 / (3 EI),     k(0) = P L / EI

The motor acts at one end and the payload is at the other: the system is not minimum phase.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.envs import terms
from rbjax.envs.actions import Scaled
from rbjax.envs.episode import Params
from rbjax.envs.registry import register
from rbjax.envs.robot_files import robot_file
from rbjax.envs.task import Observation, Reward, Task, Variable, random_scale
from rbjax.envs.transition import Transition
from rbjax.flexible.beams import Beam, beam
from rbjax.flexible.cross_section import rectangle
from rbjax.flexible.elasticity import BeamElasticity
from rbjax.loading import load
from rbjax.model import Model, State

LENGTH, HUB = 0.9, 0.05  # of the strip, and radius at which it is clamped, m


def strip() -> Beam:
    """Make the strip: steel, 0.9 m x 30 mm x 1.5 mm, which bends in the plane.

    Example:
        >>> from rbjax.envs.suite.flexible_arm import strip
        >>> round(float(strip().section.stiffness[2, 2]), 4)  # EI, N m^2
        1.6875
    """
    section = rectangle(0.0015, 0.03, E=2.0e11, nu=0.3, density=7800.0)
    return beam(LENGTH, section, {"k_z": 2}, damping=0.002)


def flexible_arm() -> Model:
    """Load the hub and its payload, with the strip between them.

    Example:
        >>> from rbjax.envs.suite.flexible_arm import flexible_arm
        >>> flexible_arm().nv
        4
    """
    return strip().replace_joint(load(robot_file("flexible_arm")), "strip")


@register("damp_flexible_arm")
def damp_flexible_arm(*, randomise: bool = True) -> Task:
    """Move the payload of a flexible arm to a goal angle and damp the swing of the arm.

    The goal is an angle about the hub, drawn at each reset and again after about 4 s. An episode
    ends if the strip bends too far or the hub leaves its range.

    Args:
        randomise: draw the stiffness of the strip, the payload and the friction at each reset.

    Observations: angle from the goal, angular rate of the hub, curvature of the strip at the hub
    and its rate (a strain gauge), last action. Privileged ("critic"): also the coordinates of the
    strip, the payload's angle from the goal, and its velocity. Action: torque of the motor
    (-1.5..1.5 N m), scaled to -1..1.

    Source: Cannon & Schmitz, *Initial experiments on the end-point control of a flexible one-link
    robot*, IJRR 3(3), 1984.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.make("damp_flexible_arm").observation_size
        {'critic': 15, 'policy': 5}
    """
    measured = (
        Observation(
            "goal_error",
            lambda transition: transition.after.q[0] - transition.variables["goal"],
            noise=0.003,
        ),
        Observation("rate", lambda transition: transition.after.v[0], noise=0.02),
        Observation("strain", strain, noise=(0.005, 0.1)),
        Observation("last_action", lambda transition: transition.action),
    )
    privileged = (
        *(Observation(x.name, x.read) for x in measured),
        Observation("strip", lambda transition: transition.after.q[1:]),
        Observation("strip_rates", lambda transition: transition.after.v[1:]),
        Observation("payload_error", payload_error),
        Observation("payload_velocity", payload_velocity),
    )
    return Task(
        "damp_flexible_arm",
        flexible_arm(),
        start,
        observations={"policy": measured, "critic": privileged},
        rewards=(
            Reward("reach", reach, 1.0),
            Reward("swing", swing, -0.1),
            Reward("effort", lambda transition: (transition.ctrl**2).sum(), -0.02),
            Reward("smooth", terms.action_rate, -0.02),
        ),
        action=Scaled(),
        variables=(Variable("goal", draw_goal, update=next_goal),),
        terminations={"overbent": overbent, "left_range": left_range},
        randomise=(
            (
                random_scale("stiffness", elasticity, 0.7, 1.4),
                random_scale("payload", lambda model: model.bodies.mass, [1.0, 0.5], [1.0, 2.0]),
                random_scale("friction", lambda model: model.joints.damping, 0.3, 3.0),
            )
            if randomise
            else ()
        ),
        dt=0.004,
        decimation=5,
        episode=500,
        values={
            "goals": [-1.5, 1.5],  # smallest and largest angle of a goal, rad
            "goal_time": 4.0,  # mean time between goals, s
            "largest_curvature": 2.6,  # of the strip at the hub, 1/m: steel yields at 0.2 %
            "range": 3.0,  # largest angle of the hub, rad
        },
        tracked="hub",
    )


def start(key: jax.Array, params: Params) -> State:
    """Draw an initial state: the hub at a random angle, the strip slightly bent, at rest."""
    state = params.model.default_state()
    drawn = jax.random.uniform(key, (4,), state.q.dtype, -1.0, 1.0)
    return state.replace(q=drawn * jnp.array([1.5, 0.1, 0.02, 0.0], state.q.dtype))


def draw_goal(key: jax.Array, params: Params) -> jax.Array:
    """Draw the angle of a goal, rad."""
    low, high = params.values["goals"]
    return jax.random.uniform(key, (), params.model.gravity.dtype, low, high)


def next_goal(key: jax.Array, transition: Transition) -> Any:
    """Draw a new goal with the probability dt / goal_time."""
    when, where = jax.random.split(key)
    new = jax.random.uniform(when) < transition.dt / transition.params.values["goal_time"]
    return jnp.where(new, draw_goal(where, transition.params), transition.variables["goal"])


def strain(transition: Transition) -> jax.Array:
    """Compute the curvature of the strip at the hub, 1/m, and its rate. The Legendre polynomials
    are (-1)^j there."""
    q, v = transition.after.q, transition.after.v
    return jnp.stack([q[1] - q[2] + q[3], v[1] - v[2] + v[3]])


def payload_error(transition: Transition) -> jax.Array:
    """Compute the payload's position over the length of the arm, less its position at the goal,
    (2,)."""
    at, goal = transition.after.body("payload").position.array[:2], transition.variables["goal"]
    return at / (LENGTH + HUB) - jnp.stack([jnp.cos(goal), jnp.sin(goal)])


def payload_velocity(transition: Transition) -> jax.Array:
    """Compute the velocity of the payload, (2,) m/s."""
    return transition.after.body("payload").velocity.array[:2]


def reach(transition: Transition) -> Any:
    """Compute 1 / (1 + (e / 0.1)^2) with the payload's distance e from the goal, over the length of
    the arm."""
    e = payload_error(transition)
    return 1 / (1 + 100.0 * (e * e).sum())


def swing(transition: Transition) -> Any:
    """Compute the square of the payload's velocity near the goal, (m/s)^2."""
    v = payload_velocity(transition)
    return reach(transition) * (v * v).sum()


def overbent(transition: Transition) -> Any:
    """Return True if the curvature at the hub is too large."""
    return jnp.abs(strain(transition)[0]) > transition.params.values["largest_curvature"]


def left_range(transition: Transition) -> Any:
    """Return True if the hub is out of its range."""
    return jnp.abs(transition.after.q[0]) > transition.params.values["range"]


def elasticity(model: Model) -> list:
    """Return the stiffness and the viscosity of the strip."""
    return [
        x for f in model.forces if isinstance(f, BeamElasticity) for x in (f.stiffness, f.viscosity)
    ]
