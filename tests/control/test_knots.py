"""The knots of a problem a thread a column, beside a thread a knot."""

import functools
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.control import Control, Cost, Problem, StateError
from rbjax.control.optimal.objective import no_multipliers
from rbjax.control.optimal.problem import BODY, NEXT, Knot
from rbjax.control.optimal.shooting.expansion import Expanded, columns, expand, knot_indices
from tests.tolerances import F64_TRANSFORM, relative_error

function = importlib.import_module("rbjax.compiler.jax.function")
N = 4


def given() -> tuple[Problem, rb.State, Knot, jax.Array]:
    """A problem with a number that is found too, and knots that are off its dynamics."""
    model = rb.load("double_pendulum")
    goal = StateError(model.default_state())
    problem = Problem(
        model, N, 0.05, running=[Cost(Control(), 0.1), Cost(goal, 2.0)],
        terminal=[Cost(goal, 10.0)], free_time=(0.1, 0.5),
    )  # fmt: skip
    rng = np.random.default_rng(0)
    q, v = (jnp.asarray(rng.normal(size=(N + 1, 2))) for _ in range(2))
    knots = Knot(rb.State(q, v), jnp.full((N + 1, 1), 0.2))
    start = rb.State(q[0] + 0.1, v[0])
    return problem, start, knots, jnp.asarray(rng.normal(size=(N, problem.nu)))


def test_columns_are_those_of_the_linearised_step() -> None:
    problem, _, knots, ctrls = given()
    ks = knot_indices(N, ctrls.dtype)
    A, B, gaps = jax.jit(jax.vmap(lambda k, u: columns(problem, k, knots, u)))(ks, ctrls)
    body, after = (jax.tree.map(lambda x, at=at: x[at], knots) for at in (BODY, NEXT))
    due = jax.jit(jax.vmap(problem.linear))(ks, body, ctrls)
    apart = jax.vmap(problem.minus)(due.after, after)
    for got, want in ((A, due.A), (B, due.B), (gaps, apart)):
        assert relative_error(got, want) < F64_TRANSFORM


@pytest.mark.parametrize("samples", [1, 1000])
def test_few_knots_go_apart_on_a_gpu(samples: int, monkeypatch: pytest.MonkeyPatch) -> None:
    problem, start, knots, ctrls = given()
    multipliers = no_multipliers(N, 0, 0, ctrls.dtype)
    run = functools.partial(expand, problem)
    due: Expanded = jax.jit(run)(start, knots, ctrls, multipliers)
    monkeypatch.setattr(function, "has_gpu", lambda: True)
    args = start, knots, ctrls, multipliers
    wide = jax.tree.map(lambda x: jnp.broadcast_to(x, (samples, *x.shape)), args)
    closed = jax.make_jaxpr(jax.vmap(run))(*wide)
    found = [e.params for e in closed.jaxpr.eqns if e.primitive.name == "threads"]
    first = next(p for p in found if p["batch"] == (samples, N))
    assert (first["program"].multi_kernel is not None) == (samples == 1)
    if samples > 1:
        return
    by_gpu = importlib.import_module("rbjax.compiler.jax.primitive").on_gpu
    known = dict(zip(closed.jaxpr.constvars, closed.consts, strict=True))
    known |= dict(zip(closed.jaxpr.invars, jax.tree.leaves(wide), strict=True))

    def read(atom):
        return atom.val if isinstance(atom, jax.extend.core.Literal) else known[atom]

    for eqn in closed.jaxpr.eqns:
        ins = [read(x) for x in eqn.invars]
        if eqn.params is first:
            outs = by_gpu(*ins, **eqn.params)
        else:
            outs = eqn.primitive.bind(*ins, **eqn.params)
        outs = outs if isinstance(outs, (list, tuple)) else [outs]
        known |= dict(zip(eqn.outvars, outs, strict=True))
    got = [read(x)[0] for x in closed.jaxpr.outvars]
    for x, y in zip(got, jax.tree.leaves(due), strict=True):
        assert relative_error(x, y) < F64_TRANSFORM
