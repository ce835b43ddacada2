"""Comparison of a robot's motion in rbjax with MuJoCo C (f64) and MJX (f32 and f64)."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from rbjax.arguments import flag, integer, real_number, shown
from rbjax.errors import InputError
from rbjax.loading import compile_model
from rbjax.loading.loader import from_compiled
from rbjax.validation import contacts as contacts_of
from rbjax.validation import ours
from rbjax.validation.mjx import Mjx
from rbjax.validation.reference import (
    Array,
    StateSamples,
    final_gradient,
    quantities,
    random_samples,
    smooth,
    trajectory,
)
from rbjax.validation.report import Report, ReportRow, relative

#: tolerances of functions of one state: rounding times the condition number of M
ALGORITHM = {"rbjax f64": 1e-10, "rbjax f32": 1e-4}
#: tolerance of a trajectory, in units of the last place times the factor by which MuJoCo's own
#: trajectory amplifies a change of its initial velocity
UNITS = 1e4
EPSILON = {"rbjax f64": 2.2e-16, "rbjax f32": 1.2e-7}
#: least tolerance of gradients, for errors of MuJoCo's central differences
DIFFERENCES = 1e-8
GRADIENTS = 3  # states for which the gradient of the trajectory is compared


def compare(
    source: Any,
    *,
    states: int = 20,
    seed: int = 0,
    mjx: bool | tuple[str, ...] = True,
    seconds: float = 1.0,
    gradient: bool = True,
    driver: str = "auto",
    floating_base: bool = False,
    contacts: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Report:
    """Compare a robot in rbjax, MuJoCo C and MJX side by side.

    The comparison covers body poses and velocities, mass matrix, bias forces, forward dynamics with
    the model's own springs, dampers and actuators, one semi-implicit Euler step, and the final
    state of a trajectory. It also covers the gradient of a random functional of this state by
    initial velocity and controls (reverse mode against central differences of MuJoCo C).

    With contacts the states are those of a motion of MuJoCo. The comparison covers the number of
    contacts and the forces of each pair of geoms, the generalized forces of all constraints, the
    acceleration, and one step by the integrator of the file. It has no MJX and no gradients.

    Args:
        source: as for `rbjax.load`.
        states: the number of random states.
        seed: of the random states.
        mjx: whether MJX runs too, or a tuple of its precisions, such as ("f64",).
        seconds: the length of the trajectory.
        gradient: whether to compare gradients, which are most of a large robot's compile time.
        driver: the driver of rbjax; "rolled" compiles faster than "unrolled".
        floating_base: as in `rbjax.load`.
        contacts: compare contacts, limits, friction loss and equalities, as
            `rbjax.load(contacts=True)` takes them.
        progress: called with the name of each stage before it starts.

    Returns:
        `Report`: `.table()`, `.to_dict()`, `.success`, `.switched_off`.

    Raises:
        ModelError: the source cannot be read.
        InputError: `states` is below 1, or the robot has no joints.

    The caller's precision is not changed: f64 runs inside `jax.enable_x64`.

    Example:
        >>> import rbjax as rb
        >>> rb.validation.compare("pendulum", states=3, mjx=False, seconds=0.02).success
        True
    """
    integer("compare", "states", states, least=1)
    integer("compare", "seed", seed, least=0)
    real_number("compare", "seconds", seconds, above=0.0)
    flag("compare", "gradient", gradient)
    flag("compare", "floating_base", floating_base)
    if not isinstance(mjx, bool) and not isinstance(mjx, tuple | list):
        raise InputError(
            f"compare: mjx is {shown(mjx)}, expected True, False or precisions, such as ('f64',)"
        )
    say = progress or (lambda stage: None)
    say("MuJoCo C")
    if flag("compare", "contacts", contacts):
        return _with_contacts(source, states, seed, seconds, driver, floating_base, say)
    compiled = compile_model(source, floating_base=floating_base)
    reference, off = smooth(compiled)
    if not reference.nv:
        raise InputError("compare: the model has no joints, so there is nothing to compare")
    dt = float(reference.opt.timestep)
    steps = max(1, round(seconds / dt))
    samples = random_samples(reference, states, seed)
    few = samples[:GRADIENTS]
    weights = np.random.default_rng(seed + 1).normal(size=reference.nq + reference.nv)
    weights = weights.astype(np.float32).astype(np.float64)
    want = quantities(reference, samples)
    want["trajectory"], growth = _final_states(reference, few, steps)
    doubt = 0.0
    if gradient:
        want["gradient"] = final_gradient(reference, few, steps, weights)
        rough = final_gradient(reference, few, steps, weights, step=3e-5)
        doubt = relative(rough, want["gradient"]).worst

    slope = weights if gradient else None
    found: dict[str, dict[str, Array]] = {}
    for column, dtype in (("rbjax f64", np.float64), ("rbjax f32", np.float32)):
        say(column)
        with jax.enable_x64(True):
            model = from_compiled(reference, off).replace(driver=driver)
            found[column] = ours.quantities(model, samples, dtype)
            found[column] |= ours.motion(model, few, dt, steps, slope, dtype)
    notes = [
        f"Trajectory: {steps} steps of {dt:g} s. MuJoCo amplifies a change of the initial velocity "
        f"{growth:.0e} times"
        + (f", and its finite differences are accurate to {doubt:.0e}." if gradient else ".")
    ]
    for precision in ("f64", "f32") if mjx is True else mjx or ():
        say(f"MJX {precision}")
        try:
            with jax.enable_x64(precision == "f64"):
                engine = Mjx(reference)
                found[f"MJX {precision}"] = engine.quantities(samples)
                found[f"MJX {precision}"] |= engine.motion(few, steps, slope)
        except NotImplementedError as error:
            notes.append(f"MJX refuses this model: {error}")
            break
    rows = _rows(want, found, _tolerances(growth, doubt))
    return Report(describe(source), states, steps * dt, rows, off, tuple(notes))


def _with_contacts(
    source: Any, states: int, seed: int, seconds: float, driver: str, floating_base: bool,
    say: Callable[[str], None],
) -> Report:  # fmt: skip
    """Compare the contacts of a file."""
    with jax.enable_x64(True):
        reference, model, off = contacts_of.with_contacts(source, floating_base=floating_base)
        if not reference.nv:
            raise InputError("compare: the model has no joints, so there is nothing to compare")
        model = model.replace(driver=driver)
        pairs = () if model.geoms is None else model.geoms.pairs
        samples = contacts_of.states_of_motion(reference, states, seed, seconds)
        want = contacts_of.reference_quantities(reference, pairs, samples)
        found, reports = {}, []
        for column, dtype in (("rbjax f64", np.float64), ("rbjax f32", np.float32)):
            say(column)
            found[column], report = contacts_of.quantities(model, pairs, samples, dtype)
            reports.append(report)
    touching = int((want["contacts"].sum(-1) > 0).sum())
    most = int(want["contacts"].sum(-1).max(initial=0))
    if pairs and not touching:
        warnings.warn(
            f"compare: none of the {states} states of a motion of {seconds:g} s has a contact, so "
            "no contact is compared; give a larger seconds=",
            stacklevel=3,
        )
    note = (
        f"States of a motion of {seconds:g} s: {touching} of {states} have contacts, {most} at "
        f"most. Errors are relative to the largest entry of a state, or to {contacts_of.FLOOR:g} "
        f"in SI units. The solver takes {'; '.join(reports)}."
    )
    tolerances = {"": contacts_of.TOLERANCES, "contacts": {"rbjax f64": 0.0}}
    rows = _rows(want, found, tolerances, contacts_of.FLOOR)
    return Report(describe(source), states, seconds, rows, off, (note,))


def describe(source: Any) -> str:
    """Return the name of a robot for titles: the name of its file, or "model"."""
    text = str(source) if isinstance(source, (str, Path)) else "<"
    return "model" if text.lstrip().startswith("<") else Path(text).name


def _final_states(m: mujoco.MjModel, samples: StateSamples, steps: int) -> tuple[Array, float]:
    """Compute MuJoCo's final states (N, nq + nv), and their amplification of a velocity change."""
    small = 1e-6
    out, growth = [], 1.0
    for q, v, ctrl in zip(samples.q, samples.v, samples.ctrl, strict=True):
        last, moved = (
            np.concatenate([x[-1] for x in trajectory(m, q, start, ctrl, steps)])
            for start in (v, v + small)
        )
        out.append(last)
        growth = max(growth, float(np.abs(moved - last).max() / small))
    return np.stack(out), growth


def _tolerances(growth: float, doubt: float) -> dict[str, dict[str, float]]:
    """Return the largest allowed errors of rbjax: quantity -> engine and dtype -> error.

    The key "" holds for all other quantities. growth: growth of rounding errors along the
    trajectory. doubt: error of the reference gradient.
    """
    path = {column: UNITS * growth * unit for column, unit in EPSILON.items()}
    path = {column: tolerance for column, tolerance in path.items() if tolerance < 1}
    gradient = {"rbjax f64": max(DIFFERENCES, 10 * doubt, path.get("rbjax f64", 1.0))}
    return {"": ALGORITHM, "trajectory": path, "gradient": gradient}


def _rows(
    want: dict, found: dict, tolerances: dict[str, dict[str, float]], floor: float = 1e-3
) -> tuple[ReportRow, ...]:
    rows = []
    for quantity, expected in want.items():
        errors = {
            column: relative(values[quantity], expected[: len(values[quantity])], floor)
            for column, values in found.items()
        }
        rows.append(ReportRow(quantity, errors, tolerances.get(quantity, tolerances[""])))
    return tuple(rows)
