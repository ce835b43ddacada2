"""Public functions on a GPU, one sample a thread: batch first, `jax.vmap` of the public name.

`python -m benchmarks.gpu.threads --robots panda --parts forward rollout` writes
results/gpu-threads-<robot>-<device>.json, and keeps the other parts of an older file.
Rates are of calls in a row, waiting for the last one only. The error of a gradient is against
central differences of the rollout in f64 on the same device, over 20 steps, in random directions.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.shared.gpu_timing import COLUMNS, timed
from benchmarks.shared.robots import ALL, actuated, as_model, batch, exact, relative
from benchmarks.shared.timing import markdown_table, others, save

MILLION, MANY, STEPS, WIDTH = 1_048_576, 65_536, 100, 128


class Case:
    """A robot with a batch of states."""

    def __init__(self, name: str):
        self.name, self.m = name, actuated(name)
        self.model = as_model(self.m)

    def batch(self, size: int) -> tuple[jax.Array, ...]:
        return batch(self.m, size, last=False)

    def row(self, what: str, size: int, f: Callable, *args: Any, work: int | None = None) -> dict:
        row = {"what": what, "robot": self.name, "engine": "rbjax", "batch": size}
        return timed(row, f, *args, work=work or size)

    def final(self, model: rb.Model, q: Any, v: Any, ctrls: Any, steps: int = STEPS) -> Any:
        """The last state of a rollout."""
        out = rb.rollout(model, rb.State(q, v), ctrls, steps=steps, save_every=steps)
        return out.q[:, -1], out.v[:, -1]

    def loss(self, *args: Any, **how: Any) -> jax.Array:
        q, v = self.final(*args, **how)
        return (q * q).sum() + (v * v).sum()


def methods(c: Case) -> Iterator[dict]:
    """Rollouts by the integrators of low order, and their gradients by controls."""
    q, v, _, ctrls = c.batch(MANY)
    ctrls = jnp.broadcast_to(ctrls[:, None], (MANY, STEPS, ctrls.shape[-1]))
    for name in ("semi_implicit_euler", "rk4", "variational_midpoint"):

        def last(u: Any, q: Any, v: Any, name: str = name) -> Any:
            out = rb.rollout(c.model, rb.State(q, v), u, 0.002, save_every=STEPS, integrator=name)
            return out.q[:, -1], out.v[:, -1]

        def loss(u: Any, q: Any, v: Any, last: Callable = last) -> jax.Array:
            return sum((x * x).sum() for x in last(u, q, v))

        yield c.row(f"rollout, {name}", MANY, last, ctrls, q, v, work=MANY * STEPS)
        yield c.row(f"gradient, {name}", MANY, jax.grad(loss), ctrls, q, v, work=MANY * STEPS)


def forward(c: Case) -> Iterator[dict]:
    """Forward dynamics in f32, its error, and in f64."""
    run = jax.vmap(lambda q, v, tau: rb.forward_dynamics(c.model, q, v, tau))
    for size in (MANY, MILLION):
        q, v, tau, _ = c.batch(size)
        row = c.row("forward", size, run, q, v, tau)
        if size == MILLION:
            states, want = exact(c.m, 256)
            error = relative(jax.jit(run)(*states[:3]), want)
            row |= {"error median": float(np.median(error)), "error max": float(error.max())}
        yield row
    with jax.enable_x64(True):
        q, v, tau = (x.astype(jnp.float64) for x in (q, v, tau))
        yield c.row("forward f64", MILLION, run, q, v, tau)


def rollout(c: Case) -> Iterator[dict]:
    """100 steps, with the last state returned, and controls that all samples share."""
    for size in (MANY, MILLION):
        q, v, _, u = c.batch(size)
        ctrls = jnp.tile(u[:1], (STEPS, 1))
        run = lambda q, v, u: c.final(c.model, q, v, u)  # noqa: E731
        yield c.row("rollout", size, run, q, v, ctrls, work=size * STEPS)


def network(c: Case) -> tuple[list[jax.Array], Callable]:
    """A policy of two layers of 128."""
    rng = np.random.default_rng(0)
    sizes = (c.model.nq + c.model.nv, WIDTH, WIDTH, c.model.nu)
    weights = [
        jnp.asarray(rng.normal(size=(m, n)) / np.sqrt(m), jnp.float32)
        for m, n in itertools.pairwise(sizes)
    ]

    def policy(weights: list[jax.Array]) -> Callable:
        def act(t: Any, state: rb.State) -> jax.Array:
            x = jnp.concatenate([state.q, state.v])
            for w in weights[:-1]:
                x = jnp.tanh(x @ w)
            return 0.1 * jnp.tanh(x @ weights[-1])

        return act

    return weights, policy


def policy(c: Case) -> Iterator[dict]:
    """The same with a network as policy, and the gradient by its weights."""
    q, v, _, _ = c.batch(MANY)
    weights, act = network(c)
    run = lambda q, v, w: c.final(c.model, q, v, act(w))  # noqa: E731
    yield c.row("rollout, policy", MANY, run, q, v, weights, work=MANY * STEPS)
    grad = jax.grad(lambda w, q, v: c.loss(c.model, q, v, act(w)))
    yield c.row("gradient by weights", MANY, grad, weights, q, v, work=MANY * STEPS)


def heavier(model: rb.Model, mass: jax.Array) -> rb.Model:
    return model.replace(bodies=model.bodies.replace(mass=mass))


def gradient(c: Case) -> Iterator[dict]:
    """Reverse gradients of 100 steps by controls, by shared masses and by each sample's masses."""
    mass = c.model.bodies.mass
    yield errors(c)
    for size in (MANY, 4 * MANY):
        q, v, _, u = c.batch(size)
        ctrls = jnp.tile(u[:, None], (1, STEPS, 1))
        grad = jax.grad(lambda u, q, v: c.loss(c.model, q, v, u))
        yield c.row("gradient by controls", size, grad, ctrls, q, v, work=size * STEPS)
    q, v, _, u = c.batch(MANY)
    shared = jnp.tile(u[:1], (STEPS, 1))
    grad = jax.grad(lambda mass, q, v, u: c.loss(heavier(c.model, mass), q, v, u))
    yield c.row("gradient by masses", MANY, grad, mass, q, v, shared, work=MANY * STEPS)

    def one(mass, q, v, u):
        out = rb.rollout(heavier(c.model, mass), rb.State(q, v), u, save_every=STEPS)
        return (out.q[-1] ** 2).sum() + (out.v[-1] ** 2).sum()

    own = jnp.tile(mass, (MANY, 1))
    total = lambda *x: jax.vmap(one, (0, 0, 0, None))(*x).sum()  # noqa: E731
    yield c.row("gradient by own masses", MANY, jax.grad(total), own, q, v, shared,
                work=MANY * STEPS)  # fmt: skip


def memory(c: Case) -> Iterator[dict]:
    """A gradient of 1,000 steps, with 2 GiB for the states, or memory for all of them."""
    steps = 1000
    q, v, _, u = c.batch(MANY)
    shared = jnp.tile(u[:1], (steps, 1))
    for budget in (2**31, 2**36):

        def loss(q, v, u, budget=budget):
            out = rb.rollout(c.model, rb.State(q, v), u, save_every=steps, memory=budget)
            return (out.q[:, -1] ** 2).sum()

        grad = jax.grad(loss)
        row = c.row(f"gradient of 1000 steps, {budget / 2**30:.0f} GiB", MANY, grad, q, v, shared,
                    work=MANY * steps)  # fmt: skip
        compiled = jax.jit(grad).lower(q, v, shared).compile()
        yield row | {"note": f"{compiled.memory_analysis().temp_size_in_bytes / 2**30:.2f} GiB"}


def errors(c: Case, count: int = 256, steps: int = 20) -> dict:
    """The gradient in f32 against central differences in f64."""
    q, v, _, u = c.batch(count)
    ctrls = jnp.tile(u[:, None], (1, steps, 1))
    got = jax.jit(jax.grad(lambda u: c.loss(c.model, q, v, u, steps=steps)))(ctrls)
    rng = np.random.default_rng(0)
    found, wanted = [], []
    with jax.enable_x64(True):
        q, v, u, got = (jnp.asarray(np.asarray(x, np.float64)) for x in (q, v, ctrls, got))

        @jax.jit
        def each(u):
            q1, v1 = c.final(c.model, q, v, u, steps=steps)
            return (q1 * q1).sum(1) + (v1 * v1).sum(1)

        for _ in range(4):
            way = rng.normal(size=u.shape)
            way /= np.linalg.norm(way, axis=(1, 2), keepdims=True)
            wanted.append(np.asarray(each(u + 1e-5 * way) - each(u - 1e-5 * way)) / 2e-5)
            found.append(np.asarray((got * way).sum((1, 2))))
        size = np.asarray(jnp.sqrt((got * got).mean((1, 2))))  # of a typical derivative
    error = np.abs(np.array(found) - np.array(wanted)) / size
    row = {"what": "gradient error", "robot": c.name, "engine": "rbjax",
           "error median": float(np.median(error)), "error max": float(error.max()),
           "note": "f32 against central differences in f64, over their typical size"}  # fmt: skip
    print(row, flush=True)
    return row


def algorithms(c: Case) -> Iterator[dict]:
    """The other algorithms, with their reads and writes as a share of the copy bandwidth."""
    body = c.model.body_names[-1]
    m = c.model
    runs = {
        "inverse dynamics": lambda q, v, a: rb.inverse_dynamics(m, q, v, a),
        "mass matrix": lambda q: rb.mass_matrix(m, q),
        "inverse mass matrix": lambda q: rb.inverse_mass_matrix(m, q),
        "forward kinematics": lambda q: rb.forward_kinematics(m, q),
        "jacobian": lambda q: rb.jacobian(m, q, body),
        "forward dynamics derivatives": lambda q, v, a: rb.forward_dynamics_derivatives(m, q, v, a),
        "inverse dynamics derivatives": lambda q, v, a: rb.inverse_dynamics_derivatives(m, q, v, a),
        "energy": lambda q, v: rb.kinetic_energy(m, q, v),
        "regressor": lambda q, v, a: rb.inertial_regressor(m, q, v, a),
    }
    copy = bandwidth()
    for what, f in runs.items():
        size = MANY if "derivatives" in what or what == "regressor" else MILLION
        size = 4 * MANY if what == "inverse mass matrix" else size
        args = c.batch(size)[: f.__code__.co_argcount]
        run = jax.vmap(f)
        moved = sum(
            x.size * x.dtype.itemsize for x in jax.tree.leaves((args, jax.eval_shape(run, *args)))
        )
        row = c.row(what, size, run, *args)
        if "run_min_s" in row:
            row["of copy"] = moved / row["run_min_s"] / copy
        yield row


def bandwidth() -> float:
    """Bytes a second that a large copy reads and writes."""
    x = jnp.ones(2**28, jnp.float32)
    row = timed({"what": "copy"}, lambda x: x * 2, x, work=1)
    return 2 * x.size * 4 / row["run_min_s"]


def adaptive(c: Case) -> Iterator[dict]:
    """`simulate` under vmap: each sample takes its own steps."""
    size = 16_384
    q, v, _, _ = c.batch(size)
    ts = jnp.array([0.0, 1.0])

    def one(q, v):
        out = rb.simulate(c.model, rb.State(q, v), ts, throw=False)
        return out.q[-1], out.v[-1], out.stats["num_steps"]

    yield c.row("simulate", size, jax.vmap(one), q, v)


PARTS = {
    f.__name__: f
    for f in (forward, rollout, policy, gradient, methods, memory, algorithms, adaptive)
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", nargs="*", default=list(ALL))
    parser.add_argument("--parts", nargs="*", default=list(PARTS), choices=list(PARTS))
    args = parser.parse_args()
    for name in args.robots:
        c = Case(name)
        rows = [row for part in args.parts for row in PARTS[part](c)]
        title = f"gpu-threads-{name}"
        save(title, rows + others(title, rows, ("what", "batch")))
        print(markdown_table(rows, (*COLUMNS, "of copy")))


if __name__ == "__main__":
    main()
