"""Friction, stiffness and size of the tossed cube of ContactNets, from half of the tosses.

`python -m benchmarks.cpu.contact_cube [--small]` writes results/cpu-contact-cube-<processor>.json.
Errors are mean distances in mm of simulated and recorded positions, on tosses that were not fitted,
over 0.53 s and at its end. The models:

    published, MuJoCo    friction and size of the paper, solref and solimp of MuJoCo
    published, impulses  friction, restitution and size of the paper, Moreau's time stepping
    identify             `rb.sysid.identify` by gradients, on the first 25 samples (0.17 s)
    search               Nelder and Mead's search from there, on all 80 samples

Derivatives through several impacts have no bound, so gradients see the first impacts only. Both
fits start from friction 0.4 and a half side of 60 mm. The unit of length of the cameras is unknown
too: the free fall in the data is 9.57 m/s^2.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

import rbjax as rb
from benchmarks.cases import cube
from benchmarks.shared.timing import markdown_table, save
from rbjax.sysid import Setup
from rbjax.sysid.parameters.unknown_vector import Unknowns

#: samples of each toss that the fit by gradients sees
FIRST = 25
COLUMNS = (
    "model", "mean", "end", "friction", "time constant", "damping ratio", "half side", "unit",
    "seconds",
)  # fmt: skip


def guess() -> rb.Model:
    """The model from which the fits start, with a force that is continuous at touch."""
    return cube.model(friction=0.4, half=0.06, impedance=0.1)


def identified(seen: np.ndarray, evaluations: int) -> dict[str, float]:
    """Fit by gradients."""
    found = rb.sysid.identify(
        guess(), cube.recordings(seen[:, :FIRST]), cube.unknowns(), grid=cube.GRID, loss="huber",
        restarts=0, max_evaluations=evaluations,
    )  # fmt: skip
    return found.values


def searched(seen: np.ndarray, start: dict[str, float], evaluations: int) -> dict[str, float]:
    """Fit without gradients: the least mean distance, by Nelder and Mead."""
    setup = Setup.of(guess())
    unknowns = Unknowns.of("contact_cube", cube.unknowns(), setup)
    first = np.array(list(start.values()))

    @jax.jit
    def cost(p: jax.Array) -> jax.Array:
        now = unknowns.write(setup, p)
        return 1e3 * cube.distances(cube.simulated(now.model, seen, p[-1]), seen).mean()

    # steps of the first simplex, in logarithms
    size = np.diag([0.15, 0.5, 0.3, 0.03, 0.02])
    found = minimize(
        lambda z: float(cost(jnp.asarray(first * np.exp(z)))), np.zeros(5), method="Nelder-Mead",
        options={"maxfev": evaluations, "initial_simplex": np.vstack([np.zeros(5), size])},
    )  # fmt: skip
    return dict(zip(start, map(float, first * np.exp(found.x)), strict=True))


def fitted(values: dict[str, float]) -> rb.Model:
    """The model with fitted values."""
    setup = Setup.of(guess())
    unknowns = Unknowns.of("contact_cube", cube.unknowns(), setup)
    return unknowns.write(setup, jnp.asarray(list(values.values()))).model


def row(name: str, unseen: np.ndarray, model: rb.Model, unit: float, law: Any) -> dict[str, Any]:
    """The errors of a model on unseen tosses."""
    far = 1e3 * np.asarray(cube.distances(cube.simulated(model, unseen, unit, law), unseen))
    return {"model": name, "mean": float(far.mean()), "end": float(far[:, -1].mean())}


def run(fit: Any, check: Any, evaluations: int, small: bool) -> list[dict[str, Any]]:
    """Fit some tosses, given by their numbers, and compare models on others."""
    seen, unseen = cube.tosses(fit), cube.tosses(check)
    published, rows = cube.model(), []
    names = {k: cube.PUBLISHED[k] for k in ("friction", "half side")}
    impulses = rb.contact.MoreauContact.of(
        published, restitution=cube.PUBLISHED["restitution"], friction=cube.PUBLISHED["friction"]
    )
    laws = {"published, MuJoCo": None} | ({} if small else {"published, impulses": impulses})
    for name, law in laws.items():
        rows.append(row(name, unseen, published, 1.0, law) | names | {"unit": 1.0})
    begin = time.perf_counter()
    found = identified(seen[::2], max(evaluations // 8, 2))
    for name in ("identify", "search"):
        if name == "search":
            begin = time.perf_counter()
            found = searched(seen, found, evaluations)
        seconds = time.perf_counter() - begin
        rows.append(row(name, unseen, fitted(found), found["unit"], None) | found)
        rows[-1]["seconds"] = seconds
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--small", action="store_true", help="few tosses and evaluations, without impulses"
    )
    small = parser.parse_args().small
    if not cube.DATA.exists():
        raise SystemExit(f"the tosses are not there: {cube.DATA}")
    if small:
        found = run(range(0, 570, 95), range(1, 570, 95), 16, small)
    else:
        found = run(range(0, 570, 6), range(1, 570, 2), 240, small)
        save("cpu-contact-cube", found)
    print(markdown_table(found, COLUMNS))
