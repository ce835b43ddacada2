"""Forces of the contacts in use and their derivatives, against all slots of the narrow phase."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.problem.assemble import Assembly
from rbjax.contact.problem.in_use import wrenches_in_use
from rbjax.contact.problem.problem import Problem, RowsInUse
from rbjax.contact.solver.contact_forces import rows_in_use
from rbjax.model import State
from tests.tolerances import F64_IDENTITY, GRADIENT, relative_error

#: a capsule and a ball that can touch the floor and each other, with four rows a contact
SCENE = """<mujoco><option cone="elliptic"/><worldbody>
<geom type="plane" size="0 0 1" condim="4" friction="0.7 0.02 0.01"/>
<body><freejoint/><geom type="capsule" size="0.1" fromto="-.15 0 0 .15 0 0" mass="2" condim="4"/>
</body>
<body><joint type="slide" axis="0 0 1"/><joint type="slide" axis="1 0 0"/><joint axis="0 1 0"/>
<geom size="0.3" mass="1"/></body></worldbody></mujoco>"""
LOW = [0.0, 0.0, 0.095, 1.0, 0.002, -0.003, 0.05, 0.29, 0.38, 0.2]
#: the number of contacts that are in use
CASES = {"none": 0, "some": 3, "all": 4}


@pytest.fixture(scope="module")
def model() -> rb.Model:
    return rb.load(SCENE)


def state_of(name: str) -> tuple[np.ndarray, np.ndarray]:
    q, v = np.array(LOW), np.random.default_rng(3).normal(size=9)
    q[3:7] /= np.linalg.norm(q[3:7])
    if name == "none":
        q[2], q[7] = 1.0, 3.0
    if name == "some":
        q[8] = 2.0  # the ball touches the floor only
    return q, v


A = np.random.default_rng(4).normal(size=9)


def problem_at(model: rb.Model, q: Any, v: Any) -> tuple[Problem, Any]:
    q, v = jnp.asarray(q), jnp.asarray(v)
    assembly = Assembly(model, q, v)
    return assembly.problem(jnp.zeros_like(v), None), assembly.origin


def in_use_at(model: rb.Model, q: Any, v: Any) -> RowsInUse:
    return problem_at(model, q, v)[0].detect().in_use


def plain(model: rb.Model, q: Any, v: Any, a: Any) -> jax.Array:
    """J^T f of the contacts by a loop over all slots, without derivatives."""
    problem = problem_at(model, q, v)[0].detect()
    twists = problem.tree.twists(jnp.asarray(a), problem.dtype)
    wrenches = jnp.zeros_like(twists)
    for contacts, slots in zip(problem.sets, problem.slots, strict=True):

        def add(k: Any, sums: jax.Array, of: Any = contacts, slots: Any = slots) -> jax.Array:
            row = slots.row(k, of.dim)
            f = of.cone(row).response(of.residual(row, twists)).f
            return of.add_forces(row, sums, f)

        wrenches = slots.fold(add, wrenches)
    return jnp.stack(problem.tree.generalized(wrenches))


def own(model: rb.Model, used: RowsInUse, q: Any, v: Any, a: Any) -> jax.Array:
    problem, _ = problem_at(model, q, v)
    return jnp.stack(problem.constraint_forces(jnp.asarray(a), used))


@pytest.mark.parametrize("name", CASES)
def test_forces_and_numbers(model: rb.Model, name: str) -> None:
    """The forces are those of all slots; a candidate that is not in use has no numbers."""
    q, v = state_of(name)
    used = jax.jit(lambda: in_use_at(model, q, v))()
    assert sum(int(x.length) for x in used.contacts) == CASES[name]
    found = jax.jit(lambda u: own(model, u, q, v, A))(used)
    want = jax.jit(lambda: plain(model, q, v, A))()
    assert relative_error(found, want, floor=1.0) < F64_IDENTITY
    assert (jnp.abs(want).max() > 1.0) == (name != "none")

    @jax.jit
    def numbers(used: RowsInUse) -> tuple[jax.Array, list[jax.Array]]:
        problem, origin = problem_at(model, q, v)
        rows, forces = rows_in_use(problem, used, jnp.asarray(A), origin)
        twists = problem.tree.twists(jnp.asarray(A), problem.dtype)
        parts = [
            wrenches_in_use(
                of, problem.touching, twists, x, lambda of, row, f, r: jnp.stack([row.D, *r[:2]]), 3
            )[1]
            for of, x in zip(problem.sets, used.contacts, strict=True)
        ]
        return rows, parts, jnp.stack(forces)

    rows, parts, forces = numbers(used)
    assert relative_error(forces, want, floor=1.0) < F64_IDENTITY
    assert (rows[:, 0] > 0).sum() == CASES[name]
    start = 0
    for x, part in zip(used.contacts, parts, strict=True):
        there = np.isin(np.arange(len(part)), np.asarray(x.candidates)[: int(x.length)])
        assert (part[there, 0] > 0).all() and (part[~there] == 0).all()
        assert (there == np.asarray(rows[start : start + len(part), 0] > 0)).all()
        start += len(part)
    assert start == len(rows) == CASES["all"]


def scaled(model: rb.Model, friction: Any, size: Any) -> rb.Model:
    geoms = model.geoms
    return model.replace(
        geoms=geoms.replace(friction=geoms.friction * friction, size=geoms.size * size)
    )


@pytest.mark.parametrize("name", CASES)
def test_derivatives(model: rb.Model, name: str) -> None:
    """In both modes by configuration, velocity, acceleration, friction and size, against
    differences of the plain forces."""
    q, v = state_of(name)
    used = jax.jit(lambda: in_use_at(model, q, v))()
    at = (jnp.zeros(9), jnp.asarray(v), jnp.asarray(A), jnp.ones(()), jnp.ones(()))

    def moved(f: Any) -> Any:
        def along(dx: Any, v: Any, a: Any, friction: Any, size: Any) -> jax.Array:
            return f(scaled(model, friction, size), rb.integrate(model, jnp.asarray(q), dx), v, a)

        return along

    f = moved(lambda m, q, v, a: own(m, used, q, v, a))
    run = jax.jit(moved(plain))
    keys = jax.random.split(jax.random.key(1), len(at))
    to = tuple(jax.random.normal(k, x.shape) for k, x in zip(keys, at, strict=True))
    rate = jax.jit(lambda to: jax.jvp(f, at, to)[1])(to)
    h = 1e-7
    ends = [run(*(x + s * h * y for x, y in zip(at, to, strict=True))) for s in (1, -1)]
    assert relative_error(rate, (ends[0] - ends[1]) / (2 * h), floor=1.0) < 10 * GRADIENT
    w = jax.random.normal(jax.random.key(2), (9,))
    back = jax.jit(lambda w: jax.vjp(f, *at)[1](w))(w)
    both = sum(jnp.vdot(x, y) for x, y in zip(back, to, strict=True))
    assert relative_error(both, jnp.vdot(w, rate), floor=1.0) < F64_IDENTITY


def test_batches_and_dtypes(model: rb.Model) -> None:
    """Samples with different numbers of contacts: 0, 1 and 3 of them, as threads and under XLA, in
    both precisions."""

    def slope(model: rb.Model, a: Any) -> Any:
        def one(q: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
            used = in_use_at(model, q, v)
            loss = lambda q: own(model, used, q, v, a.astype(q.dtype)).sum()  # noqa: E731
            return jax.value_and_grad(loss)(q)

        return one

    states = [jnp.stack(x) for x in zip(*map(state_of, CASES), strict=True)]
    one = slope(model, A)
    want = [jax.jit(one)(q, v) for q, v in zip(*states, strict=True)]
    assert (want[0][1] == 0).all() and jnp.abs(want[2][1]).max() > 1.0
    for f in (one, rb.threads(one)):
        g = jax.jit(jax.vmap(f))
        for size in (0, 1, 3):
            found = g(*(x[:size] for x in states))
            assert found[1].shape == (size, 10)
            for k in range(size):
                for a, b in zip(found, want[k], strict=True):
                    assert relative_error(a[k], b, floor=1.0) < F64_IDENTITY
    single = jax.jit(jax.vmap(slope(model.astype(jnp.float32), A)))
    found = single(*(x.astype(jnp.float32) for x in states))
    assert found[1].dtype == jnp.float32
    for k in range(3):
        assert relative_error(found[1][k], want[k][1], floor=1.0) < 2e-3


def test_without_contacts_there_is_no_force() -> None:
    """A model whose law has limits only."""
    text = """<mujoco><worldbody><body><joint axis="0 1 0" range="-10 10"/>
      <geom size="0.1" mass="1"/></body></worldbody></mujoco>"""
    limited = rb.load(text)
    q, v = np.array([0.3]), np.array([1.0])
    used = in_use_at(limited, q, v)
    assert used.contacts == [] and int(used.limits.length) == 1
    push = own(limited, used, q, v, np.zeros(1))
    solved = rb.contact.solve(limited, State(jnp.asarray(q), jnp.asarray(v)))
    assert push[0] < 0 and solved.limit[0] < 0
