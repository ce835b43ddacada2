"""Mechanisms with loops and their motions, for `formulations`; this file is no benchmark."""

from __future__ import annotations

import dataclasses
import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.cases.mechanisms import (
    andrews,
    four_bars,
    pendulum,
    spatial_slider_crank,
    tilted_four_bar,
)
from rbjax import constraints as rc

ROOT = Path(__file__).parents[2]
CASSIE = ROOT.parent / "shared" / "data" / "cassie"  # beside the repository
FIGURES = json.loads((ROOT / "tests" / "oracles" / "loops.json").read_text())


@dataclasses.dataclass(frozen=True)
class Mechanism:
    """A motion: model and start; seconds; generalized forces (nv,); q and v at the end if there is
    a closed form; chunks of steps on the coarsest rung."""

    title: str
    model: rb.Model
    start: rb.State
    seconds: float
    tau: Any = None
    end: tuple[np.ndarray, np.ndarray] | None = None
    chunks: int = 1


def _pendulum() -> Mechanism:
    """Ten seconds would hide what two show."""
    start = rb.State(jnp.array([-1.0, 0.0]), jnp.zeros(2))
    at = FIGURES["pendulum"]["samples"]["2.0"]
    end = np.array([at["x"], at["y"]]), np.array([at["vx"], at["vy"]])
    return Mechanism("Cartesian pendulum", pendulum(), start, 2.0, end=end)


def _four_bar() -> Mechanism:
    """The parallelogram let go below its dead points, between which it swings."""
    model = rb.load("four_bar")
    start = model.default_state().replace(q=2.2 * jnp.array([1.0, -1.0, 1.0]))
    return Mechanism("four-bar, a parallelogram", model, start, 2.0)


def _four_bar_3d() -> Mechanism:
    model = tilted_four_bar("0.8 0.3 -0.2 0.4")
    return Mechanism("four-bar, 3 of 5 rows redundant", model, model.default_state(), 2.0)


def _andrews() -> Mechanism:
    figures = FIGURES["andrews"]
    model, start = andrews(figures["parameters"], figures["q0"])
    tau = jnp.zeros(7).at[model.joint("K1")].set(figures["parameters"]["mom"])
    return Mechanism("Andrews' squeezer", model, start, 0.03, tau)


def _delta() -> Mechanism:
    """Thrown: its arms at 5, -3 and 1 rad/s, the rest as the loops ask."""
    model = rb.load("delta")
    v = jnp.zeros(model.nv)
    for name, speed in (("shoulder1", 5.0), ("shoulder2", -3.0), ("shoulder3", 1.0)):
        v = v.at[model.v_slice(name)].set(speed)
    guess = model.default_state().replace(v=v)
    start = rc.assemble(model, guess, pinned=["shoulder1", "shoulder2", "shoulder3"]).state
    return Mechanism("delta robot, thrown", model, start, 0.3)


def _through_singular_positions() -> Mechanism:
    model, start = four_bars(2)
    at = FIGURES["four_bars"]["2"]["2.0"]
    ways = np.array([1.0, -1.0, 1.0, -1.0, 1.0])
    end = at["theta"] * ways, at["thetadot"] * ways
    return Mechanism("two four-bars, singular twice", model, start, 2.0, end=end, chunks=2)


def _cassie() -> Mechanism:
    """Thrown with random velocities, as near to them as the loops allow."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*left out of the model")
        model = rb.load(CASSIE / "cassie.xml")
    q = json.loads((CASSIE / "consistent.json").read_text())["qpos"]
    v = np.random.default_rng(0).normal(size=model.nv)
    start = rc.assemble(model, model.default_state().replace(q=jnp.array(q), v=jnp.array(v))).state
    return Mechanism("Cassie, thrown", model, start, 0.1)


MECHANISMS: dict[str, Callable[[], Mechanism]] = {
    "pendulum": _pendulum,
    "four_bar": _four_bar,
    "four_bar_3d": _four_bar_3d,
    "slider_crank": lambda: Mechanism("spatial slider-crank", *spatial_slider_crank(), 2.0),
    "andrews": _andrews,
    "delta": _delta,
    "four_bars": _through_singular_positions,
    "cassie": _cassie,
}
