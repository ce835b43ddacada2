"""One call of forward dynamics from Python: `rb.compile`, `pinocchio.aba`, a jitted `mjx.forward`.

    python -m benchmarks.cpu.one_call_peers

One sample, f64, one core. The engines take turns, and the best run of each counts, so that other
processes disturb none. MuJoCo C is in `cpu.one_call`. Pinocchio has no model of the humanoid. MJX
runs with XLA's defaults and, as "mjx_plain", without its fusion emitters, which for the Panda
evaluate poses again for every use.
"""

import benchmarks.shared.one_core  # noqa: F401, I001 (before jax)

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import mujoco
import numpy as np
import pinocchio as pin
from mujoco import mjx

import rbjax as rb
from benchmarks.cases.models import MODELS
from benchmarks.shared.robots import NAMES, actuated, as_model, compiled, states
from benchmarks.shared.timing import fastest_ns, markdown_table, save

CALLS, TURNS = 200, 20


def pinocchio_call(name: str) -> Callable[[], Any] | None:
    """A call of `pin.aba` at a random state; None without a URDF."""
    entry = MODELS[NAMES[name]]
    if entry.path.suffix != ".urdf":
        return None
    base = pin.JointModelFreeFlyer() if entry.floating_base else None
    model = pin.buildModelFromUrdf(str(entry.path), *([base] if base else []))
    data, rng = model.createData(), np.random.default_rng(0)
    q = pin.integrate(model, pin.neutral(model), rng.normal(size=model.nv))
    v, tau = rng.normal(size=(2, model.nv))
    return lambda: pin.aba(model, data, q, v, tau)


def mjx_call(m: mujoco.MjModel, emitters: bool, *args: Any) -> Callable[[], Any]:
    """A call of a jitted `mjx.forward`, which returns the acceleration."""
    model, blank = mjx.put_model(m), mjx.make_data(m)

    @partial(jax.jit, compiler_options={"xla_cpu_use_fusion_emitters": emitters})
    def forward(q: Any, v: Any, tau: Any) -> jax.Array:
        return mjx.forward(model, blank.replace(qpos=q, qvel=v, qfrc_applied=tau)).qacc

    return lambda: forward(*args).block_until_ready()


def robot(name: str) -> dict[str, Any]:
    reference = compiled(name)
    model = as_model(reference)
    q, v, tau = (np.ascontiguousarray(x[0]) for x in states(reference, 1))
    native = rb.compile(lambda *x: rb.forward_dynamics(model, *x), q, v, tau)
    calls = {
        "rbjax": lambda: native(q, v, tau),
        "pinocchio": pinocchio_call(name),
        "mjx": mjx_call(actuated(name), True, q, v, tau),
        "mjx_plain": mjx_call(actuated(name), False, q, v, tau),
    }
    row: dict[str, Any] = {"robot": name}
    for engine, call in calls.items():
        if call:
            begin = time.perf_counter()
            call()
            row[f"{engine}_first_s"] = time.perf_counter() - begin
    for _ in range(TURNS):
        for engine, call in calls.items():
            if call:
                count = CALLS // 10 if "mjx" in engine else CALLS
                found = fastest_ns(lambda f=call, n=count: [f() for _ in range(n)], count, 3)
                row[f"{engine}_ns"] = min(found, row.get(f"{engine}_ns", np.inf))
    return row


def main() -> None:
    rows = [robot(name) for name in NAMES]
    print(markdown_table(rows, ("robot", "rbjax_ns", "pinocchio_ns", "mjx_ns", "mjx_plain_ns")))
    print(save("cpu-one-call-peers", rows))


if __name__ == "__main__":
    main()
