"""Identification of an arm's payload and a joint's damping from only noisy joint angles.

MuJoCo simulates the "measurement" of an arm whose numbers differ from the file; rbjax does not know
them.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from rbjax.demo.report import Section
from rbjax.loading import load
from rbjax.model import Model
from rbjax.motion.rollout import rollout
from rbjax.plotting import BLUE, GRID, INK, ORANGE, STYLE
from rbjax.sysid import Fit, Unknown, fit
from rbjax.validation.reference import Array, smooth, trajectory

NOISE = 1e-3  # rad
EVERY = 10  # steps of 2 ms between two measurements

#: name -> (place in the model, unit, true number minus that of the file)
TRUTH = {
    "payload mass": (Unknown("bodies.mass", 7, positive=True), "kg", 0.8),
    "payload centre of mass x": (Unknown("bodies.com", (7, 0)), "m", -0.06),
    "payload centre of mass y": (Unknown("bodies.com", (7, 1)), "m", 0.03),
    "payload centre of mass z": (Unknown("bodies.com", (7, 2)), "m", 0.015),
    "damping of joint 4": (Unknown("joints.damping", 3, positive=True), "N m s/rad", 3.0),
}

_CODE = """\
unknowns = {
    "payload mass": Unknown("bodies.mass", 7, positive=True),
    "payload centre of mass x": Unknown("bodies.com", (7, 0)),
    "damping of joint 4": Unknown("joints.damping", 3, positive=True), ...
}
found = rb.sysid.fit(model, start, ctrls, measured, unknowns)"""


def measure(model: Model, steps: int) -> tuple[Array, Array, Array]:
    """Controls (steps, nu), and MuJoCo's angles (1 + steps / EVERY, nq) with noise and without."""
    reference, _ = smooth("arm7")
    body = reference.body("link7").id
    reference.body_mass[body] += TRUTH["payload mass"][2]
    reference.body_ipos[body] += [TRUTH[f"payload centre of mass {k}"][2] for k in "xyz"]
    reference.dof_damping[3] += TRUTH["damping of joint 4"][2]
    home = np.asarray(model.keyframes.ctrl[0])
    t = np.arange(steps)[:, None] * model.timestep
    swing = np.array([0.6, 0.35, 0.6, 0.5, 0.9, 0.8, 1.0])
    rate = np.array([0.7, 0.9, 1.1, 1.3, 1.6, 1.9, 2.3])
    ctrls = home + swing * np.sin(2 * np.pi * rate * t)
    state = model.keyframe("home")
    q, _ = trajectory(reference, np.asarray(state.q), np.asarray(state.v), ctrls, steps)
    clean = q[::EVERY]
    return ctrls, clean, clean + NOISE * np.random.default_rng(0).normal(size=clean.shape)


def identify(folder: Path, say: Callable[[str], None], *, steps: int = 1000) -> Section:
    """Measure, fit, draw."""
    say("identification: MuJoCo measures, Levenberg-Marquardt compiles")
    model = load("arm7").replace(driver="rolled")
    assert model.body("link7") == 7
    ctrls, _, measured = measure(model, steps)
    start = model.keyframe("home")
    unknowns = {name: u for name, (u, _, _) in TRUTH.items()}
    found = fit(model, start, jnp.asarray(ctrls), jnp.asarray(measured), unknowns, save_every=EVERY)
    rows, truth = [], {}
    for name, (u, unit, added) in TRUTH.items():
        value: Any = model
        for part in u.leaf.split("."):
            value = getattr(value, part)
        guess = float(np.asarray(value)[u.index])
        truth[name] = guess + added
        rows.append(
            (
                name,
                f"{guess:.4f}",
                f"{found.values[name]:.4f} ± {found.errors[name]:.4f}",
                f"{truth[name]:.4f}",
                unit,
            )
        )
    before = rollout(model, start, jnp.asarray(ctrls), save_every=EVERY)
    after = rollout(found.model, start, jnp.asarray(ctrls), save_every=EVERY)
    ts, path = np.asarray(before.ts), folder / "identify.png"
    _picture(path, ts, measured, before.q, after.q, found, truth)
    text = (
        f"A seven-joint arm has an unknown payload. From {len(measured)} readings of its joint "
        f"angles over {steps * model.timestep:.0f} s, with noise of {NOISE * 1e3:.0f} mrad, one "
        "fit finds five numbers: the mass and the centre of mass of the payload, and the damping "
        "of a joint, which is larger than in the file. Model numbers are leaves of a pytree, so "
        "the rollout can be differentiated with respect to any of them.",
        f"Levenberg-Marquardt took {found.steps} steps. The remaining residual, "
        f"{found.rms * 1e3:.2f} mrad, is the noise.",
    )
    return Section(
        "Identify a robot: mass, centre of mass and damping at once",
        text,
        (("identify.png", "Left: residuals of the file's model and after the fit. "
          "Right: estimates minus truth, in standard errors."),),
        ("number", "file", "estimate", "truth", "unit"),
        tuple(rows),
        note="± is one standard error of the linearised problem. The measurement was simulated by "
        "MuJoCo C with the numbers under 'truth'.",
        code=_CODE,
    )  # fmt: skip


def _picture(
    path: Path, ts: Array, measured: Array, before: Any, after: Any, found: Fit, truth: dict
) -> None:
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(
            2, 2, figsize=(11, 5.4), width_ratios=(1.5, 1), layout="constrained", sharex="col"
        )
        for ax, joint in ((axes[0, 0], 3), (axes[1, 0], 5)):
            ax.plot(ts, 1e3 * (measured - before)[:, joint], ".", ms=4, color=ORANGE, label="file")
            ax.plot(ts, 1e3 * (measured - after)[:, joint], ".", ms=4, color=BLUE, label="fitted")
            ax.set(ylabel="residual [mrad]", title=f"Joint {joint + 1}: measured minus modelled")
        axes[0, 0].legend(loc="upper right", ncols=2)
        axes[1, 0].set(xlabel="time [s]")
        ax = figure.add_subplot(axes[0, 1].get_gridspec()[:, 1])
        for old in axes[:, 1]:
            old.remove()
        names = list(found.values)
        away = [(found.values[n] - truth[n]) / found.errors[n] for n in names]
        at = -np.arange(len(names))
        ax.axvspan(-2, 2, color=GRID, alpha=0.5, lw=0)
        ax.axvline(0, color=INK, lw=1)
        ax.errorbar(away, at, xerr=1, fmt="o", color=BLUE, capsize=3, lw=1.6)
        labels = [n.replace("payload ", "payload\n").replace("damping", "damping\n") for n in names]
        ax.set_yticks(at, labels)
        ax.set(xlim=(-4, 4), xlabel="(estimate - truth) / standard error", title="How far off")
        ax.grid(axis="y", visible=False)
        figure.savefig(path)
        plt.close(figure)
