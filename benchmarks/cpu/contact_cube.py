"""Friction, stiffness and size of the tossed cube of ContactNets, from half of the tosses.

`python -m benchmarks.cpu.contact_cube [--small]` writes results/cpu-contact-cube-<processor>.json.
Errors are mean distances in mm of simulated and recorded positions, on tosses that were not fitted,
over 0.53 s and at its end. The models:

    published, MuJoCo    friction and size of the paper, solref and solimp of MuJoCo
    published, impulses  friction, restitution and size of the paper, Moreau's time stepping
    identify             `rb.sysid.identify` with `difference_step=0.03`, loss "huber", 1 restart

Derivatives through several impacts have no bound, so the slopes of the fit are differences of
3 %. It starts from friction 0.4 and a half side of 60 mm. The unit of length of the cameras is
unknown too: the free fall in the data is 9.57 m/s^2.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

import rbjax as rb
from benchmarks.cases import cube
from benchmarks.shared.timing import markdown_table, save
from rbjax.sysid import Identified

COLUMNS = (
    "model", "mean", "end", "friction", "time constant", "damping ratio", "half side", "unit",
    "status", "seconds",
)  # fmt: skip


def guess() -> rb.Model:
    """The model from which the fits start, with a force that is continuous at touch."""
    return cube.model(friction=0.4, half=0.06, impedance=0.1)


def identified(seen: np.ndarray, evaluations: int) -> Identified:
    """Fit to all samples, by differences instead of derivatives."""
    return rb.sysid.identify(
        guess(), cube.recordings(seen), cube.unknowns(), grid=cube.GRID, loss="huber", restarts=1,
        difference_step=0.03, max_evaluations=evaluations,
    )  # fmt: skip


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
    found = identified(seen, evaluations)
    seconds = time.perf_counter() - begin
    fit = row("identify", unseen, found.model, found.values["unit"], None) | found.values
    rows.append(fit | {"seconds": seconds, "status": found.status.name})
    print(found.summary())
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--small", action="store_true", help="few tosses and evaluations, without impulses"
    )
    small = parser.parse_args().small
    if not cube.DATA.exists():
        print(f"{cube.DATA} is not there: nothing to measure")
        return
    if small:
        found = run(range(0, 570, 95), range(1, 570, 95), 8, small)
    else:
        found = run(range(0, 570, 6), range(1, 570, 2), 100, small)
        save("cpu-contact-cube", found)
    print(markdown_table(found, COLUMNS))


if __name__ == "__main__":
    main()
