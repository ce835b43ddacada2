"""`park_trailer`: a car drives backwards until its trailer stands in a bay.

The model is planar. Each axle is a knife edge (`KnifeEdge`), which does not slide sideways:

    x' = v cos h,   y' = v sin h,   h' = v tan(s) / L,   t' = -(v sin g + l h' cos g) / d

with the headings h of the car and t = h + g of the trailer, the hitch angle g, the steering angle
s, the wheelbase L, the hitch l behind the rear axle, and the drawbar d. Backwards, g = 0 is
unstable: without steering the trailer jackknifes.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.constraints import KnifeEdge, Place
from rbjax.envs import terms
from rbjax.envs.actions import Scaled
from rbjax.envs.episode import Params
from rbjax.envs.registry import register
from rbjax.envs.robot_files import robot_file
from rbjax.envs.task import Observation, Randomisation, Reward, Task, random_offset
from rbjax.envs.transition import Transition
from rbjax.loading import load
from rbjax.model import Model, State

#: the box of the trailer in the axes of its axle, m: rear end, front end, half width
REAR, FRONT, HALF_WIDTH = -0.4, 0.5, 0.25


def car_with_trailer() -> Model:
    """Load the car with its trailer, with a knife edge at each axle.

    Example:
        >>> from rbjax.envs.suite.trailer import car_with_trailer
        >>> car_with_trailer().joint_names
        ('x', 'y', 'heading', 'steering', 'hitch')
    """
    ahead = [1.0, 0.0, 0.0]
    places = (
        Place.on(site="rear_axle", axis=ahead),
        Place.on(body="front_wheel", axis=ahead),
        Place.on(site="trailer_axle", axis=ahead),
    )
    return load(robot_file("car_with_trailer")).with_constraints(
        *(KnifeEdge(Place.on(), place) for place in places)
    )


@register("park_trailer")
def park_trailer(*, randomise: bool = True) -> Task:
    """Drive a car backwards until its trailer stands in a bay.

    The bay is closed at its rear end and open towards x of its axes. Its pose is
    `params.values["bay"]`. An episode ends if the trailer jackknifes, leaves the yard or hits a
    wall of the bay.

    Args:
        randomise: draw the mass of the trailer and the error of the steering at each reset.

    Observations: pose of the trailer's axle in the bay (x, y in m, cos, sin), hitch angle, steering
    angle, their rates, speed of the car, last action. Actions: target speed (-1..1 m/s) and target
    steering angle (-0.6..0.6 rad), both scaled to -1..1.

    Source: Nguyen & Widrow, *The truck backer-upper*, IJCNN 1989; LaValle, *Planning Algorithms*,
    2006, 13.1.2.4.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.make("park_trailer").observation_size
        12
    """
    return Task(
        "park_trailer",
        car_with_trailer(),
        start,
        observations={
            "policy": (
                Observation("trailer_in_bay", trailer_in_bay, noise=(0.02, 0.02, 0.01, 0.01)),
                Observation("angles", lambda transition: transition.after.q[3:5], noise=0.01),
                Observation("rates", lambda transition: transition.after.v[3:5], noise=0.02),
                Observation("speed", speed, noise=0.02),
                Observation("heading_rate", lambda transition: transition.after.v[2], noise=0.02),
                Observation("last_action", lambda transition: transition.action),
            )
        },
        rewards=(
            Reward("near", near, 1.0),
            Reward("parked", parked, 2.0),
            Reward("hitch", lambda transition: transition.after.q[4] ** 2, -0.2),
            Reward("smooth", terms.action_rate, -0.1),
        ),
        action=Scaled(),
        terminations={
            "jackknifed": lambda transition: (
                jnp.abs(transition.after.q[4]) > transition.params.values["jackknife"]
            ),
            "left_yard": left_yard,
            "hit_bay": hit_bay,
        },
        randomise=(trailer_mass(0.5, 2.0), steering_error(0.03)) if randomise else (),
        decimation=5,
        episode=800,
        values={
            "bay": [0.0, 0.0, 0.0],  # x, y in m and heading in rad of the parked axle
            "bay_size": [1.2, 1.0],  # distance of its mouth ahead of the axle, width, m
            "yard": [9.0, 4.0],  # largest |x|, |y| of the trailer's axle in the bay's axes, m
            "jackknife": 1.2,  # largest hitch angle, rad
            "start_low": [3.0, -0.6, -0.3, -0.2],  # x, y, heading of the trailer; hitch angle
            "start_high": [4.5, 0.6, 0.3, 0.2],
        },
        tracked="trailer",
    )


def start(key: jax.Array, params: Params) -> State:
    """Draw an initial state at rest: the trailer's pose in the bay's axes, the hitch angle."""
    model, values = params.model, params.values
    low, high = values["start_low"], values["start_high"]
    state = model.default_state()
    drawn = jax.random.uniform(key, (4,), state.q.dtype, low, high)
    x0, y0, turn = values["bay"].astype(state.q.dtype)
    c, s = jnp.cos(turn), jnp.sin(turn)
    trailer, hitch = turn + drawn[2], drawn[3]
    heading = trailer - hitch
    drawbar, behind = lengths(model)
    x = x0 + c * drawn[0] - s * drawn[1] + drawbar * jnp.cos(trailer) + behind * jnp.cos(heading)
    y = y0 + s * drawn[0] + c * drawn[1] + drawbar * jnp.sin(trailer) + behind * jnp.sin(heading)
    zero = jnp.zeros_like(x)
    return state.replace(q=jnp.stack([x, y, heading, zero, hitch]))


def lengths(model: Model) -> tuple[jax.Array, jax.Array]:
    """Return the length of the drawbar, and of the hitch behind the rear axle, m."""
    axle = model.sites.position[model.site("trailer_axle")]
    hitch = model.bodies.position[model.body("trailer")]
    return -axle[0], -hitch[0]


def trailer_in_bay(transition: Transition) -> jax.Array:
    """Compute x, y in m, cos and sin of the heading of the trailer's axle in the bay's axes."""
    bay, q = transition.params.values["bay"], transition.after.q
    x0, y0, turn = (bay[i].astype(q.dtype) for i in range(3))
    x, y, _ = transition.after.site("trailer_axle").position
    dx, dy = x - x0, y - y0
    c, s = jnp.cos(turn), jnp.sin(turn)
    off = q[2] + q[4] - turn
    return jnp.stack([c * dx + s * dy, c * dy - s * dx, jnp.cos(off), jnp.sin(off)])


def speed(transition: Transition) -> Any:
    """Compute the speed of the car ahead, m/s."""
    heading, v = transition.after.q[2], transition.after.v
    return jnp.cos(heading) * v[0] + jnp.sin(heading) * v[1]


def near(transition: Transition) -> Any:
    """Compute 1 / (1 + e), with e = x^2 + 4 y^2 + 2 (1 - cos) in m^2, by the bay's axes."""
    x, y, c, _ = trailer_in_bay(transition)
    return 1 / (1 + x * x + 4 * y * y + 2 * (1 - c))


def parked(transition: Transition) -> Any:
    """Return 1 if the trailer stands in the bay within 0.1 m, 0.1 rad and 0.05 m/s, else 0."""
    x, y, c, s = trailer_in_bay(transition)
    placed = (jnp.abs(x) < 0.1) & (jnp.abs(y) < 0.1) & (jnp.abs(s) < 0.1) & (c > 0)
    return jnp.where(placed & (jnp.abs(speed(transition)) < 0.05), 1.0, 0.0)


def left_yard(transition: Transition) -> Any:
    """Return True if the axle of the trailer is outside of the yard."""
    x, y, _, _ = trailer_in_bay(transition)
    yard = transition.params.values["yard"]
    return (jnp.abs(x) > yard[0]) | (jnp.abs(y) > yard[1])


def hit_bay(transition: Transition) -> Any:
    """Return True if a corner of the trailer is in a wall of the bay."""
    x, y, c, s = trailer_in_bay(transition)
    mouth, width = transition.params.values["bay_size"]
    hit = False
    for along in (REAR, FRONT):
        for across in (-HALF_WIDTH, HALF_WIDTH):
            cx, cy = x + c * along - s * across, y + s * along + c * across
            beside = (cx < mouth) & (jnp.abs(cy) > width / 2)
            hit = hit | beside | (cx < REAR - 0.3)
    return hit


def trailer_mass(low: float, high: float) -> Randomisation:
    """Return a randomisation of the mass and the inertia of the trailer by one factor."""

    def draw(key: jax.Array, params: Params) -> jax.Array:
        return jax.random.uniform(key, (), params.model.gravity.dtype, low, high)

    def apply(model: Model, factor: jax.Array) -> Model:
        own, b = model.bodies, model.body("trailer")
        new = own.mass.at[b].multiply(factor), own.inertia.at[b].multiply(factor)
        return eqx.tree_at(lambda m: (m.bodies.mass, m.bodies.inertia), model, new)

    return Randomisation("trailer_mass", draw, apply)


def steering_error(largest: float) -> Randomisation:
    """Return a randomisation of the angle in rad by which the steering misses its target."""
    kp = 20.0  # of the file, N m/rad
    torque = np.array([[0.0, 0.0, 0.0], [kp * largest, 0.0, 0.0]])
    return random_offset("steering_error", lambda model: model.actuators.bias, -torque, torque)
