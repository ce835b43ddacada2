"""CPU seconds from a call to machine code, by stages: JAX's trace, our program, LLVM, XLA.

    python -m benchmarks.cpu.compile_stages

Each row is a process of its own, so that no row finds what another has traced. f64. The time to
lower is that of our program (`write_program`, the IR) and of LLVM, and the rest is JAX's.
"""

import benchmarks.shared.one_core  # noqa: F401, I001 (before jax)

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.shared.progress import progress
from benchmarks.shared.robots import ALL, as_model, compiled, states
from benchmarks.shared.timing import fastest_ns, markdown_table, save
from rbjax.compiler.jax import launch, primitive
from rbjax.compiler.llvm import jit as llvm_jit

COLUMNS = ("what", "robot", "seconds", "asked_s", "trace_s", "program_s", "llvm_s", "lower_rest_s",
           "xla_s", "statements", "run_us")  # fmt: skip
#: seconds asked for, by row
ASKED = {
    ("forward dynamics", "panda"): 0.5,
    ("forward dynamics", "humanoid"): 1.5,
    ("forward dynamics", "g1"): 3.0,
    ("gradient of 100 steps by the model", "arm7"): 5.0,
}


def branching_tree(joints: int, seed: int = 0) -> str:
    """An MJCF of hinges, each on one of the three before it: limbs of all lengths, no two alike."""
    rng = np.random.default_rng(seed)
    parents = [-1, *(max(0, i - int(rng.integers(1, 4))) for i in range(1, joints))]

    def body(i: int) -> str:
        axis = np.eye(3)[rng.integers(3)]
        place, size = rng.uniform(-0.3, 0.3, 3), rng.uniform(0.03, 0.08, 3)
        inside = "".join(body(k) for k in range(joints) if parents[k] == i)
        return (
            f'<body pos="{" ".join(map(str, place))}"><joint axis="{" ".join(map(str, axis))}"/>'
            f'<geom type="box" size="{" ".join(map(str, size))}" pos="0.05 0.02 0.1"/>'
            f"{inside}</body>"
        )

    return f"<mujoco><worldbody>{body(0)}</worldbody></mujoco>"


def dynamics(model: rb.Model) -> Callable:
    return lambda q, v, tau: rb.forward_dynamics(model, q, v, tau)


def case(what: str, robot: str) -> tuple[Callable, tuple]:
    """The function of a row and its arguments."""
    if what == "forward dynamics":
        if robot == "branching60":
            model = rb.load(branching_tree(60))
            state = model.random_state(jax.random.key(0))
            return dynamics(model), (state.q, state.v, 0 * state.v)
        reference = compiled(robot)
        args = tuple(np.ascontiguousarray(x[0]) for x in states(reference, 1))
        return dynamics(as_model(reference)), args
    model = rb.load(robot)
    args = model, model.random_state(jax.random.key(0)), jnp.zeros((100, model.nu))

    def loss(model: rb.Model, state: rb.State, u: jax.Array) -> jax.Array:
        return (rb.rollout(model, state, u, 0.001, save_every=100).q[-1] ** 2).sum()

    return jax.grad(loss, 0 if what.endswith("model") else 2), args


CASES = [
    *(("forward dynamics", name) for name in (*ALL, "branching60")),
    *((f"gradient of 100 steps by the {x}", "arm7") for x in ("model", "controls")),
    ("gradient of 100 steps by the model", "humanoid"),
]


@contextmanager
def stages() -> Iterator[dict[str, float]]:
    """Seconds within the parts of the lowering."""
    found = {"program_s": 0.0, "llvm_s": 0.0, "statements": 0.0}
    parts = ((primitive, "write_program", "program_s"), (launch, "write_handler", "program_s"),
             (llvm_jit, "compile_object", "llvm_s"))  # fmt: skip
    before = [getattr(module, name) for module, name, _ in parts]

    def timed(f: Callable, stage: str) -> Callable:
        def call(*args: Any, **options: Any) -> Any:
            start = time.process_time()
            out = f(*args, **options)
            found[stage] += time.process_time() - start
            found["statements"] += getattr(out, "statements", 0)
            return out

        return call

    for (module, name, stage), f in zip(parts, before, strict=True):
        setattr(module, name, timed(f, stage))
    try:
        yield found
    finally:
        for (module, name, _), f in zip(parts, before, strict=True):
            setattr(module, name, f)


def row(what: str, robot: str) -> dict[str, Any]:
    f, args = case(what, robot)
    launch.host_kernels_work()  # the self-test, once a process
    with stages() as found:
        start = time.process_time()
        traced = jax.jit(f).trace(*args)
        lowering = time.process_time()
        lowered = traced.lower()
        compiling = time.process_time()
        run = lowered.compile()
        end = time.process_time()
    out = {"what": what, "robot": robot, "seconds": end - start, "trace_s": lowering - start}
    out |= found | {"xla_s": end - compiling}
    # what a derivative traces while it is lowered, and JAX's own part
    out["lower_rest_s"] = compiling - lowering - found["program_s"] - found["llvm_s"]
    ns = fastest_ns(lambda: jax.block_until_ready(run(*args)), 1, 100)
    return out | {"asked_s": ASKED.get((what, robot)), "run_us": ns / 1e3}


def main() -> None:
    if len(sys.argv) > 1:
        print(json.dumps(row(*CASES[int(sys.argv[1])])))
        return
    rows = []
    for k in progress(range(len(CASES))):
        command = [sys.executable, "-m", "benchmarks.cpu.compile_stages", str(k)]
        done = subprocess.run(command, check=True, text=True, stdout=subprocess.PIPE)
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(rows[-1], flush=True)
    print(markdown_table(rows, COLUMNS))
    print(save("cpu-compile-stages", rows))


if __name__ == "__main__":
    main()
