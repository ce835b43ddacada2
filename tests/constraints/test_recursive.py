"""The formulation "recursive": clusters, and the motion, multipliers and derivatives of
`Multipliers`."""

import functools
import json
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.mechanisms import (
    QUIET,
    andrews,
    biped,
    four_bars,
    pendulum,
    spatial_slider_crank,
    tilted_four_bar,
    walker,
)
from rbjax import constraints as rc
from rbjax.constraints.equations.constrained_motion import constrained_motion
from rbjax.constraints.equations.model_rows import rows_of
from rbjax.constraints.equations.projection import project_state
from rbjax.constraints.methods.recursive import Cluster, cluster_problem, find_clusters
from rbjax.dynamics.drivers.choice import driver
from rbjax.forces.context import Context
from rbjax.lanes import Vec3
from rbjax.model import WORLD
from rbjax.spatial import Force
from tests.constraints.test_formulations import hung_twice, skate
from tests.oracles import load
from tests.tolerances import F64_IDENTITY

CASSIE = Path(__file__).parents[3] / "shared" / "data" / "cassie"  # beside the repository


def _arm() -> rb.Model:
    """Rows of all kinds: on the world, on links with forces that do not cancel, couplings, one that
    nothing moves, functions of all coordinates, of time, and of the velocity only."""

    class Still(rc.Constraint):
        size = 1

        def rows(self, context):
            return [rc.time(context) * 0.0]

    class Weighed(rc.Constraint):
        size = 1

        def rows(self, context):
            a, b, c = (rc.distance(context.body(0), context.body(k)) for k in names[1:4])
            return [a * b + c * 0.3]

    model = rb.load("arm7")
    names, joints = model.body_names, model.joint_names
    weights = jnp.linspace(-1.0, 1.0, model.nv)[None]
    return model.with_constraints(
        rc.Inplane.between(model, None, names[-1], point=[0.2, 0.1, 0.5], axis=[1.0, 2.0, 3.0]),
        rc.Distance(*rc.places(model, names[1], names[5], point=[0.1, 0.0, 0.3]), 0.4),
        rc.JointPolynomial(joints[1], joints[4], [0.1, 2.0]),
        Still(),
        Weighed(),
        rc.Pfaffian(lambda t, q: weights * jnp.cos(q)),
    )


def _of(pair: tuple[rb.Model, rb.State]) -> tuple[rb.Model, jax.Array]:
    return pair[0], pair[1].q


def _andrews() -> tuple[rb.Model, jax.Array]:
    figures = load("loops")["andrews"]
    return _of(andrews(figures["parameters"], figures["q0"]))


def _at_rest(model: rb.Model) -> tuple[rb.Model, jax.Array]:
    return model, model.default_state().q


#: name -> model, q, and whether its rows are independent
MECHANISMS = {
    "pendulum": (lambda: (pendulum(), jnp.array([0.6, -0.8])), True),
    "four_bars": (lambda: _of(four_bars(2)), False),
    "tilted_four_bar": (lambda: _at_rest(tilted_four_bar("0.8 0.3 -0.2 0.4")), False),
    "hung_twice": (lambda: _at_rest(hung_twice()), False),
    "skate": (lambda: (skate(), skate().default_state().q + 0.4), True),
    "slider_crank": (lambda: _of(spatial_slider_crank()), True),
    "andrews": (_andrews, False),
    "four_bar": (lambda: _at_rest(rb.load("four_bar")), False),
    "gripper": (lambda: _at_rest(rb.load("gripper")), False),
    "delta": (lambda: _at_rest(rb.load("delta")), True),
    "stewart": (lambda: _at_rest(rb.load("stewart")), True),
    "biped": (lambda: _of(biped()), True),
}
SLOW = ("delta", "stewart", "andrews", "four_bars", "hung_twice", "slider_crank")
FEW = [pytest.param(x, marks=pytest.mark.slow if x in SLOW else ()) for x in MECHANISMS]


def found_clusters(model: rb.Model) -> list[Cluster]:
    found: list[Cluster] = []

    def traced(q, v):
        context = Context.of(model, 0.0, rb.State(q, v), None, d=driver(model, q.dtype))
        found.extend(find_clusters(model.topology, rows_of(model, context)))

    start = model.default_state()
    jax.eval_shape(traced, start.q, start.v)
    return found


def crane() -> tuple[rb.Model, jax.Array]:
    """Two links on a carrier that turns, and a row between it and the last whose forces cancel
    only where the two points meet; there they do not."""

    class Across(rc.Constraint):
        size = 1

        def rows(self, context):
            ends = (context.body(x).at([0.1, 0.0, 0.3]) for x in ("carrier", "jib"))
            return rc.displacement(*ends)[:1]

    arm = '<body name="{0}" pos="0.5 0 0.1"><joint axis="{1}"/><geom size="0.1" pos="0.2 0.1 0"/>'
    links = ("carrier", "0 0 1"), ("boom", "0 1 0.1"), ("jib", "0.2 1 0")
    bodies = "".join(arm.format(*x) for x in links) + "</body>" * 3
    model = rb.load(f"<mujoco>{QUIET}<worldbody>{bodies}</worldbody></mujoco>")
    model = model.with_constraints(Across()).replace(driver="unrolled")
    return model, jnp.array([0.2, 0.5, -0.7])


def leg() -> tuple[rb.Model, jax.Array]:
    """One leg on a pelvis that turns."""
    model, start = walker([0.1], '<joint axis="1 0.3 0.2"/>')
    return model.replace(driver="unrolled"), start.q


def both(model: rb.Model, q, v, tau, f_ext=None, t=0.0):
    """a and l of "multipliers", and of recursion."""
    given = model, t, rb.State(q, v), tau, f_ext or {}
    return constrained_motion(*given), constrained_motion(*given, method=cluster_problem)


def drawn(model: rb.Model, seed: int = 5) -> tuple[jax.Array, jax.Array]:
    return tuple(jax.random.normal(k, (model.nv,)) for k in jax.random.split(jax.random.key(seed)))


def consistent(model: rb.Model, q: jax.Array, v: jax.Array) -> jax.Array:
    return project_state(model, 0.0, rb.State(q, v), positions=False).v


def off(got, want) -> float:
    return np.abs(got - want).max() / max(1.0, np.abs(want).max())


@pytest.mark.parametrize("name", FEW)
def test_one_motion(name: str) -> None:
    make, independent = MECHANISMS[name]
    model, q = make()
    model = model.replace(driver="unrolled")
    v, tau = drawn(model)

    def motions(v):
        v = consistent(model, q, v)
        return both(model, q, v, tau)

    (a, l), (own, multipliers) = jax.jit(motions)(v)
    assert np.abs(a).max() > 1e-3
    assert off(own, a) < 1e-10
    if independent:
        assert off(multipliers, l) < 1e-10


def test_clusters_of_a_biped() -> None:
    """Each leg is one, and both hang on the last link of the pelvis."""
    model, _ = biped()
    links = model.topology.body_links
    pelvis = links[model.body("pelvis")]
    both_legs = found_clusters(model)
    assert len(both_legs) == 2
    for k, found in enumerate(both_legs):
        shank, rod = (links[model.body(f"{name}{k}")] for name in ("shank", "rod"))
        assert found.parent == pelvis
        assert found.links == {shank - 1, shank, rod - 2, rod - 1, rod}
        assert found.rows == (3 * k, 3 * k + 1, 3 * k + 2)


def test_clusters_of_rows_of_all_kinds() -> None:
    model = _arm()
    alone = [found_clusters(model.replace(constraints=(x,)))[0] for x in model.constraints]
    places = [(x.parent, sorted(x.links)) for x in alone]
    assert places == [
        (WORLD, list(range(7))),
        (0, [1, 2, 3, 4]),  # from one body to the other
        (0, [1, 2, 3, 4]),  # from one joint to the other, both included
        (WORLD, []),
        (WORLD, [0, 1, 2]),  # one of its places is on the world
        (WORLD, list(range(7))),
    ]
    assert [len(x.rows) for x in found_clusters(model)] == [1, 5]
    names = model.body_names
    screw = rc.Screw.between(model, names[3], names[5], pitch=0.1)  # rows times rows
    (found,) = found_clusters(model.replace(constraints=(screw,)))
    assert found == Cluster(2, frozenset({3, 4}), (0, 1, 2, 3, 4))


def test_rows_of_all_kinds_with_forces_on_links() -> None:
    """Off the constraints, too."""
    model = _arm().replace(driver="unrolled")
    state = model.random_state(jax.random.key(2))
    v, tau = drawn(model)
    f_ext = {2: Force(Vec3(1.0, -2.0, 0.5), Vec3(3.0, 0.1, -4.0)), 6: Force.zero()}
    (a, l), (own, multipliers) = jax.jit(functools.partial(both, model))(state.q, v, tau, f_ext)
    assert off(own, a) < 1e-10 and off(multipliers, l) < 1e-10


@pytest.mark.parametrize("make", [crane, pytest.param(leg, marks=pytest.mark.slow)])
def test_loops_that_are_open(make) -> None:
    """Forces of their rows do not cancel at the parent."""
    model, q = make()
    v, tau = drawn(model)
    q = rb.integrate(model, q, 0.3 * tau)
    assert np.abs(rc.residual(model, rb.State(q, v)).value).max() > 0.05
    (found,) = found_clusters(model)
    assert found.parent == 0
    (a, l), (own, multipliers) = jax.jit(functools.partial(both, model))(q, v, tau)
    assert off(own, a) < 1e-10 and off(multipliers, l) < 1e-10


@pytest.mark.parametrize("make", [crane, pytest.param(leg, marks=pytest.mark.slow)])
def test_derivatives(make) -> None:
    """By configuration, velocity, force and mass: those of `Multipliers`; reverse is forward."""
    model, q0 = make()
    v, tau = drawn(model)
    w, dq = drawn(model, 6)

    def of(one, s, tau):
        heavy = model.replace(bodies=model.bodies.replace(mass=model.bodies.mass * (1 + s)))
        q = rb.integrate(model, q0, s * dq)
        return one(heavy, 0.0, rb.State(q, v + s * w), tau, {})

    def slopes():
        forms = rc.Multipliers(), rc.Recursive()
        forward = [jax.jvp(functools.partial(of, x), (0.0, tau), (1.0, w))[1] for x in forms]
        return forward, jax.vjp(functools.partial(of, rc.Recursive()), 0.0, tau)[1](w)

    (want, got), (by_s, by_tau) = jax.jit(slopes)()
    assert off(got, want) < 1e-10
    size = max(1.0, np.abs(w * got).max())
    assert abs(by_s + by_tau @ w - w @ got) < F64_IDENTITY * size


def test_batches() -> None:
    model, q = crane()
    v, tau = jax.random.normal(jax.random.key(4), (2, 3, model.nv))

    def own(v, tau):
        return rc.Recursive()(model, 0.0, rb.State(q, v), tau, {})

    each = jax.jit(own)
    want = [each(*x) for x in zip(v, tau, strict=True)]
    assert off(jax.jit(jax.vmap(own))(v, tau), np.stack(want)) < 1e-13


@pytest.mark.parametrize("name", ["limbs", pytest.param("rolled", marks=pytest.mark.slow)])
def test_drivers(name: str) -> None:
    model, start = biped()
    v, tau = drawn(model)

    def own(name):
        return rc.Recursive()(model.replace(driver=name), 0.0, rb.State(start.q, v), tau, {})

    got, want = jax.jit(lambda: (own(name), own("unrolled")))()
    assert off(got, want) < 1e-10


def test_a_cluster_of_many_rows_is_solved_on_matrices() -> None:
    model = rb.load("double_pendulum")
    gear = rc.JointPolynomial("shoulder", "elbow", [0.1, 2.0])
    model = model.with_constraints(*[gear] * 25).replace(driver="unrolled")
    v, tau = drawn(model)
    q = model.default_state().q + 0.3
    (a, _), (own, _) = jax.jit(functools.partial(both, model))(q, v, tau)
    assert off(own, a) < 1e-10


def operations(model: rb.Model, one: rc.Method) -> int:
    start = model.default_state()
    v = jnp.ones(model.nv)
    return rb.operation_count(lambda v: one(model, 0.0, rb.State(start.q, v), v, {}), v).total


@pytest.mark.slow
def test_operations() -> None:
    model = biped()[0].replace(driver="unrolled")
    by_rows, own = (operations(model, one) for one in (rc.Multipliers(), rc.Recursive()))
    assert own < by_rows


@pytest.mark.slow
def test_a_leg_more_costs_a_leg() -> None:
    def of(legs: int) -> int:
        model, _ = walker([0.1, -0.15, 0.3][:legs], '<joint axis="1 0.3 0.2"/>')
        return operations(model.replace(driver="unrolled"), rc.Recursive())

    one, two, three = map(of, (1, 2, 3))
    assert abs((three - two) - (two - one)) < 0.01 * one


@pytest.mark.slow
def test_cassie() -> None:
    """Loops in loops: the foot's hang on the tarsus, which is in another's."""
    if not CASSIE.exists():
        pytest.skip(f"{CASSIE} is not there")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = rb.load(CASSIE / "cassie.xml").replace(driver="unrolled")
    q = jnp.array(json.loads((CASSIE / "consistent.json").read_text())["qpos"])
    v, tau = drawn(model)
    (a, _), (own, _) = jax.jit(lambda v: both(model, q, consistent(model, q, v), tau))(v)
    assert off(own, a) < 1e-10
    found = found_clusters(model)
    assert sorted(len(x.links) for x in found) == [3, 3, 7, 7]
    large, small = (set().union(*(x.links for x in found if len(x.links) == n)) for n in (7, 3))
    assert all(x.parent in large for x in found if len(x.links) == 3) and not large & small
    assert operations(model, rc.Recursive()) < 0.85 * operations(model, rc.Multipliers())
