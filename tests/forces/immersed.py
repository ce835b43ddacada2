"""Shared by the tests of the fluid elements: only the fluid, its power, its derivatives."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from tests.oracles.media import fluid_forces, states
from tests.robots import load_quietly
from tests.tolerances import F64_TRANSFORM, relative_error

STEP = 6e-6  # of central differences: the cube root of the rounding unit


def run(f: Any, *x: Any) -> Any:
    """f of x, compiled for one run."""
    return jax.jit(f)(*x)


def calm(model: rb.Model) -> rb.Model:
    """The model with only the fluid: no springs, no dampers."""
    j = model.joints
    none = j.replace(stiffness=0.0 * j.stiffness, damping=0.0 * j.damping)
    return model.replace(joints=none)


def fluid(model: rb.Model, q: Any, v: Any) -> jax.Array:
    """Generalized forces of a calm model."""
    return rb.applied_forces(model, rb.State(q, v))


def error(m: Any, count: int, driver: str = "auto") -> float:
    """The largest relative error over random states, of MuJoCo's."""
    model = calm(load_quietly(m)).replace(driver=driver)
    assert not any("fluid" in entry for entry in model.dropped)
    q, v = states(m, count)
    found = run(jax.vmap(lambda q, v: fluid(model, q, v)), q, v)
    return float(relative_error(found, fluid_forces(m, q, v), batch_dims=1).max())


def gradients_agree(model: rb.Model, q: Any, v: Any, tolerance: float) -> None:
    """Derivatives by all numbers of the elements, the bodies' masses, centres and inertias, q and v
    along random directions, against central differences; and finite at rest."""
    rng = np.random.default_rng(0)
    weights = jnp.asarray(rng.normal(size=model.nv))

    def value(forces, bodies, q, v):
        return weights @ fluid(model.replace(forces=forces, bodies=bodies), q, v)

    point = (model.forces, model.bodies, jnp.asarray(q), jnp.asarray(v))
    derivative = jax.jit(jax.value_and_grad(value, (0, 1, 2, 3)))
    slope = derivative(*point)[1]
    leaves, tree = jax.tree.flatten(point)
    at_rest = derivative(*point[:3], 0.0 * point[3])
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(at_rest))
    for i, (x, g) in enumerate(zip(leaves, jax.tree.leaves(slope), strict=True)):
        assert np.isfinite(g).all()
        along = rng.normal(size=x.shape) * np.maximum(abs(np.asarray(x)).max(), 0.1)
        if x.ndim == 3:  # an inertia along a change of its moments: its axes are the element's
            along = np.asarray(x) * rng.uniform(0.5, 1, (x.shape[0], 1, 1))
        ends = [
            derivative(*tree.unflatten([*leaves[:i], x + s * along, *leaves[i + 1 :]]))[0]
            for s in (-STEP, STEP)
        ]
        expected = (ends[1] - ends[0]) / (2 * STEP)
        scale = max(float(abs(np.asarray(g) * along).sum()), 1e-3)
        assert abs(float((g * along).sum()) - expected) < tolerance * scale, (i, x.shape)


def drivers_agree(model: rb.Model) -> None:
    """All drivers."""
    state, found = model.random_state(jax.random.key(0)), []
    for name in ("unrolled", "rolled", "limbs"):
        same = model.replace(driver=name)
        found.append(run(lambda state, same=same: rb.applied_forces(same, state), state))
    assert relative_error(found[1], found[0]) < F64_TRANSFORM
    assert relative_error(found[2], found[0]) < F64_TRANSFORM
