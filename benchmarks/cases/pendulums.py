"""Pendulums of several arms: a model from numbers, and the recordings of a real one.

Source of the recordings: Kaheman et al., arXiv 2205.06231, github.com/dynamicslab/MultiArm-Pendulum
(MIT). They lie beside the repository.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.io import loadmat

import rbjax as rb
from rbjax.sysid import (
    Channel,
    Grid,
    Identified,
    Recording,
    Setup,
    Unknown,
    free_run,
    identify,
)
from rbjax.sysid.simulation.traces import Trace

DATA = Path(__file__).parents[3] / "shared" / "data" / "multiarm_pendulum"
NAMES = ("single", "double", "triple")
SECONDS = 1.5  # of a piece
RATE = 1e-3  # s, between two samples
EVERY = 4  # samples, of which one is kept


class Arms(NamedTuple):
    """By arm: mass, distance of the centre of mass from the joint, of the next joint from it,
    inertia about the centre of mass, viscous friction on the relative rate; gravity. SI."""

    mass: list[float]
    centre: list[float]
    length: list[float]
    inertia: list[float]
    viscous: list[float]
    gravity: float = 9.81


def chain(arms: Arms) -> rb.Model:
    """A pendulum of arms in a plane, each angle relative to the arm before it, 0 hanging down."""
    xml = ""
    rows = zip(arms.mass, arms.centre, arms.inertia, arms.viscous, strict=True)
    for k, (m, a, I, d) in enumerate(rows):
        below = 0.0 if k == 0 else -arms.length[k - 1]
        xml += (
            f'<body name="arm{k + 1}" pos="0 0 {below!r}">'
            f'<joint name="joint{k + 1}" axis="0 1 0" damping="{d!r}"/>'
            f'<inertial pos="0 0 {-a!r}" mass="{m!r}" diaginertia="{I!r} {I!r} {I!r}"/>'
        )
    xml += "</body>" * len(arms.mass)
    option = f'<option gravity="0 0 {-arms.gravity!r}"/>'
    return rb.load(f"<mujoco>{option}<worldbody>{xml}</worldbody></mujoco>")


def published(name: str) -> Arms:
    """The numbers that were published with the recordings."""
    p = json.loads((DATA / "estimated_parameters.json").read_text())[name.capitalize()]
    n = NAMES.index(name) + 1
    if n == 1:
        a, m, I, k, g = p
        return Arms([m], [a], [], [I], [k], g)
    ends = np.cumsum([n, n, n - 1, n, n])
    return Arms(*(x.tolist() for x in np.split(np.array(p), ends)[:5]), p[-1])


def recordings(name: str, every: int = EVERY) -> dict[str, Recording]:
    """Pieces of 1.5 s, in the order in which they were recorded. Velocities are the ones of the
    files, at the first sample only, where a simulation starts from them; they count for nothing."""
    files = loadmat(DATA / f"{name.capitalize()}PendulumDataForParameterEstimation.mat")
    found = {}
    N = round(SECONDS / RATE)
    for kind in ("id", "vad"):
        for k, Y in enumerate(files[f"Y_{kind}"].ravel()):
            angle, rate = np.split(Y, 2)
            q = np.diff(angle - np.pi, axis=0, prepend=0).T
            v = np.diff(rate, axis=0, prepend=0).T
            for j in range(len(q) // N):
                rows = slice(j * N, (j + 1) * N + 1, every)
                t = np.arange(len(q[rows])) * RATE * every
                first = np.where(np.arange(len(t))[:, None] == 0, v[rows], np.nan)
                where = f"{kind} {k}" + (f".{j}" if len(q) >= 2 * N else "")
                found[where] = Recording(where, {
                    "q": Channel(t, q[rows]),
                    "v": Channel(t, first, noise=np.full(q.shape[1], 1e6), dropped="nan"),
                })  # fmt: skip
    return found


def split(name: str) -> tuple[list[Recording], list[Recording]]:
    """Pieces to fit and pieces to score: of the stretches that were published for identification
    every other one is fitted, and none of the last ones, which were published for validation."""
    runs = recordings(name)
    place = [key.removeprefix("id ").split(".")[-1] for key in runs]
    fitted = [key.startswith("id") and int(k) % 2 == 0 for key, k in zip(runs, place, strict=True)]
    pairs = [*zip(runs.values(), fitted, strict=True)]
    return [run for run, yes in pairs if yes], [run for run, yes in pairs if not yes]


class Air(rb.forces.Element):
    """A torque -c |w| w on each body, with its angular velocity w in the world."""

    drag: jax.Array  # (nb,) N m s^2/rad^2

    def loads(self, context: rb.forces.Context) -> rb.forces.Loads:
        def turn(body: rb.forces.FrameState, drag: Any) -> rb.forces.Loads:
            w = body.angular_velocity
            return body.push(jnp.zeros(3), w * (-drag * w.norm(1e-6)))

        return rb.forces.on_each(context, range(context.model.nb), turn, self.drag)


def design(name: str, terms: Sequence[str]) -> tuple[Setup, dict[str, Any]]:
    """A set-up and its unknowns, with some of viscous, coulomb, air, bias. A free swing shows only
    ratios of inertias, so all masses and the last arm's inertia are held."""
    arms = published(name)
    n = len(arms.mass)
    model = chain(arms if "viscous" in terms else arms._replace(viscous=[0.0] * n))
    dry = rb.forces.JointFriction.of(
        model, model.joint_names, coulomb=1e-4 if "coulomb" in terms else 0.0, smoothing=0.05
    )
    drag = jnp.full(n, 1e-5 if "air" in terms else 0.0)
    air = Air(drag)
    unknowns: dict[str, Any] = {"centre": Unknown("bodies.com", (np.arange(n), 2), scale=0.1)}
    if n > 1:
        inertia, length = (np.arange(n - 1), 1, 1), (np.arange(1, n), 2)
        unknowns["inertia"] = Unknown("bodies.inertia", inertia, positive=True)
        unknowns["length"] = Unknown("bodies.position", length, scale=0.1)
    possible = {
        "viscous": Unknown("joints.damping", positive=True),
        "coulomb": Unknown("forces.0.coulomb", positive=True),
        "air": Unknown("forces.1.drag", positive=True),
        "bias": Unknown("sensors.q.bias", scale=0.01),
    }
    return Setup.of(model.with_forces(dry, air)), unknowns | {k: possible[k] for k in terms}


#: Coulomb friction in the joints, drag of the arms in the air, encoders that are not zero below
TERMS = ("coulomb", "air", "bias")
GRID = Grid(0.005, 2)


def fit(name: str, fitted: Sequence[Recording], terms: Sequence[str] = TERMS) -> Identified:
    setup, unknowns = design(name, terms)
    return identify(setup, fitted, unknowns, grid=GRID, estimate_initial_state=True)


def errors(
    model: rb.Model | Setup, runs: Sequence[Recording], *, known: float = SECONDS
) -> np.ndarray:
    """By piece, the RMS over samples and arms of the angles from the vertical, rad. The start is
    the one that suits the first `known` seconds best; 0: that of the files."""
    if 0 < known < SECONDS:
        early = free_run(
            model, [run.segment(0, known) for run in runs], grid=GRID, estimate_initial_state=True
        )
        runs = [
            _from(run, *found.values()) for run, found in zip(runs, early.values(), strict=True)
        ]
    found = free_run(model, runs, grid=GRID, estimate_initial_state=known == SECONDS)
    off = [
        np.cumsum(sensors["q"].recorded - sensors["q"].simulated, -1) for sensors in found.values()
    ]
    return np.array([np.sqrt(np.mean(r**2)) for r in off])


def _from(run: Recording, *first: Trace) -> Recording:
    """The recording with the first readings of a simulation; they are not scored."""

    def replaced(c: Channel, by: Trace) -> Channel:
        return Channel(
            c.t, np.vstack([by.simulated[:1], c.values[1:]]), noise=c.noise, dropped="nan"
        )

    return Recording(run.name, {s: replaced(run[s], by) for s, by in zip(run, first, strict=True)})
