"""Beams as models of rbjax, as entries of a comparison: strain coordinates and simpler chains.

In the scene "elastica" each has n coordinates of bending in the plane; it is in equilibrium by
Newton's method on the forces of the model, with the load in ten steps. The motions have strain
coordinates only, in links of eight or eleven coordinates (`benchmarks.flexible.motions`).
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
import rbjax.flexible.reference as rf
from benchmarks.flexible.beam_scenes import Entry, Prepared
from benchmarks.flexible.motions import fly, spin_up

LOAD = 10.0
Case = tuple[rb.Model, str, float]


def strain_coordinates(n: int) -> Case:
    """One beam whose curvature is a polynomial of degree n - 1."""
    rod = rb.flexible.beam(1.0, [1.0] * 3 + [0.0] * 3, {"k_z": n - 1}, mass=1.0)
    return rb.load("<mujoco/>").with_beam("rod", rod), "rod", 0.0


def constant_strain(n: int) -> Case:
    """n segments of constant curvature."""
    own = {"bending": (1.0, 1.0), "mass": 1.0, "inertia": (2e-4, 1e-4, 1e-4), "planar": True}
    return rf.constant_strain_beam(rf.UniformBeam(1.0, n, **own)), f"segment{n}", 0.0  # type: ignore[arg-type]


def rigid_links(n: int) -> Case:
    """n rigid links with springs."""
    own = {"bending": (1.0, 1.0), "mass": 1.0, "inertia": (2e-4, 1e-4, 1e-4), "planar": True}
    return rf.lumped_beam(rf.UniformBeam(1.0, n, **own)), f"link{n}", 1.0 / n  # type: ignore[arg-type]


def own_beams() -> list[Entry]:
    """The beams of this module, each as an `Entry`."""
    made = {
        "strain coordinates": strain_coordinates,
        "piecewise constant strain": constant_strain,
        "rigid links with springs": rigid_links,
    }
    return [
        Entry(name, lambda scene, n, make=make: prepare(make, scene, n))
        for name, make in made.items()
    ]


def prepare(make: Callable[[int], Case], scene: str, n: int) -> Prepared | None:
    """A scene with a beam of n coordinates: their number and its solution."""
    if make is strain_coordinates and scene in ("flying", "spin_up"):
        return fly(n) if scene == "flying" else spin_up(n)
    if scene != "elastica" or (make is strain_coordinates and n > 16):
        return None
    model, body, offset = make(n)
    at = model.body(body)

    def tip(q: jax.Array) -> jax.Array:
        R, p = rb.forward_kinematics(model, q)
        return p[at] + offset * R[at, :, 0]

    def forces(q: jax.Array, load: float) -> jax.Array:
        state = model.default_state().replace(q=q)
        return rb.applied_forces(model, state) + load * jax.grad(lambda q: tip(q)[1])(q)

    @jax.jit
    def solve() -> jax.Array:
        def step(q: jax.Array, load: jax.Array) -> tuple[jax.Array, None]:
            def newton(_: int, q: jax.Array) -> jax.Array:
                return q - jnp.linalg.solve(jax.jacfwd(forces)(q, load), forces(q, load))

            return jax.lax.fori_loop(0, 8, newton, q), None

        loads = LOAD * jnp.arange(1, 11) / 10
        return tip(jax.lax.scan(step, jnp.zeros(model.nq), loads)[0])[:2] - jnp.array([1.0, 0.0])

    return model.nq, lambda: np.asarray(solve())
