"""One call of forward dynamics from Python: rbjax, Pinocchio, MJX and MuJoCo Warp.

    pip install mujoco-warp==4.0.0  # optional
    python -m benchmarks.cpu.one_call_peers

One sample, one core, f64, but for MuJoCo Warp, which has f32 only. The engines take turns, and the
best run of each counts, so that other processes disturb none. MuJoCo C is in `cpu.one_call`.
Pinocchio has no model of the humanoid. `mjx.forward` is jitted; it runs with XLA's defaults and, as
"mjx_plain", without its fusion emitters, which for the Panda evaluate poses again for every use.
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
from benchmarks.shared.warp_states import assign

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


def warp_call(m: mujoco.MjModel, *args: np.ndarray) -> Callable[[], Any] | None:
    """A call of `mujoco_warp.forward`, which returns the acceleration; None without the package."""
    try:
        import mujoco_warp as mjw
    except ModuleNotFoundError:
        return None
    model, data = mjw.put_model(m), mjw.make_data(m, nworld=1)

    def call() -> np.ndarray:
        assign(data, *(x[None] for x in args))
        mjw.forward(model, data)
        return data.qacc.numpy()

    return call


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
        "warp": warp_call(actuated(name), q, v, tau),
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
                count, runs = (CALLS, 3) if engine in ("rbjax", "pinocchio") else (2, 60)
                found = fastest_ns(lambda f=call, n=count: [f() for _ in range(n)], count, runs)
                row[f"{engine}_ns"] = min(found, row.get(f"{engine}_ns", np.inf))
    return row


def main() -> None:
    rows = [robot(name) for name in NAMES]
    print(markdown_table(rows, ("robot", *(key for key in rows[-1] if key.endswith("_ns")))))
    print(save("cpu-one-call-peers", rows))


if __name__ == "__main__":
    main()
