"""The cost of force elements in a rollout: steps a second, forward and with gradients.

`python -m benchmarks.gpu.elements --robots quadruped humanoid` writes
results/elements-<robot>-<device>.json: the robot without elements; in a wind that a user wrote;
with friction in all joints, stops at their ranges, and water around all bodies; with forces given
as functions. Batch first, f32, 100 steps of semi-implicit Euler; calls in a row, waiting for the
last one only.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.shared.gpu_timing import timed
from benchmarks.shared.robots import compiled
from benchmarks.shared.timing import markdown_table, save

STEPS = 100
COLUMNS = ("robot", "what", "run", "batch", "lower_s", "compile_s", "M/s median")


class Wind(rb.forces.Element):
    """A drag on one body, in air that moves."""

    air: jax.Array
    drag: jax.Array

    def loads(self, context: rb.forces.Context) -> rb.forces.Loads:
        body = context.body(0)
        return body.push(self.drag * (self.air - body.velocity))


def scene(name: str) -> rb.Model:
    """The robot without force elements, in f32."""
    source = name if name in rb.scenes() else compiled(name)
    return rb.load(source).replace(forces=()).astype(jnp.float32)


def scenes(name: str) -> Iterator[tuple[str, rb.Model, dict[str, Any]]]:
    """The forces by name, the model, and further arguments of `rollout`."""
    model = scene(name)
    hinges = [
        j
        for j, kind in zip(model.joint_names, model.topology.joint_kinds, strict=True)
        if kind in ("hinge", "slide")
    ]
    n = len(hinges)
    one = jnp.ones(n, jnp.float32)
    wind = Wind(jnp.array([8.0, 0.0, 0.0], jnp.float32), jnp.float32(5.0))
    friction = rb.forces.JointFriction.of(model, hinges, coulomb=0.5)
    stops = rb.forces.JointLimits(100 * one, one, 0 * one, 0.01 * one, tuple(hinges))
    yield "alone", model, {}
    yield "a wind", model.with_forces(wind), {}
    yield "friction of joints", model.with_forces(friction), {}
    ranges = jnp.full_like(model.joints.range, 1.0).at[:, 0].set(-1.0)
    held = model.replace(joints=model.joints.replace(range=ranges))
    yield "stops of joints", held.with_forces(stops), {}
    yield "forces as functions", model, {"tau": lambda t, state: -state.v}
    water = rb.load(_in_water(name)).astype(jnp.float32)
    yield "water", water, {}


def _in_water(name: str) -> Any:
    m = rb.loading.compile_model(name) if name in rb.scenes() else compiled(name)
    m.opt.density, m.opt.viscosity = 1000.0, 1e-3
    return m


def rows(name: str, batch: int) -> Iterator[dict]:
    alone = scene(name)
    rng = np.random.default_rng(0)
    states = jax.vmap(alone.random_state)(jax.random.split(jax.random.key(0), batch))
    states = rb.State(states.q, 0.1 * states.v)
    u = jnp.asarray(0.1 * rng.normal(size=(batch, STEPS, alone.nu)), jnp.float32)
    for what, model, more in scenes(name):

        def last(state: rb.State, u: Any, model=model, more=more) -> Any:
            path = rb.rollout(model, state, u, 0.002, save_every=STEPS, **more)
            return path.q[:, -1], path.v[:, -1]

        def loss(u: Any, state: rb.State, last=last) -> Any:
            return sum((x * x).sum() for x in last(state, u))

        row = {"robot": name, "what": what, "batch": batch}
        yield timed(row | {"run": "rollout"}, last, states, u, work=batch * STEPS)
        yield timed(row | {"run": "gradient"}, jax.grad(loss), u, states, work=batch * STEPS)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", nargs="+", default=["quadruped", "humanoid"])
    parser.add_argument("--batch", type=int, default=65_536)
    given = parser.parse_args()
    for name in given.robots:
        found = list(rows(name, given.batch))
        print(markdown_table(found, COLUMNS))
        print(save(f"elements-{name}", found))


if __name__ == "__main__":
    main()
