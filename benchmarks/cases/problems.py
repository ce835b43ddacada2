"""Problems whose truth is known: an arm with 55 unknowns, a quadruped in the air with 49."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.sysid import PD, Channel, Grid, Inertia, Recording, Setup, Unknown
from rbjax.sysid.parameters import (
    from_log_cholesky,
    inertial_parameters_of,
    pseudo_inertia_of,
    to_log_cholesky,
)
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.simulation.setup import simulate_motion

ORACLES = Path(__file__).parents[2] / "tests" / "oracles"
GO2 = Path(__file__).parents[3] / "shared" / "data" / "go2_in_air"


class Problem(NamedTuple):
    """A set-up with first guesses, what was recorded, what is sought, and the true numbers."""

    setup: Setup
    run: Recording
    unknowns: dict[str, Any]
    truth: np.ndarray
    how: dict[str, Any]


def arm(seed: int = 0) -> Problem:
    """The arm of MuJoCo's own test: five armatures from a fiftieth of their value, five bodies off
    by a tenth. Another seed has other commands and first guesses."""
    given = json.loads((ORACLES / "arm5.json").read_text())
    with warnings.catch_warnings(action="ignore"):
        model = rb.load(given["mjcf"], contacts=False)
    T, N = 0.002, 999
    t = np.arange(N + 1) * T
    ctrl = np.array([5, 4, 3, 2, 1.0]) * np.sin(
        2 * np.pi * np.array([0.5, 0.7, 0.4, 0.9, 0.6]) * t[:-1, None] + np.arange(5) / 2 + seed
    )
    grid, setup = Grid(T, 1, "dop853"), Setup.of(model)
    path = simulate_motion(
        lambda p: setup, jnp.zeros(1), model.default_state(), jnp.asarray(ctrl), grid
    )
    for k, state in given["exact_for_held_controls"].items() if seed == 0 else ():
        np.testing.assert_allclose([*path.q[int(k)], *path.v[int(k)]], state, atol=1e-11)
    unknowns: dict[str, Any] = {"armature": Unknown("joints.armature", positive=True)}
    unknowns |= {f"link{k + 1}": Inertia(f"link{k + 1}") for k in range(5)}
    of = Unknowns.of("arm", unknowns, setup)
    truth = np.asarray(of.read(setup))
    guess, rng = truth.copy(), np.random.default_rng(seed)
    guess[:5] = 0.01
    for k in range(5, 55, 10):
        theta = to_log_cholesky(pseudo_inertia_of(truth[k : k + 10])) + 0.1 * rng.normal(size=10)
        guess[k : k + 10] = inertial_parameters_of(from_log_cholesky(theta))
    run = Recording("arm", {
        "q": Channel(t, path.q), "v": Channel(t, path.v), "ctrl": Channel(t[:-1], ctrl),
    })  # fmt: skip
    # RK4 is within 1e-11 of the recorded motion, and the first readings are the state
    how = {"grid": Grid(T), "estimate_initial_state": False}
    return Problem(of.write(setup, jnp.asarray(guess)), run, unknowns, truth, how)


def quadruped() -> Problem:
    """Go2 in the air for 20 s at 400 Hz: armature, viscous and Coulomb friction and bias of twelve
    joints, and a delay. Its files lie beside the repository."""
    with warnings.catch_warnings(action="ignore"):
        model = rb.load(str(GO2 / "go2_in_air.xml"), contacts=False)
    model = model.replace(
        joints=model.joints.replace(armature=np.full(12, 0.01), damping=np.full(12, 0.1))
    )
    dry = rb.forces.JointFriction.of(model, model.joint_names, coulomb=0.1, smoothing=0.05)
    servo = PD(jnp.full(12, 20.0), jnp.full(12, 1.5))
    setup = Setup.of(model.with_forces(dry), servo, delay=0.004)
    data = np.load(GO2 / "synthetic_49.npz")
    T, N = 1 / 400, 8000
    t = np.arange(N) * T
    middle, size = np.tile([0.0, 0.9, -1.75], 4), np.tile([0.25, 0.35, 0.5], 4)
    sign = np.array([1, 1, 1, -1, 1, 1, 1, -1, -1, -1, -1, -1])
    chirp = np.sin(2 * np.pi * (0.1 * t + (10 - 0.1) / (2 * 20) * t**2))
    asked = middle + sign * size * chirp[:, None]
    q = np.array(data["position_rad"], float)
    q[0] = asked[0]  # the start is known: at rest where the first reading is the first command
    v = np.full((N, 12), np.nan)
    v[0] = 0.0
    run = Recording("chirp", {
        "q": Channel(t, q, noise=np.full(12, 5e-4)),
        "v": Channel(t, v, noise=np.ones(12), dropped="nan"),
        "ctrl": Channel(t, asked),
    })  # fmt: skip
    unknowns = {
        "armature": Unknown("joints.armature", positive=True),
        "viscous": Unknown("joints.damping", positive=True),
        "coulomb": Unknown("forces.0.coulomb", positive=True),
        "bias": Unknown("sensors.q.bias", scale=0.1),
        "delay": Unknown("delay", bounds=(0.0, 0.025)),
    }
    kinds = ("armature", "viscous", "coulomb", "bias")
    true = np.concatenate([data[f"true_{k}"] for k in kinds])
    true[36:] *= -1  # theirs is taken off the reading
    truth = np.append(true, data["true_delay_s"])
    return Problem(setup, run, unknowns, truth, {"grid": Grid(T, 3, "rk4", 11)})
