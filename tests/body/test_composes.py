"""Every public function of spatial and body under jit, vmap, jvp and vjp, a program per package.

Compared with the same functions of one sample at a time, and with central differences.
"""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax import body, spatial
from rbjax.body import lagrange, particles, virtual_work
from rbjax.body import relative_motion as rm
from rbjax.rotations import se3, so3
from rbjax.spatial import operators, shapes
from tests.composing import cast
from tests.tolerances import F64_TRANSFORM, GRADIENT, relative_error

TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
SYSTEM = lagrange.System(
    lambda q, v: (1 + q[0] ** 2) * (v @ v) / 2 + q[1] * v[0] * v[1] / 3,
    lambda q: jnp.sin(q[0]) * q[1],
    lambda q, v: (v @ v) ** 2,
)


def point(q):
    return jnp.stack([jnp.sin(q[0]), q[1] * q[0], jnp.cos(q[1])])


def ball(t, x):
    return ((x - t) ** 2).sum(-1) - 1


def turn(xi):
    """Poses and rotations are made from six numbers, so that differences stay valid."""
    return se3.exp(xi)


def inertia(s):
    return so3.hat(s) @ so3.hat(s).T + 3 * jnp.eye(3, dtype=s.dtype)


def frame(xi):
    return rm.MovingFrame(so3.exp(xi[:3]), xi[3:], xi[:3], xi[3:], xi[1:4], xi[2:5])


BODY = body.Body(*shapes.box([1.0, 2.0, 3.0], mass=2.0))
FORCES = (body.UniformGravity(), body.Spring(2.0, [1.0, 2, 3], [0.1, 0, 0], 0.3))


def situation(s):
    return body.Situation(cast(BODY, s)._replace(com=s), cast(FORCES, s))


# name -> (function of six numbers twice, a vector and a positive triple)
SPATIAL = {
    "motion_transform": lambda x, y, s, d: spatial.motion_transform(turn(x)),
    "force_transform": lambda x, y, s, d: spatial.force_transform(turn(x)),
    "transform_motion": lambda x, y, s, d: spatial.transform_motion(turn(x), y),
    "transform_force": lambda x, y, s, d: spatial.transform_force(turn(x), y),
    "extended_rotation": lambda x, y, s, d: spatial.extended_rotation(so3.exp(s)),
    "extended_translation": lambda x, y, s, d: spatial.extended_translation(s),
    "extended_cross": lambda x, y, s, d: spatial.extended_cross(s),
    "motion_cross_matrix": lambda x, y, s, d: spatial.motion_cross_matrix(x),
    "force_cross_matrix": lambda x, y, s, d: spatial.force_cross_matrix(x),
    "motion_cross": lambda x, y, s, d: spatial.motion_cross(x, y),
    "force_cross": lambda x, y, s, d: spatial.force_cross(x, y),
    "twist_at": lambda x, y, s, d: spatial.twist_at(x, s),
    "wrench_at": lambda x, y, s, d: spatial.wrench_at(x, s),
    "force_at": lambda x, y, s, d: spatial.force_at(s, d),
    "merge_wrenches": lambda x, y, s, d: spatial.merge_wrenches(
        jnp.stack([x, y]), jnp.stack([s, d]), x[:3]
    ),
    "power": lambda x, y, s, d: spatial.power(x, y),
    "central_axis": lambda x, y, s, d: spatial.central_axis(x),
    "spatial_inertia": lambda x, y, s, d: spatial.spatial_inertia(d[0], s, inertia(s)),
    "mass_properties": lambda x, y, s, d: spatial.mass_properties(
        spatial.spatial_inertia(d[0], s, inertia(s))
    ),
    "parallel_axes": lambda x, y, s, d: spatial.parallel_axes(inertia(s), d[0], d),
    "rotate_inertia": lambda x, y, s, d: spatial.rotate_inertia(so3.exp(d), inertia(s)),
    "transform_properties": lambda x, y, s, d: spatial.transform_properties(
        turn(x), d[0], s, inertia(s)
    ),
    "transform_inertia": lambda x, y, s, d: spatial.transform_inertia(
        turn(x), spatial.spatial_inertia(d[0], s, inertia(s))
    ),
    "momentum": lambda x, y, s, d: spatial.momentum(jnp.outer(x, x), y),
    "kinetic_energy": lambda x, y, s, d: spatial.kinetic_energy(jnp.outer(x, x), y),
    "principal_axes": lambda x, y, s, d: spatial.principal_axes(jnp.diag(d) + 0.1 * inertia(s)),
    "consistency": lambda x, y, s, d: spatial.consistency(d[0], jnp.diag(d) + inertia(s))[3:],
    "check_mass_properties": lambda x, y, s, d: spatial.check_mass_properties(d[0], s, inertia(s)),
    "pseudo_inertia": lambda x, y, s, d: spatial.pseudo_inertia(d[0], s, inertia(s)),
    "from_pseudo_inertia": lambda x, y, s, d: spatial.from_pseudo_inertia(
        jnp.outer(x[:4], x[:4]) + 3 * jnp.eye(4, dtype=x.dtype)
    ),
    "ellipsoid_margin": lambda x, y, s, d: spatial.ellipsoid_margin(d[0], s, inertia(s), d, s + d),
}
SHAPES = {
    "box": lambda x, y, s, d: shapes.box(d, density=2.0),
    "capsule": lambda x, y, s, d: shapes.capsule(d[0], d[1], mass=d[2]),
    "combine": lambda x, y, s, d: shapes.combine(
        [shapes.box(d, density=2.0), shapes.sphere(d[0], density=1.0)]
    ),
    "cone": lambda x, y, s, d: shapes.cone(d[0], d[1], density=d[2]),
    "cylinder": lambda x, y, s, d: shapes.cylinder(d[0], d[1], density=d[2]),
    "ellipsoid": lambda x, y, s, d: shapes.ellipsoid(d, mass=d[0]),
    "hole": lambda x, y, s, d: shapes.hole(shapes.box(d, mass=1.0)),
    "mesh": lambda x, y, s, d: shapes.mesh(
        jnp.concatenate([jnp.zeros((1, 3), d.dtype), jnp.diag(d)]), TETRAHEDRON, density=2.0
    ),
    "plate": lambda x, y, s, d: shapes.plate(d[:2], mass=d[2]),
    "points": lambda x, y, s, d: shapes.points(jnp.stack([s, d, x[:3]]), d),
    "rod": lambda x, y, s, d: shapes.rod(d[0], mass=d[1]),
    "sphere": lambda x, y, s, d: shapes.sphere(d[0], mass=d[1]),
    "tube": lambda x, y, s, d: shapes.tube(d[0] + d[1], d[0], d[2], mass=1.0),
}
OPERATORS = {
    "double_cross": lambda x, y, s, d: operators.double_cross(s, d),
    "cross_of_cross": lambda x, y, s, d: operators.cross_of_cross(s, d),
    "triple_cross": lambda x, y, s, d: operators.triple_cross(s, d),
    "cross_power": lambda x, y, s, d: operators.cross_power(s, 5),
    "rotated_cross": lambda x, y, s, d: operators.rotated_cross(so3.exp(s), d),
    "congruent_cross": lambda x, y, s, d: operators.congruent_cross(
        jnp.outer(s, d) + jnp.eye(3, dtype=s.dtype), d
    ),
    "cross_sum": lambda x, y, s, d: operators.cross_sum(jnp.outer(s, d), d),
    "along": lambda x, y, s, d: operators.along(s),
    "across": lambda x, y, s, d: operators.across(s),
    "triple_product": lambda x, y, s, d: operators.triple_product(s, d, x[:3]),
    "double_cross_product": lambda x, y, s, d: operators.double_cross_product(s, d, x[:3]),
    "motion_transform_rate": lambda x, y, s, d: operators.motion_transform_rate(turn(x), y),
    "force_transform_rate": lambda x, y, s, d: operators.force_transform_rate(turn(x), y),
}
LAGRANGE = {
    "mass_matrix": lambda x, y, s, d: lagrange.mass_matrix(SYSTEM, x[:2]),
    "christoffel_symbols": lambda x, y, s, d: lagrange.christoffel_symbols(SYSTEM, x[:2]),
    "coriolis_matrix": lambda x, y, s, d: lagrange.coriolis_matrix(SYSTEM, x[:2], y[:2]),
    "gravity_forces": lambda x, y, s, d: lagrange.gravity_forces(SYSTEM, x[:2]),
    "damping_forces": lambda x, y, s, d: lagrange.damping_forces(SYSTEM, x[:2], y[:2]),
    "bias_forces": lambda x, y, s, d: lagrange.bias_forces(SYSTEM, x[:2], y[:2]),
    "acceleration": lambda x, y, s, d: lagrange.acceleration(SYSTEM, x[:2], y[:2], s[:2]),
    "generalized_forces": lambda x, y, s, d: lagrange.generalized_forces(
        SYSTEM, x[:2], y[:2], s[:2]
    ),
    "energy": lambda x, y, s, d: lagrange.energy(SYSTEM, x[:2], y[:2]),
    "term": lambda x, y, s, d: lagrange.term(SYSTEM).vf(0.0, (x[:2], y[:2]), None),
}
PARTICLES = {
    "constrained_acceleration": lambda x, y, s, d: particles.constrained_acceleration(
        d[:2], x.reshape(2, 3), y.reshape(2, 3), jnp.stack([s, d]), ball, d[2]
    )[:3],
    "constraint_error": lambda x, y, s, d: particles.constraint_error(
        ball, d[0], x.reshape(2, 3), y.reshape(2, 3)
    ),
    "reduced_acceleration": lambda x, y, s, d: particles.reduced_acceleration(
        d[:1], lambda t, q: point(q)[None] * t, s[None], d[:2], y[:2], d[2]
    ),
    "term": lambda x, y, s, d: particles.term(d[:2], lambda t, x, v: -v, ball).vf(
        0.3, (x.reshape(2, 3), y.reshape(2, 3)), None
    ),
}
RELATIVE = {
    "moving_frame": lambda x, y, s, d: rm.moving_frame(lambda t: se3.exp(t * x + t * t * y), d[0]),
    "position": lambda x, y, s, d: rm.position(frame(x), s),
    "velocity": lambda x, y, s, d: rm.velocity(frame(x), s, d),
    "acceleration_terms": lambda x, y, s, d: rm.acceleration_terms(frame(x), s, d, y[:3]),
    "acceleration": lambda x, y, s, d: rm.acceleration(frame(x), s, d, y[:3]),
    "apparent_forces": lambda x, y, s, d: rm.apparent_forces(frame(x), s, d),
    "relative_acceleration": lambda x, y, s, d: rm.relative_acceleration(frame(x), s, d, y[:3]),
    "compose": lambda x, y, s, d: rm.compose(frame(x), frame(y)),
    "inverse": lambda x, y, s, d: rm.inverse(frame(x)),
}
WORK = {
    "of_forces": lambda x, y, s, d: virtual_work.of_forces(point, s, x[:2]),
    "of_wrench": lambda x, y, s, d: virtual_work.of_wrench(turn, y, x),
}
ONE_BODY = {
    "ellipsoid_added_mass": lambda x, y, s, d: body.ellipsoid_added_mass(d, 2.0),
    "hamel_acceleration": lambda x, y, s, d: body.hamel_acceleration(
        lambda q, nu: (1 + q @ q) * nu @ nu / 2,
        lambda q, v: jnp.exp(q) * v,
        lambda q, nu: nu / jnp.exp(q),
        s, d, x[:3],
    ),
    "inertia_matrix": lambda x, y, s, d: body.inertia_matrix(situation(s).body),
    "kinetic_energy": lambda x, y, s, d: body.kinetic_energy(situation(s).body, x),
    "potential_energy": lambda x, y, s, d: body.potential_energy(situation(s), turn(x)),
    "rigid_body": lambda x, y, s, d: body.rigid_body(shapes.box(d, mass=1.0)).body[:3],
    "total_wrench": lambda x, y, s, d: body.total_wrench(situation(s), 0.0, turn(x), y),
}  # fmt: skip
ELSEWHERE = {"formulation", "formulations"}  # names, not numbers: tests/body/test_formulations.py
ROOMS = {
    spatial: SPATIAL, shapes: SHAPES, operators: OPERATORS, lagrange: LAGRANGE,
    particles: PARTICLES, rm: RELATIVE, virtual_work: WORK, body: ONE_BODY,
}  # fmt: skip


def samples():
    rng = np.random.default_rng(0)
    return (
        rng.normal(size=(3, 6)), rng.normal(size=(3, 6)), rng.normal(size=(3, 3)),
        rng.uniform(0.5, 1.5, (3, 3)),
    )  # fmt: skip


HEAVY = (spatial, rm, virtual_work)  # programs of a minute together


@pytest.mark.parametrize(
    "room",
    [pytest.param(room, marks=pytest.mark.slow if room in HEAVY else ()) for room in ROOMS],
    ids=lambda room: room.__name__,
)
def test_composes(room) -> None:
    def all_of(*x):
        return {
            name: jnp.concatenate([jnp.ravel(a) for a in jax.tree.leaves(f(*x))])
            for name, f in ROOMS[room].items()
        }

    xs = samples()
    rng = np.random.default_rng(1)
    tangents = tuple(rng.normal(size=x.shape[1:]) for x in xs)

    @jax.jit
    def everything(xs, tangents, weights):
        first = tuple(x[0] for x in xs)
        mapped = jax.vmap(all_of)(*xs)
        rate = jax.jvp(all_of, first, tangents)[1]
        return mapped, rate, jax.vjp(all_of, *first)[1](weights)

    @jax.jit
    def ends(xs, tangents):
        def at(side):
            moved = (x[0] + side * 6e-6 * t for x, t in zip(xs, tangents, strict=True))
            return all_of(*moved)

        return jax.tree.map(lambda a, b: (a - b) / 12e-6, at(1.0), at(-1.0))

    one = jax.jit(all_of)  # a loop instead of vmap
    door = {name: np.asarray(x) for name, x in one(*(x[1] for x in xs)).items()}
    weights = {name: rng.normal(size=x.shape) for name, x in door.items()}
    mapped, rate, gradient = everything(xs, tangents, weights)
    differences = ends(xs, tangents)
    for name, want in door.items():
        assert relative_error(mapped[name][1], want) <= F64_TRANSFORM, name
        assert relative_error(rate[name], differences[name], floor=1.0) <= GRADIENT, name
    forward = sum((weights[name] * rate[name]).sum() for name in door)
    reverse = sum((g * t).sum() for g, t in zip(gradient, tangents, strict=True))
    scale = sum(np.abs(weights[name] * rate[name]).sum() for name in door)
    assert abs(forward - reverse) <= 1e-12 * scale


def test_no_public_function_is_missing() -> None:
    for room, entries in ROOMS.items():
        if hasattr(room, "__all__"):
            names = {n for n in room.__all__ if inspect.isroutine(getattr(room, n))}
        else:
            members = inspect.getmembers(room, inspect.isroutine)
            names = {n for n, f in members if f.__module__ == room.__name__ and n[0] != "_"}
        missing = names - entries.keys() - ELSEWHERE
        assert not missing, f"give {sorted(missing)} of {room.__name__} an entry"
