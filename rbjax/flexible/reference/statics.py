"""Equilibrium of a beam along a path of dead loads."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiling import compiler_options
from rbjax.errors import InputError, RbjaxError
from rbjax.flexible.reference.assembly import newton
from rbjax.flexible.reference.mesh import Mesh, Supports


class Equilibria(NamedTuple):
    """Result of `solve_static`.

    mesh: the `Mesh` at the last load.
    q: coordinates of the nodes at every load, (loads, nodes, c).
    iterations: of Newton's method at every load, (loads,).
    """

    mesh: Mesh
    q: jax.Array
    iterations: jax.Array


def solve_static(
    mesh: Mesh, wrenches: Any, supports: Supports, increments: Any | None = None
) -> Equilibria:
    """Find the equilibria of a beam under a sequence of dead loads, each from the one before.

    wrenches: force and moment on each node, (loads, nodes, 6), N and N m, world axes.
    supports: fixed dofs, from `Formulation.supports`.
    increments: prescribed increments of fixed dofs at each load, (loads, nodes, d); zero if None.
    Raises RbjaxError if Newton's method fails: more loads on the way help.

    >>> import rbjax.flexible.reference as rf
    >>> from rbjax.flexible import section
    >>> rod = section([1.0, 1.0, 1.0, 1e4, 1e4, 1e4], 1.0, [0.0, 0.0, 0.0])
    >>> beam = rf.Reissner()
    >>> mesh = beam.build(rf.line(), 1.0, rod, 4)
    >>> loads = np.zeros((1, 5, 6))
    >>> loads[0, -1, 5] = 0.5  # a moment on the tip turns it by M L / EI
    >>> tip = rf.solve_static(mesh, loads, beam.supports(mesh)).q[-1, -1]
    >>> f"{2 * np.arctan2(tip[6], tip[3]):.6f}"
    '0.500000'
    """
    wrenches, d = jnp.asarray(wrenches, float), mesh.formulation.d
    nodes = len(mesh.q)
    if wrenches.ndim != 3 or wrenches.shape[1:] != (nodes, 6):
        raise InputError(f"wrenches is {wrenches.shape}. Expected (loads, {nodes}, 6).")
    shape = (len(wrenches), nodes, d)
    increments = jnp.zeros(shape) if increments is None else jnp.asarray(increments, float)
    if increments.shape != shape:
        raise InputError(f"increments is {increments.shape}. Expected {shape}.")
    free = np.flatnonzero(~supports.fixed)
    mesh, q, iterations, success = _solve(mesh, wrenches, increments, free, supports.basis)
    if not success.all():
        at = int(jnp.argmin(success))
        raise RbjaxError(
            f"Newton's method did not converge at load {at + 1} of {len(wrenches)} for "
            f"{mesh.formulation.name}. Give more loads on the way."
        )
    return Equilibria(mesh, q, iterations)


@partial(jax.jit, compiler_options=compiler_options())
def _solve(
    mesh: Mesh, wrenches: jax.Array, increments: jax.Array, free: jax.Array, basis: jax.Array
) -> tuple:
    of = mesh.formulation

    def element(data: Any, history: Any, q: jax.Array, delta: jax.Array) -> jax.Array:
        return of.force(data, history, q, of.retract(q, delta))

    def load(q: jax.Array, delta: jax.Array, wrench: jax.Array) -> jax.Array:
        return of.load(of.retract(q, delta), wrench)

    def body(mesh: Mesh, at: tuple) -> tuple:
        wrench, start = at
        found = newton(mesh, element, load, wrench, start, free, basis)
        mesh = advance(mesh, found.delta)
        return mesh, (mesh.q, found.iterations, found.success)

    seen: tuple
    mesh, seen = jax.lax.scan(body, mesh, (wrenches, increments))
    return mesh, *seen


def advance(mesh: Mesh, delta: jax.Array) -> Mesh:
    """Return the mesh after increments (nodes, d): new coordinates and new history."""
    of, nodes = mesh.formulation, mesh.connectivity
    q = of.retract(mesh.q, delta)
    history = jax.vmap(of.advance)(mesh.data, mesh.history, mesh.q[nodes], q[nodes])
    return mesh.replace(q=q, history=history)
