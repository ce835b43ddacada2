"""Two processes under `jax.distributed`: a rollout, its gradient and an identification.

    python -m tests.two_processes RANK PORT FILE

Each process has one CPU device. The batch is sharded over both. Process 0 writes what it finds to
FILE; a process without a rank computes the same alone.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

STEPS, SAMPLES, DT = 20, 8, 0.01


def found(shard) -> dict[str, np.ndarray]:
    """The ends of rollouts, a gradient by the masses, and masses fitted to recorded motions.

    shard: puts an array whose first axis is the batch on the devices.
    """
    import rbjax as rb

    model = rb.load("cart_pole")
    rng = np.random.default_rng(0)
    q, v = (shard(x) for x in rng.normal(size=(2, SAMPLES, model.nq)))
    us = shard(rng.normal(size=(SAMPLES, STEPS, model.nu)))

    def with_mass(mass):
        return model.replace(bodies=model.bodies.replace(mass=mass))

    def end(mass, q, v, u):
        return rb.rollout(with_mass(mass), rb.State(q, v), u, DT, save_every=STEPS).q[-1]

    ends = jax.jit(jax.vmap(end, (None, 0, 0, 0)))
    mass = jnp.asarray(model.bodies.mass)
    wanted = ends(mass, q, v, us)
    # arrays of several processes are operands: JAX does not let a function close over them
    gradient = jax.jit(jax.grad(lambda mass, *args: (ends(mass, *args) ** 2).sum()))
    found = {"ends": wanted, "gradient": gradient(mass, q, v, us)}

    @jax.jit
    def step(scale, wanted, *args):
        """A step of Gauss and Newton for the factors of the moving bodies' masses."""

        def of(scale):
            return (ends(mass.at[-2:].multiply(scale), *args) - wanted).reshape(-1)

        r, J = of(scale), jax.jacfwd(of)(scale)
        return scale - jnp.linalg.solve(J.T @ J, J.T @ r)

    scale = jnp.array([1.1, 0.9])
    for _ in range(8):
        scale = step(scale, wanted, q, v, us)
    return found | {"scale": scale, "mass": identified()}


def identified() -> np.ndarray:
    """A mass by `identify`, which each process runs on devices of its own."""
    import rbjax as rb
    from rbjax.sysid import Channel, Recording, Unknown, identify

    model, t = rb.load("pendulum"), np.arange(51) * 0.02
    heavier = model.replace(bodies=model.bodies.replace(mass=np.array([1.3])))
    push = np.ones((50, 1))
    seen = rb.rollout(heavier, model.default_state(), push, 0.02, integrator="rk4")
    q = np.asarray(seen.q) + 1e-3 * np.random.default_rng(0).normal(size=seen.q.shape)
    run = Recording("swing", {"q": Channel(t, q), "ctrl": Channel(t[:-1], push)})
    found = identify(model, run, {"mass": Unknown("bodies.mass", 0, positive=True)})
    return np.asarray(found.model.bodies.mass)


def main(rank: str, port: str, file: str) -> None:
    jax.config.update("jax_enable_x64", True)
    if rank == "alone":
        np.savez(file, **found(jnp.asarray))
        return
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(f"localhost:{port}", 2, int(rank))
    assert jax.process_count() == 2 and len(jax.devices()) == 2 and len(jax.local_devices()) == 1
    mesh = Mesh(np.array(jax.devices()), ("batch",))

    def shard(x):
        where = NamedSharding(mesh, P("batch"))
        return jax.make_array_from_callback(x.shape, where, lambda at: x[at])

    out = found(shard)
    from jax.experimental.multihost_utils import process_allgather

    def whole(x):
        """An array of this process, or of both, which is gathered."""
        own = isinstance(x, np.ndarray) or x.is_fully_addressable
        return np.asarray(x) if own else process_allgather(x, tiled=True)

    out = {name: whole(x) for name, x in out.items()}
    if rank == "0":
        np.savez(file, **out)


def run(folder: Path, port: int) -> tuple[dict, dict]:
    """What two processes find, and what one finds."""
    env = os.environ | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": ""}
    command = [sys.executable, "-m", "tests.two_processes"]
    ranks = {"0": folder / "two.npz", "1": folder / "none.npz", "alone": folder / "one.npz"}
    children = [
        subprocess.Popen(
            [*command, rank, str(port), str(file)], env=env, cwd=Path(__file__).parents[1],
            stderr=subprocess.PIPE, text=True,
        )
        for rank, file in ranks.items()
    ]  # fmt: skip
    try:
        for child in children:
            _, said = child.communicate(timeout=240)
            assert child.returncode == 0, said[-3000:]
    finally:
        for child in children:
            child.kill()
    return dict(np.load(ranks["0"])), dict(np.load(ranks["alone"]))


if __name__ == "__main__":
    main(*sys.argv[1:])
