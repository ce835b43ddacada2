"""Cases of the public functions of arrays: models, bodies, rotations, constraints, wheels, plans.

`designs` has those of control, sysid and stability, `elsewhere` the names without a case.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.cases.mechanisms import pendulum
from rbjax import constraints, planning, rotations
from tests import test_registry as of_models
from tests.body import test_composes as of_bodies
from tests.composing import cast
from tests.public import designs
from tests.public.beams import FLEXIBLE
from tests.public.designs import RNG, state
from tests.public.grid import Case, same
from tests.public.transitions import ENVS
from tests.robots import robot
from tests.rotations import test_public as of_rotations
from tests.wheeled import test_registry as of_wheels

# ---------------------------------------------------------------- models: rb, dynamics, forces


def of_model(entry: of_models.Entry) -> Callable[[Any], Callable]:
    def make(dtype: Any) -> Callable:
        model = robot(entry.robot, "unrolled").model.astype(dtype)
        return lambda *x: entry.function(model, *x, **entry.rest)

    return make


MODELS = {
    name: Case(of_model(entry), of_models.samples(entry.arrays, entry.robot))
    for name, entry in of_models.REGISTRY.items()
}


def of_world(name: str) -> Callable[[Any], Callable]:
    """A frame of the world, which does not move."""

    def make(dtype: Any) -> Callable:
        model = robot("small", "unrolled").model.astype(dtype)
        return lambda *x: getattr(rb, name)(model, *x, body="world")

    return make


def motion(run: Callable) -> Callable[[Any], Callable]:
    def make(dtype: Any) -> Callable:
        model = robot("double_pendulum", "unrolled").model.astype(dtype)
        return lambda q, v, tau: run(model, rb.State(q, v), tau)

    return make


def rolled_out(model, state, tau):
    path = rb.rollout(model, state, None, 0.01, tau=tau)
    return path.q, path.v


def simulated(model, state, tau):
    ts = jnp.array([0.0, 0.02], state.q.dtype)
    path = rb.simulate(model, state, ts, tau=tau[0], dt=0.01, solver=diffrax.Midpoint())
    return path.q, path.v


SWING = [RNG.normal(size=(3, 2)), RNG.normal(size=(3, 2)), RNG.normal(size=(3, 2, 2))]
MODELS |= {
    f"{name}, world": Case(of_world(name), of_models.samples(arrays))
    for name, arrays in {
        "jacobian": ("q",), "jacobian_rate": ("q", "v"), "frame_velocity": ("q", "v"),
        "frame_bias_acceleration": ("q", "v"),
    }.items()
}  # fmt: skip
MODELS["rollout"] = Case(motion(rolled_out), SWING)
MODELS["simulate"] = Case(motion(simulated), SWING, derivatives=False)


# ---------------------------------------------------------------- spatial, body, rotations

BODIES = {
    f"{room.__name__.rpartition('.')[2]}.{name}": Case(same(f), of_bodies.samples())
    for room, entries in of_bodies.ROOMS.items()
    for name, f in entries.items()
}

Q = RNG.normal(size=(3, 4))
Q /= np.linalg.norm(Q, axis=1, keepdims=True)
ROTATIONS = {
    name: Case(same(of_rotations.public()[name]), xs) for name, xs in of_rotations.CASES.items()
}
ROTATIONS["convert"] = Case(
    same(lambda q: rotations.convert(q, "unit_quaternion", "mrp")), [np.abs(Q)]
)


def there_and_back(representation: Any) -> Callable:
    def found(q):
        R = rotations.quaternion.to_matrix(q)
        return representation.to_matrix(representation.from_matrix(R))

    return found


ROTATIONS |= {
    f"representations: {name}": Case(same(there_and_back(r)), [np.abs(Q)])
    for name, r in rotations.representations().items()
}

# ---------------------------------------------------------------- constraints


@cache
def loop(dtype: Any) -> rb.Model:
    return pendulum().astype(dtype)


ANGLE = np.array([0.3, -0.5, 1.1])
ON = np.stack([np.sin(ANGLE), -np.cos(ANGLE)], -1)
ALONG = np.stack([np.cos(ANGLE), np.sin(ANGLE)], -1)


def of_loop(f: Callable) -> Callable[[Any], Callable]:
    """A function of the loop and arrays. The model is made before any tracing."""

    def make(dtype: Any) -> Callable:
        return functools.partial(f, loop(dtype))

    return make


CONSTRAINTS = {
    "jacobian": Case(of_loop(constraints.jacobian), [ON]),
    "residual": Case(of_loop(lambda m, q, v: constraints.residual(m, state(q, v))), [ON, ALONG]),
    "multipliers": Case(
        of_loop(lambda m, q, v: constraints.multipliers(m, state(q, v))), [ON, ALONG]
    ),
    "constrained_dynamics": Case(
        of_loop(constraints.constrained_dynamics), [ON, ALONG, RNG.normal(size=(3, 2))]
    ),
    "joint_wrenches": Case(
        of_loop(lambda m, q, v: constraints.joint_wrenches(m, state(q, v))), [ON, ALONG]
    ),
}

# ---------------------------------------------------------------- contact

BALLS = """<mujoco><worldbody><geom type="plane" size="0 0 1"/>
  <body pos="0 0 0.5"><joint axis="0 1 0"/><geom type="sphere" size="0.1" pos="0.2 0 0"/></body>
  <body pos="0.6 0.1 0.4"><joint type="slide" axis="0 0 1"/><geom type="sphere" size="0.2"/></body>
</worldbody></mujoco>"""


@cache
def balls(dtype: Any) -> rb.Model:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*left out of the model.*contacts")
        return rb.load(BALLS).astype(dtype)


def detected(model: rb.Model, q: Any) -> tuple:
    found = rb.contact.detect(model, q, reach=jnp.inf)
    return found.distance, found.position, found.frame


def solved(model: rb.Model, q: Any, v: Any) -> tuple:
    """The ball on a slide is in the floor."""
    found = rb.contact.solve(model, state(q, v))
    return found.acceleration, found.contact, found.contacts.force, found.error * 0


def hit(model: rb.Model, q: Any, v: Any) -> tuple:
    """The ball on a slide hits the floor, by the law of impact."""
    found = rb.contact.impulse(model, state(q, v), restitution=0.5, friction=0.3, reach=1.0)
    return found.v, found.impulses


def pressed(law: Any, model: rb.Model, q: Any, v: Any) -> Any:
    return rb.contact.solve(model, state(q, v), contact=law).acceleration


DOWN = [0.01 * ALONG + [0.3, -0.22], 0.3 * ON - [0.0, 1.0]]
CONTACT = {
    "impulse": Case(lambda d: functools.partial(hit, balls(d)), DOWN),
    **{
        f"solve, {law}": Case(lambda d, law=law: functools.partial(pressed, law, balls(d)), DOWN)
        for law in ("coulomb", "impulse")
    },
    "detect": Case(lambda d: functools.partial(detected, balls(d)), [0.1 * ON]),
    "solve": Case(
        lambda d: functools.partial(solved, balls(d)), [0.01 * ALONG + [0.3, -0.22], 0.3 * ON]
    ),
}

# ---------------------------------------------------------------- wheeled

WHEELED = {name: Case(same(f), xs) for name, (f, xs) in of_wheels.REGISTRY.items()}

# ---------------------------------------------------------------- planning

POSES = RNG.uniform(-1, 1, (3, 3))
FAR = POSES + np.array([4.0, 2.0, 0.5])


def curve(name: str) -> Callable:
    def found(start, goal):
        path = getattr(planning, name)(start, goal, jnp.asarray(0.5, start.dtype))
        return path.sample_poses(5)

    return found


@cache
def field(dtype: Any) -> planning.DistanceField:
    cells = np.zeros((30, 30), bool)
    cells[18:24, 5:9] = True
    found = planning.OccupancyGrid(cells, 0.1, [-1.5, -1.5]).distance_field()
    return cast(found, dtype)


DISC = planning.Footprint.disc(0.2)


def clearance(field, footprint, poses):
    return planning.clearance(field, poses, footprint)


PLANNING = {name: Case(same(curve(name)), [POSES, FAR]) for name in ("dubins", "reeds_shepp")}
PLANNING["clearance"] = Case(
    lambda d: functools.partial(clearance, field(d), cast(DISC, d)), [0.5 * POSES]
)

TABLES: dict[str, dict[str, Case]] = {
    "models": MODELS,
    "bodies": BODIES,
    "rotations": ROTATIONS,
    "constraints": CONSTRAINTS,
    "contact": CONTACT,
    "wheeled": WHEELED,
    "planning": PLANNING,
    "control": designs.CONTROL,
    "estimation": designs.ESTIMATION,
    "sysid": designs.SYSID,
    "stability": designs.STABILITY,
    "flexible": FLEXIBLE,
    "envs": ENVS,
}
