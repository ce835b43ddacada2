"""Motion of a beam by a midpoint rule with the mean of the stresses at both ends of a step.

With an increment d of a step h, velocity v = d/h and configuration qm = midway(q0, d):
    P(qm, v) + h/2 (f(qm) - dT/dq(qm, v) - load(qm, t + h/2)) = p0,  p1 = 2 P(qm, v) - p0.
f are the forces at qm of the mean of the stresses at q0 and q1. So a rigid rotation in a step gives
no strain, which it does if the strains at qm are used: the chord of an arc is too short. Order 2.
Linear momentum changes by the impulse of the loads to rounding. So does angular momentum if the
forces of an element balance. Simo, Tarnow and Doblare, "Non-linear dynamics of three-dimensional
rods: exact energy and momentum conserving algorithms", Int. J. Numer. Methods Eng. 38 (1995).
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiling import compiler_options
from rbjax.errors import InputError, RbjaxError
from rbjax.flexible.reference.assembly import newton, sum_elements
from rbjax.flexible.reference.mesh import Mesh, Supports
from rbjax.flexible.reference.statics import advance


class Motion(NamedTuple):
    """Result of `simulate`.

    mesh: the `Mesh` at the end.
    t: times, (steps + 1,), s.
    q: coordinates of the nodes, (steps + 1, nodes, c).
    p: momenta of the nodes, (steps + 1, nodes, d); linear momentum in world axes comes first.
    energy: kinetic energy at the middle of each step and mean strain energy of its ends,
        (steps, 2), J.
    """

    mesh: Mesh
    t: jax.Array
    q: jax.Array
    p: jax.Array
    energy: jax.Array


def simulate(
    mesh: Mesh,
    wrenches: Any,
    dt: float,
    supports: Supports,
    *,
    clamp_angles: Any | None = None,
    momenta: Any | None = None,
) -> Motion:
    """Simulate a beam, from rest if `momenta` is None, under dead loads.

    wrenches: force and moment on each node at the middle of each step, (steps, nodes, 6), N and
        N m, world axes.
    dt: step, s.
    supports: fixed dofs, from `Formulation.supports`.
    clamp_angles: angle of the clamp of node 0 about z at each time, (steps + 1,), rad; at rest if
        None.
    momenta: of the nodes at the beginning, (nodes, d).
    Raises RbjaxError if Newton's method fails: a smaller step helps.

    >>> import rbjax.flexible.reference as rf
    >>> from rbjax.flexible import section
    >>> rod = section([1.0, 1.0, 1.0, 1e4, 1e4, 1e4], 1.0, [2e-3, 1e-3, 1e-3])
    >>> beam = rf.Reissner()
    >>> mesh = beam.build(rf.line(), 1.0, rod, 4)
    >>> loads = np.zeros((10, 5, 6))
    >>> loads[:, -1, 1] = 2.0
    >>> motion = rf.simulate(mesh, loads, 0.01, beam.supports(mesh, clamp=False))
    >>> f"{motion.p[-1, :, 1].sum():.12f}"  # 2 N for 0.1 s
    '0.200000000000'
    """
    wrenches, n, d = jnp.asarray(wrenches, float), len(mesh.q), mesh.formulation.d
    if wrenches.ndim != 3 or wrenches.shape[1:] != (n, 6):
        raise InputError(f"wrenches is {wrenches.shape}. Expected (steps, {n}, 6).")
    if not dt > 0:
        raise InputError(f"dt is {dt}. It must be positive, in s.")
    steps = len(wrenches)
    angles = jnp.zeros(0) if clamp_angles is None else jnp.asarray(clamp_angles, float)
    if clamp_angles is not None and angles.shape != (steps + 1,):
        raise InputError(f"clamp_angles is {angles.shape}. Expected ({steps + 1},).")
    p = jnp.zeros((n, d)) if momenta is None else jnp.asarray(momenta, float)
    if p.shape != (n, d):
        raise InputError(f"momenta is {p.shape}. Expected ({n}, {d}).")
    free = np.flatnonzero(~supports.fixed)
    end, seen, success = _simulate(mesh, p, wrenches, dt, free, supports.basis, angles)
    if not success.all():
        at = int(jnp.argmin(success))
        raise RbjaxError(
            f"Newton's method did not converge in step {at + 1} of {steps}, t = {at * dt:.6g} s, "
            f"for {mesh.formulation.name}. Give a smaller dt than {dt}."
        )
    first = mesh.q[None], p[None]
    q, p = (jnp.concatenate([a, b]) for a, b in zip(first, seen[:2], strict=True))
    return Motion(end, dt * jnp.arange(steps + 1), q, p, seen[2])


@partial(jax.jit, compiler_options=compiler_options())
def _simulate(
    mesh: Mesh, p: jax.Array, wrenches: jax.Array, dt: jax.Array, free: jax.Array,
    basis: jax.Array, angles: jax.Array,
) -> tuple:  # fmt: skip
    of, driven = mesh.formulation, len(angles) > 0
    mask = jnp.zeros(mesh.q.shape[0] * of.d, bool).at[free].set(True).reshape(-1, of.d)

    def momentum(data: Any, history: Any, q: jax.Array, delta: jax.Array) -> jax.Array:
        return of.momentum(data, of.midway(q, delta), delta / dt)[0]

    def element(data: Any, history: Any, q: jax.Array, delta: jax.Array) -> jax.Array:
        middle = of.midway(q, delta)
        P, slope = of.momentum(data, middle, delta / dt)
        ends = of.strains(data, history, q, q), of.strains(data, history, q, of.retract(q, delta))
        stress = data["stiffness"] * (ends[0] + ends[1]) / 2
        return P + dt / 2 * (of.resist(data, history, q, middle, stress) - slope)

    def load(q: jax.Array, delta: jax.Array, given: jax.Array) -> jax.Array:
        p0, wrench = given[: of.d], given[of.d :]
        return p0 + dt / 2 * of.load(of.midway(q, delta), wrench)

    def energies(data: Any, history: Any, q: jax.Array, delta: jax.Array) -> jax.Array:
        kinetic = of.kinetic_energy(data, of.midway(q, delta), delta / dt)
        ends = (of.strain_energy(data, history, q, of.retract(q, x)) for x in (0 * delta, delta))
        return jnp.stack([kinetic, sum(ends) / 2])

    def body(carry: tuple, at: tuple) -> tuple:
        mesh, p, last = carry
        wrench, before, after = at
        start, axes = jnp.where(mask, last, 0.0), basis
        if driven:
            axes = of.clamp_basis(after)
            y = jnp.where(mask[0], axes.T @ last[0], of.clamp_increment(mesh.q[0], before, after))
            start = start.at[0].set(axes @ y)
        found = newton(
            mesh, element, load, jnp.concatenate([p, wrench], -1), start, free, axes
        )  # fmt: skip
        P = sum_elements(mesh, momentum, found.delta)
        nodes = mesh.connectivity
        energy = jax.vmap(energies)(mesh.data, mesh.history, mesh.q[nodes], found.delta[nodes]).sum(
            0
        )
        y = jnp.where(mask[0], axes.T @ (P[0] - p[0]), 0.0)
        change = jnp.where(mask, P - p, 0.0).at[0].set(axes @ y)
        mesh, p = advance(mesh, found.delta), P + change
        return (mesh, p, found.delta), (mesh.q, p, energy, found.success)

    steps = len(wrenches)
    pairs = (angles[:-1], angles[1:]) if driven else (jnp.zeros(steps), jnp.zeros(steps))
    begin = (mesh, p, jnp.zeros((len(mesh.q), of.d)))
    seen: tuple
    (mesh, _, _), seen = jax.lax.scan(body, begin, (wrenches, *pairs))
    return mesh, seen[:3], seen[3]
