"""Forward dynamics of a robot with loops on one CPU core, f64, beside Pinocchio.

`python -m benchmarks.cpu.loops cassie.xml` pins itself to one core. Both read the same file; states
are random ones on the loops. Accelerations are compared first. rbjax runs as a user would run it:
`jax.vmap` under plain jit, with the model closed over. Pinocchio's `constraintDynamics` (proximal,
its factors sparse) is a C++ call per state from Python; the time of the same loop on a robot
without joints is taken off.
"""

from __future__ import annotations

import benchmarks.shared.one_core  # noqa: F401  isort: skip

import argparse
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pinocchio as pin

import rbjax as rb
from benchmarks.shared.timing import fastest_ns, markdown_table, measure, save

BATCH, THEIRS = 4096, 256


def states(model: rb.Model, q0: np.ndarray, batch: int) -> tuple[jax.Array, ...]:
    """q and v on the loops, near q0, and tau."""
    moved, v, tau = np.random.default_rng(0).normal(size=(3, batch, model.nv))
    near = jax.vmap(lambda dq: rb.integrate(model, q0, dq))(0.02 * moved)
    exact = rb.constraints.Projection(iterations=20)
    on = jax.jit(jax.vmap(lambda q, v: exact.project(model, 0.0, rb.State(q, v))))(near, v)
    return on.q, on.v, jnp.asarray(tau)


class Pinocchio:
    """The same file read by Pinocchio: joints in the same order, quaternions with the scalar last,
    velocities and forces of a free joint in the body's axes."""

    def __init__(self, path: str, model: rb.Model):
        self.ours = model
        self.model, self.loops = pin.buildModelAndLegacyConstraintsFromMJCF(path)
        self.data = self.model.createData()
        self.loop_data = pin.StdVec_RigidConstraintData()
        self.loop_data.extend([x.createData() for x in self.loops])
        self.settings = pin.ProximalSettings(1e-10, 1e-10, 1)  # one iteration: exact to 1e-12
        pin.initConstraintDynamics(self.model, self.data, self.loops, self.loop_data)

    def accelerations(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
        return pin.constraintDynamics(
            self.model, self.data, q, v, tau, self.loops, self.loop_data, self.settings
        )

    def there(self, q: jax.Array, v: jax.Array, f: jax.Array) -> tuple[np.ndarray, ...]:
        """q, v and forces of a state of ours."""
        out, v, f = np.array(q), np.array(v), np.array(f)
        for start, k, turn in self._turning():
            if turn > start:
                R = self._body_axes(q[turn : turn + 4])
                v[k : k + 3], f[k : k + 3] = R @ v[k : k + 3], R @ f[k : k + 3]
            out[turn : turn + 4] = np.roll(out[turn : turn + 4], -1)
        return out, v, f

    def back(self, a: np.ndarray, q: jax.Array, v: jax.Array) -> np.ndarray:
        """Accelerations of theirs as ours: of a free joint's origin, in world axes."""
        out = np.array(a)
        for start, k, turn in self._turning():
            if turn > start:
                R = self._body_axes(q[turn : turn + 4])
                spin = np.cross(v[k + 3 : k + 6], R @ v[k : k + 3])
                out[k : k + 3] = R.T @ (out[k : k + 3] + spin)
        return out

    def _turning(self) -> list[tuple[int, int, int]]:
        """Where q and v of the joints with a quaternion start, and where it starts."""
        top = self.ours.topology
        at = zip(top.joint_kinds, top.joint_q, top.joint_v, strict=True)
        first = {"free": 3, "ball": 0}
        return [(q, v, q + first[kind]) for kind, q, v in at if kind in first]

    @staticmethod
    def _body_axes(quat: jax.Array) -> np.ndarray:
        return np.asarray(rb.rotations.quaternion.to_matrix(quat)).T


def pinocchio_ns(theirs: Pinocchio, inputs: list[tuple[np.ndarray, ...]]) -> dict[str, float]:
    """With the loops and without them (ABA), less what the call from Python takes."""

    def free() -> None:
        for one in inputs:
            pin.aba(theirs.model, theirs.data, *one)

    def held() -> None:
        for one in inputs:
            theirs.accelerations(*one)

    empty, nothing = pin.Model(), np.zeros(0)
    data = empty.createData()

    def called() -> None:
        for _ in inputs:
            pin.aba(empty, data, nothing, nothing, nothing)

    overhead, ways = fastest_ns(called, len(inputs)), {"loops": held, "open": free}
    return {name: fastest_ns(f, len(inputs)) - overhead for name, f in ways.items()}


def rows(path: str) -> Iterator[dict]:
    m = mujoco.MjModel.from_xml_path(path)
    model = rb.load(m)
    theirs = Pinocchio(path, model)
    inputs = states(model, jnp.asarray(m.key_qpos[0] if m.nkey else m.qpos0), BATCH)

    def held(*one: jax.Array) -> jax.Array:
        return rb.constraints.constrained_dynamics(model, *one).acceleration

    def free(*one: jax.Array) -> jax.Array:
        return rb.forward_dynamics(model, *one)

    some = [tuple(x[i] for x in inputs) for i in range(THEIRS)]
    there = [theirs.there(*one) for one in some]
    ours = np.asarray(jax.jit(jax.vmap(held))(*(x[:THEIRS] for x in inputs)))
    off = max(
        np.abs(theirs.back(theirs.accelerations(*x), q, v) - a).max() / np.abs(a).max()
        for x, (q, v, _), a in zip(there, some, ours, strict=True)
    )
    peers = pinocchio_ns(theirs, there)
    for what, f in (("loops", held), ("open", free)):
        for size in (512, BATCH):
            row = measure(jax.vmap(f), *(x[:size] for x in inputs), budget_s=2.0)
            ns = row["run_min_s"] / size * 1e9
            yield {
                "robot": Path(path).stem, "what": what, "batch": size, "ns": ns,
                "Pinocchio ns": peers[what], "Pinocchio's time over ours": peers[what] / ns,
                "compile_s": row["lower_s"] + row["compile_s"], "loops differ by": off,
            }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", help="MJCF files with connect constraints")
    found: list[dict] = []
    robots = parser.parse_args().robots
    if not robots:
        print("nothing measured: name MJCF files with connect constraints, as in "
              "python -m benchmarks.cpu.loops cassie.xml")  # fmt: skip
        return
    for path in robots:
        for row in rows(path):
            found.append(row)
            print(row, flush=True)
    print(markdown_table(found, found[-1]))
    print(save("cpu-loops", found))


if __name__ == "__main__":
    main()
