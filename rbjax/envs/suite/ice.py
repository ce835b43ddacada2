"""`race_on_ice`: a car with tyre slip drives along a closed track as fast as it can.

The model is a single-track car in the plane. Its tyres (`TyreOnGround` with Fiala's law) have
constant loads: the loads at rest. The tyre's force is within the circle of mu N, so a steady turn
of radius R has

    v^2 / R <= mu g

The centre line is a Fourier series, so terms of the task are smooth functions of the state:

    c(u) = sum_k [x_c, y_c]_k cos(k u) + [x_s, y_s]_k sin(k u),    0 <= u < 2 pi
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.constraints import Place
from rbjax.envs import terms
from rbjax.envs.actions import Scaled
from rbjax.envs.episode import Params
from rbjax.envs.registry import register
from rbjax.envs.robot_files import robot_file
from rbjax.envs.task import Observation, Reward, Task, random_scale
from rbjax.envs.transition import Transition
from rbjax.loading import load
from rbjax.model import Model, State
from rbjax.wheeled.tyres.element import TyreOnGround
from rbjax.wheeled.tyres.laws import Fiala

WHEELS = "front_wheel", "rear_wheel"
RADIUS = 0.05  # of the wheels, m
STIFFNESS, ONSET = 2e3, 1e-4  # of the tyres' springs, N/m and m
#: a track of 31 m with turns to both sides: rows k = 1, 2, 3 of x_c, x_s, y_c, y_s in m
TRACK = ((5.5, 0.0, 0.0, 3.5), (0.4, -0.5, 0.1, -0.1), (0.7, -0.5, 0.5, 0.5))
POINTS = 24  # at which the nearest point of the centre line is first looked for
AHEAD = (0.4, 0.8, 1.2, 1.8, 2.4, 3.2)  # distances of the previewed points, m


def ice_car(friction: float = 0.25, slip_stiffness: float = 5.0) -> Model:
    """Load the car, with a tyre at each axle under its load at rest.

    Args:
        friction: largest force of a tyre over its load: 0.1 to 0.15 for rubber on wet ice, 0.2 to
            0.3 on cold or rough ice, 0.6 with studs.
        slip_stiffness: slope of the force over the load at zero slip.

    Source: O'Kelly et al., *F1TENTH*, NeurIPS 2019 Competition Track (the car); Fiala 1954.

    Example:
        >>> from rbjax.envs.suite.ice import ice_car
        >>> ice_car(0.2).joint_names
        ('x', 'y', 'heading', 'steering', 'front', 'rear')
    """
    model = load(robot_file("ice_car"))
    mass, at = np.asarray(model.bodies.mass), np.asarray(model.bodies.position)[:, 0]  # car at 0
    front, rear = (at[model.body(name)] for name in WHEELS)
    share = ((mass * at).sum() / mass.sum() - rear) / (front - rear)  # of the front axle
    coefficients: tuple[Any, ...] = slip_stiffness, friction, 0.5
    law, tyres = Fiala(*coefficients), []
    for name, part in zip(WHEELS, (share, 1 - share), strict=True):
        depth = part * mass.sum() * 9.81 / STIFFNESS + ONSET / 2
        wheel = Place.on(body=name, axis=[0.0, 1.0, 0.0])
        spring: tuple[Any, ...] = RADIUS + depth, STIFFNESS, 0.0, ONSET
        tyres.append(TyreOnGround(Place.on(), wheel, law, *spring))
    return model.with_forces(*tyres)


@register("race_on_ice")
def race_on_ice(*, randomise: bool = True) -> Task:
    """Drive a car with tyre slip along a closed track as fast as possible, on ice.

    The centre line is `params.values["track"]`, rows (x_c, x_s, y_c, y_s) of a Fourier series. An
    episode ends if the centre of mass leaves the track or the car turns around.

    Args:
        randomise: draw friction, slip stiffness and mass at each reset.

    Observations: distance from the centre line, direction relative to it (cos, sin), velocities of
    the car (ahead, left, turning), steering angle, speeds of the rims, points of the centre line
    ahead in the car's axes, last action. Actions: torque at the rear axle (-0.4..0.4 N m) and
    target steering angle (-0.5..0.5 rad), both scaled to -1..1.

    Source: Liniger, Domahidi & Morari, *Optimization-based autonomous racing of 1:43 scale RC
    cars*, OCAM 2015, for progress along the centre line as the objective.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.make("race_on_ice").observation_size
        23
    """
    return Task(
        "race_on_ice",
        ice_car(),
        start,
        observations={
            "policy": (
                Observation("place", place_on_track, noise=(0.01, 0.01, 0.01)),
                Observation("velocity", velocity, noise=(0.05, 0.05, 0.05)),
                Observation("steering", lambda transition: transition.after.q[3], noise=0.005),
                Observation(
                    "rims", lambda transition: RADIUS * transition.after.v[4:6], noise=0.05
                ),
                Observation("ahead", points_ahead, noise=0.01),
                Observation("last_action", lambda transition: transition.action),
            )
        },
        rewards=(
            Reward("progress", progress, 1.0),
            Reward("edge", edge, -1.0),
            Reward("smooth", terms.action_rate, -0.02),
            Reward("off_track", terms.terminated, -50.0),
        ),
        action=Scaled(),
        terminations={"left_track": left_track, "turned_around": turned_around},
        randomise=(
            (
                random_scale("friction", lambda m: [law.friction for law in laws(m)], 0.6, 1.2),
                random_scale(
                    "slip_stiffness", lambda m: [law.stiffness for law in laws(m)], 0.7, 1.3
                ),
                random_scale("load", loads, 0.9, 1.2),
            )
            if randomise
            else ()
        ),
        dt=0.0025,
        decimation=8,
        episode=1500,
        values={
            "track": np.array(TRACK),
            "half_width": 0.6,  # m
            "start_speed": [0.5, 1.5],  # m/s
            "start_error": [0.2, 0.2],  # largest distance from the centre line in m, angle in rad
        },
        tracked="car",
    )


class Nearest(NamedTuple):
    """The nearest point of the centre line.

    u: parameter of the point.
    tangent: (2,), the unit vector along the track.
    offset: distance of the car to the left of the centre line, m.
    curvature: of the centre line, positive to the left, 1/m.
    rate: |c'(u)|, m.
    """

    u: jax.Array
    tangent: jax.Array
    offset: jax.Array
    curvature: jax.Array
    rate: jax.Array


def centre_line(track: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Compute the centre line c(u) and its derivatives c'(u) and c''(u), (2,) each."""
    at = along = bend = jnp.zeros(2, track.dtype)
    c1, s1 = jnp.cos(u), jnp.sin(u)
    c, s = jnp.ones_like(c1), jnp.zeros_like(s1)
    for i in range(track.shape[0]):
        k = i + 1
        c, s = c * c1 - s * s1, s * c1 + c * s1  # of k u
        even, odd = track[i, 0::2], track[i, 1::2]
        at = at + even * c + odd * s
        along = along + k * (odd * c - even * s)
        bend = bend - k * k * (even * c + odd * s)
    return at, along, bend


def nearest(track: jax.Array, p: jax.Array) -> Nearest:
    """Compute the nearest point of the centre line to a point p (2,) m: the nearest of some points,
    then three Newton steps for (p - c(u)) . c'(u) = 0."""
    track = track.astype(p.dtype)
    k = np.arange(1, track.shape[0] + 1)[:, None] * (2 * np.pi * np.arange(POINTS) / POINTS)
    c, s = jnp.asarray(np.cos(k), p.dtype), jnp.asarray(np.sin(k), p.dtype)
    points = (track[:, None, 0::2] * c[..., None] + track[:, None, 1::2] * s[..., None]).sum(0)
    u = jnp.argmin(((points - p) ** 2).sum(-1)).astype(p.dtype) * (2 * np.pi / POINTS)
    u = jax.lax.stop_gradient(u)
    for _ in range(3):
        at, along, bend = centre_line(track, u)
        square = (along**2).sum()
        slope = jnp.maximum(square - ((p - at) * bend).sum(), 0.2 * square)
        u = u + ((p - at) * along).sum() / slope
    at, along, bend = centre_line(track, u)
    rate = jnp.sqrt((along**2).sum())
    t = along / rate
    offset = t[0] * (p[1] - at[1]) - t[1] * (p[0] - at[0])
    curvature = (along[0] * bend[1] - along[1] * bend[0]) / rate**3
    return Nearest(u, t, offset, curvature, rate)


def _nearest(transition: Transition) -> Nearest:
    return transition.after.once(
        nearest, lambda: nearest(transition.params.values["track"], transition.after.q[:2])
    )


def _direction(transition: Transition) -> tuple[Any, Any]:
    """Compute cos and sin of the car's heading relative to the track."""
    t, heading = _nearest(transition).tangent, transition.after.q[2]
    c, s = jnp.cos(heading), jnp.sin(heading)
    return t[0] * c + t[1] * s, t[0] * s - t[1] * c


def place_on_track(transition: Transition) -> jax.Array:
    """Compute the distance from the centre line in m, cos and sin of the direction."""
    return jnp.stack([_nearest(transition).offset, *_direction(transition)])


def velocity(transition: Transition) -> jax.Array:
    """Compute the velocities of the car ahead and to the left, m/s, and its turning rate, rad/s."""
    c, s, v = jnp.cos(transition.after.q[2]), jnp.sin(transition.after.q[2]), transition.after.v
    return jnp.stack([c * v[0] + s * v[1], c * v[1] - s * v[0], v[2]])


def points_ahead(transition: Transition) -> jax.Array:
    """Compute the points of the centre line about `AHEAD` m further on, (12,) in the car's axes."""
    near, q = _nearest(transition), transition.after.q
    track = transition.params.values["track"].astype(q.dtype)
    c, s = jnp.cos(q[2]), jnp.sin(q[2])
    found = []
    for distance in AHEAD:
        at, _, _ = centre_line(track, near.u + distance / near.rate)
        dx, dy = at[0] - q[0], at[1] - q[1]
        found += [c * dx + s * dy, c * dy - s * dx]
    return jnp.stack(found)


def progress(transition: Transition) -> Any:
    """Compute the speed along the centre line, m/s: t . v / (1 - curvature offset)."""
    near = _nearest(transition)
    ahead = near.tangent[0] * transition.after.v[0] + near.tangent[1] * transition.after.v[1]
    return ahead / jnp.maximum(1 - near.curvature * near.offset, 0.2)


def edge(transition: Transition) -> Any:
    """Compute (offset / half width)^6, which is near 1 only near the edge of the track."""
    return (_nearest(transition).offset / transition.params.values["half_width"]) ** 6


def left_track(transition: Transition) -> Any:
    """Return True if the centre of mass is outside of the track."""
    return jnp.abs(_nearest(transition).offset) > transition.params.values["half_width"]


def turned_around(transition: Transition) -> Any:
    """Return True if the car points backwards along the track."""
    return _direction(transition)[0] < -0.3


def start(key: jax.Array, params: Params) -> State:
    """Draw an initial state: a point of the track, with rolling wheels."""
    state = params.model.default_state()
    dtype, values = state.q.dtype, params.values
    u, offset, turn, ratio = jax.random.uniform(key, (4,), dtype)
    at, along, _ = centre_line(values["track"].astype(dtype), 2 * np.pi * u)
    t = along / jnp.sqrt((along**2).sum())
    error = values["start_error"].astype(dtype)
    offset, turn = (2 * offset - 1) * error[0], (2 * turn - 1) * error[1]
    low, high = values["start_speed"].astype(dtype)
    speed = low + ratio * (high - low)
    heading = jnp.arctan2(t[1], t[0]) + turn
    x, y = at[0] - t[1] * offset, at[1] + t[0] * offset
    rolls, zero = speed / RADIUS, jnp.zeros((), dtype)
    q = jnp.stack([x, y, heading, zero, zero, zero])
    v = jnp.stack([speed * jnp.cos(heading), speed * jnp.sin(heading), zero, zero, rolls, rolls])
    return state.replace(q=q, v=v)


def tyres(model: Model) -> list[TyreOnGround]:
    """Return the tyres of the car."""
    return [f for f in model.forces if isinstance(f, TyreOnGround)]


def laws(model: Model) -> list[Any]:
    """Return the laws of the tyres."""
    return [t.tyre for t in tyres(model)]


def loads(model: Model) -> list:
    """Return mass, inertia, and the springs of the tyres, in proportion to which are the loads."""
    return [model.bodies.mass, model.bodies.inertia, *(t.stiffness for t in tyres(model))]
