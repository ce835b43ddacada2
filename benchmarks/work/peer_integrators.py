"""Integrators of MJX and MuJoCo Warp: a step of each against the same step of MuJoCo C in f64.

    pip install mujoco-warp==4.0.0
    python -m benchmarks.work.peer_integrators

A damped pendulum, f32. An integrator that an engine names but does not step with has no error.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import mujoco
import mujoco_warp as mjw
import numpy as np
from mujoco import mjx

from benchmarks.shared.timing import markdown_table, save

PENDULUM = """<mujoco><worldbody><body><joint axis="0 1 0" damping="0.5"/>
  <geom size="0.1" pos="0.3 0 0"/></body></worldbody></mujoco>"""


def by_mujoco(m: mujoco.MjModel) -> np.ndarray:
    d = mujoco.MjData(m)
    mujoco.mj_step(m, d)
    return d.qvel


def by_mjx(m: mujoco.MjModel) -> np.ndarray:
    model = mjx.put_model(m)
    return np.asarray(jax.jit(mjx.step)(model, mjx.make_data(model)).qvel)


def by_warp(m: mujoco.MjModel) -> np.ndarray:
    model, d = mjw.put_model(m), mjw.make_data(m)
    mjw.step(model, d)
    return d.qvel.numpy()[0]


ENGINES: dict[str, Callable[[mujoco.MjModel], np.ndarray]] = {
    "mjx": by_mjx, "MuJoCo Warp": by_warp
}  # fmt: skip


def main() -> None:
    m, rows = mujoco.MjModel.from_xml_string(PENDULUM), []
    for kind in mjw.IntegratorType:
        m.opt.integrator = int(kind)
        for engine, step in ENGINES.items():
            row: dict[str, Any] = {"engine": engine, "integrator": kind.name.lower()}
            try:
                row["error"] = float(np.abs(step(m) - by_mujoco(m)).max())
            except NotImplementedError as refused:
                row["note"] = str(refused)
            rows.append(row)
    print(markdown_table(rows, ("engine", "integrator", "error", "note")))
    print(save("work-peer-integrators", rows))


if __name__ == "__main__":
    main()
