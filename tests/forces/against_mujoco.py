"""Models with force elements against MuJoCo C: random trees with one added feature."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.random_trees import random_state, random_tree
from tests.robots import load_quietly
from tests.tolerances import relative_error

Array = np.ndarray
DRIVERS = ("unrolled", "rolled", "limbs")
STATES = 100
SEEDS = [0, 1, 2, *(pytest.param(s, marks=pytest.mark.slow) for s in range(3, 20))]

# A derivative where the second derivative jumps (as of v |v| at v = 0), against central differences
# of step 6e-6: the jump times the step.
AT_A_JUMP = 5e-4


def tree(seed: int, *, bodies: int = 4) -> mujoco.MjSpec:
    """A small random tree, to be changed before it is compiled; contacts are none."""
    return mujoco.MjSpec.from_string(random_tree(seed, bodies=bodies))


def states(m: mujoco.MjModel, count: int = STATES) -> tuple[Array, Array, Array]:
    """q (count, nq), v (count, nv) and controls (count, nu)."""
    drawn = [random_state(m, seed) for seed in range(count)]
    ctrl = np.random.default_rng(5).normal(size=(count, m.nu))
    return np.stack([q for q, _ in drawn]), np.stack([v for _, v in drawn]), ctrl


def mujoco_forces(m: mujoco.MjModel, q: Array, v: Array, ctrl: Array) -> Array:
    """Passive and actuators' generalized forces (count, nv)."""
    data, out = mujoco.MjData(m), []
    for row in zip(q, v, ctrl, strict=True):
        data.qpos, data.qvel, data.ctrl = row
        mujoco.mj_forward(m, data)
        out.append(data.qfrc_passive + data.qfrc_actuator)
    return np.stack(out)


def applied(model: rb.Model) -> Callable[..., jax.Array]:
    """`applied_forces` of a batch, the model closed over."""

    @jax.jit
    def f(q, v, ctrl):
        return jax.vmap(lambda q, v, u: rb.applied_forces(model, rb.State(q, v), u))(q, v, ctrl)

    return f


def error_of(model: rb.Model, m: mujoco.MjModel, count: int = STATES) -> float:
    """The error of applied_forces over random states, relative to the largest force of a state."""
    given = states(m, count)
    found, want = applied(model)(*given), mujoco_forces(m, *given)
    return float(relative_error(found, want, batch_dims=1).max())


def worst_error(m: mujoco.MjModel, driver: str = "auto", **options: Any) -> float:
    """`error_of` the model as it is loaded, which must have force elements."""
    model = load_quietly(m, **options).replace(driver=driver)
    assert model.nv and (model.forces or model.tendons), "the model has nothing to compare"
    return error_of(model, m)


def costs_nothing(element: rb.forces.Element, model: rb.Model) -> bool:
    """Whether the element adds no operations to the model's forces."""

    def count(model):
        f = lambda q, v: rb.applied_forces(model, rb.State(q, v), np.zeros(model.nu))  # noqa: E731
        return rb.operation_count(f, model.joints.reference, np.ones(model.nv))

    return count(model.with_forces(element)) == count(model)


def energy_slope(model: rb.Model, q: Array) -> tuple[Array, Array]:
    """The forces at rest, and minus the gradient of the stored energy along the tangent at q."""

    def energy(dq):
        return rb.forces.elastic_energy(model, rb.integrate(model, q, dq))

    @jax.jit
    def both(zero):
        return rb.applied_forces(model, rb.State(q, zero)), -jax.grad(energy)(zero)

    return both(np.zeros(model.nv))


def slopes(f: Callable[[Any], jax.Array], at: Any, step: float = 6e-6) -> float:
    """The differences of jvp and vjp of f at a pytree from central differences and from each other,
    in a random direction; not finite if a derivative is not."""
    rng = np.random.default_rng(11)
    way = jax.tree.map(lambda x: rng.normal(size=np.shape(x)), at)

    @jax.jit
    def both(at):
        value, rate = jax.jvp(f, (at,), (way,))
        weight = jax.numpy.cos(1.0 + jax.numpy.arange(value.size)).reshape(value.shape)
        (back,) = jax.vjp(f, at)[1](weight)
        along = sum((a * b).sum() for a, b in zip(*map(jax.tree.leaves, (back, way)), strict=True))
        ends = [f(jax.tree.map(lambda x, d, s=s: x + s * d, at, way)) for s in (-step, step)]
        return rate, along, (rate * weight).sum(), (ends[1] - ends[0]) / (2 * step)

    rate, along, forth, differences = both(at)
    scale = max(1.0, np.abs(rate).max())
    one, other = np.abs(rate - differences).max(), np.abs(along - forth)
    return float(np.maximum(one, other) / scale)
