"""A batch sharded over all GPUs against one share of it on one GPU: rollouts, gradients.

`python -m benchmarks.gpu.sharded --robots humanoid` writes
results/gpu-sharded-<robot>-<device>.json. Twice the samples on two GPUs: the ideal is 2x.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from benchmarks.gpu.threads import MANY, STEPS, Case, heavier
from benchmarks.shared.gpu_timing import finish, options, timed


def bench(name: str) -> list[dict]:
    c = Case(name)
    count = jax.device_count()
    mesh = Mesh(np.array(jax.devices()), ("batch",))
    spread = NamedSharding(mesh, PartitionSpec("batch"))
    mass = c.model.bodies.mass

    def rollout(mass, q, v, u):
        return c.final(c.model, q, v, u)

    def gradient(mass, q, v, u):
        return jax.grad(lambda m, u: c.loss(heavier(c.model, m), q, v, u), (0, 1))(mass, u)

    rows = []
    for what, f in (("rollout", rollout), ("gradient by masses and controls", gradient)):
        for devices in (1, count):
            size = MANY * devices
            q, v, _, u = c.batch(size)
            ctrls = jnp.tile(u[:, None], (1, STEPS, 1))
            if devices > 1:
                q, v, ctrls = (jax.device_put(x, spread) for x in (q, v, ctrls))
            row = {"what": what, "robot": name, "engine": f"{devices} GPU", "batch": size}
            row = timed(row, f, mass, q, v, ctrls, work=size * STEPS)
            text = jax.jit(f).lower(mass, q, v, ctrls).compile().as_text()
            row["note"] = f"all-gather {'all-gather' in text}, all-reduce {'all-reduce' in text}"
            rows.append(row)
        one, all_ = rows[-2:]
        all_["over one"] = all_["M/s median"] / one["M/s median"]
        print(what, f"{all_['over one']:.3f}x", rows[-1]["note"], flush=True)
    return rows


if __name__ == "__main__":
    opts = options(__doc__)
    for robot in opts.robots:
        finish(f"gpu-sharded-{robot}", bench(robot))
