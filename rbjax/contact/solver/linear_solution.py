"""Solution of H x = b with the Hessian H at a solution of the contact problem, for derivatives.

    H = H_0 + C,    C = J^T s'' J

J is the Jacobian of the contacts between two links of a tree, and s'' the Hessians of their costs.
H_0 is the Hessian without them, of which the factors are known. If there are such contacts,
conjugate gradients solve the equation, as in a step of Newton's method. Factors, contacts and
residuals are named, so that a reverse derivative saves them. A second derivative, in forward mode,
follows from x = H_0^-1 (b - C x):

    dx = r - H^-1 C r,    r = d[H_0^-1 (b - C x)] with x held constant
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from rbjax.compiler.jax.function import trace
from rbjax.compiler.jax.primitive import run
from rbjax.compiler.jax.programs import Moving, traced
from rbjax.compiler.jax.uniform import split_results
from rbjax.contact.problem.contact_rows import Found, Slots
from rbjax.contact.problem.problem import Problem
from rbjax.contact.solver.conjugate_gradients import products, solve_direction
from rbjax.contact.solver.newton import Solution, factorize_at
from rbjax.dynamics.tracing.custom_rules import jvp_of, with_jvp
from rbjax.lanes import pack, unpack


def linear_solver(problem: Problem, solution: Solution) -> Callable[[jax.Array], jax.Array]:
    """Return the function b -> H^-1 b (nv,) with the Hessian at a solution."""
    factors = factorize_at(problem, solution)
    if not any(x.coupled for x in problem.sets):
        return factors.solve
    saved = [_saved(*x) for x in zip(problem.slots, solution.residuals, strict=True)]
    problem = replace(problem, slots=[slots for slots, _ in saved])
    residuals = [x for _, x in saved]

    def parts(b: jax.Array, x: jax.Array) -> list[jax.Array]:
        Cx = _stiffness(problem, residuals, x)
        solution = solve_direction(problem, factors, b, residuals).x
        return [solution, factors.solve(b - Cx), Cx]

    return lambda b: _self_adjoint_solution(parts, b)


def _saved(slots: Slots, residuals: jax.Array) -> tuple[Slots, jax.Array]:
    """Name the active contacts of a set and their residuals, so that derivatives save them."""
    found = slots.found
    given = found.length, found.pairs, found.candidates, slots.rows, residuals
    length, pairs, candidates, rows, residuals = (
        checkpoint_name(jnp.asarray(x), "contacts") for x in given
    )
    places = jnp.zeros_like(found.contacts)  # not read
    return slots._replace(found=Found(length, places, pairs, candidates), rows=rows), residuals


def _stiffness(problem: Problem, residuals: Sequence[jax.Array], x: jax.Array) -> jax.Array:
    """Compute C x (nv,)."""
    tree, dtype = problem.tree, problem.dtype
    twists, wrenches = tree.twists(x, dtype), jnp.zeros((len(tree.touching) + 1, 6), dtype)
    for contacts, slots, r in zip(problem.sets, problem.slots, residuals, strict=True):
        if not contacts.coupled:
            continue

        def push(k: Any, out: Any, of: Any = contacts, slots: Any = slots, r: Any = r) -> Any:
            row = slots.row(k, of.dim)
            change = products(of.cone(row).response(unpack(r[k])).H, of.rates(row, twists))
            return of.add_forces(row, out, change)

        wrenches = slots.fold(push, wrenches)
    return pack(tree.generalized(wrenches), x)


def _self_adjoint_solution(parts: Callable, b: jax.Array) -> jax.Array:
    """Compute H^-1 b as a program that is its own transpose.

    parts: function (b, x) -> H^-1 b, H_0^-1 (b - C x), C x.
    """
    plain, closed_over = trace(parts, [b, b])
    n, inputs = len(closed_over), plain.inputs[:-1]
    solution, fixed_point, stiffness = split_results(plain, 3)

    def solve(*args: jax.Array) -> jax.Array:
        return solution(*args, args[-1])[0]  # x is not read

    def rule(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
        x = solve(*primals)
        _, r = jvp_of(lambda *args: fixed_point(*args, x)[0], primals, tangents)
        if r is None:
            return x, jnp.zeros_like(x)
        return x, r - with_rule(*primals[:n], stiffness(*primals, r)[0])

    with_rule = with_jvp(solve, rule)

    def vjp(moving: Moving, args: Any, _: Any, bars: Any) -> list[jax.Array]:
        if any(moving[:n]):  # a second derivative in reverse mode: JAX cannot transpose the loops
            return run(solution.transposed((*moving, False), (True,)), [*args, args[-1], *bars])
        return run(program, [*args[:n], *bars])

    program = replace(traced(lambda *args: [with_rule(*args)], *inputs), vjp=vjp)
    return run(program, [*closed_over, b])[0]
