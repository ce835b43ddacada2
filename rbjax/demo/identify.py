"""Identification of an arm's payload and a joint's damping from noisy joint angles.

MuJoCo simulates the measurement of an arm whose parameters differ from the file. rbjax estimates
them.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from rbjax.demo.report import ReportSection
from rbjax.loading import load
from rbjax.model import Model
from rbjax.plotting import BLUE, GRID, INK, ORANGE, STYLE
from rbjax.sysid import Channel, Grid, Identified, Recording, Unknown, free_run, report
from rbjax.sysid import identify as identified
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
run = Recording("swing", {"q": Channel(t, measured), "ctrl": Channel(t_ctrl, ctrls)})
unknowns = {
    "payload mass": Unknown("bodies.mass", 7, positive=True),
    "payload centre of mass x": Unknown("bodies.com", (7, 0)),
    "damping of joint 4": Unknown("joints.damping", 3, positive=True), ...
}
found = rb.sysid.identify(model, run, unknowns)   # with the state at the start
rb.sysid.report(found, "identification.html")"""


def measure(model: Model, steps: int) -> tuple[Array, Array, Array]:
    """Simulate a measurement by MuJoCo. Return controls (steps, nu), and joint angles (1 + steps /
    EVERY, nq) without and with noise."""
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


def identify(folder: Path, say: Callable[[str], None], *, steps: int = 1000) -> ReportSection:
    """Run the identification: measure, fit and draw. Return the section of the report."""
    say("identification: MuJoCo measures, Gauss-Newton compiles")
    model = load("arm7").replace(driver="rolled")
    assert model.body("link7") == 7
    ctrls, _, measured = measure(model, steps)
    clock = np.arange(steps + 1) * model.timestep
    run = Recording(
        "swing", {"q": Channel(clock[::EVERY], measured), "ctrl": Channel(clock[:-1], ctrls)}
    )
    grid = Grid(model.timestep, integrator="semi_implicit_euler")  # MuJoCo's own step
    unknowns = {name: u for name, (u, _, _) in TRUTH.items()}
    found = identified(model, run, unknowns, grid=grid)
    report(found, folder / "identification.html", title="Identification of an arm's payload")
    truth = {name: found.guess[name] + added for name, (_, _, added) in TRUTH.items()}
    rows = []
    for name, (_, unit, _) in TRUTH.items():
        of = found.estimates.interval(name)
        said = f"{of.value:.4f} ({of.low:.4f} to {of.high:.4f})"
        rows.append((name, f"{found.guess[name]:.4f}", said, f"{truth[name]:.4f}", unit))
    before = free_run(model, [run], grid=found.grid)["swing"]["q"].residual
    after = found.traces["swing"]["q"].residual
    _picture(folder / "identify.png", clock[::EVERY], before, after, found, truth)
    rms = 1e3 * float(np.sqrt(np.mean(np.square(after))))
    text = (
        f"A seven-joint arm has an unknown payload. From {len(measured)} readings of its joint "
        f"angles over {clock[-1]:.0f} s, with noise of {NOISE * 1e3:.0f} mrad, one fit finds five "
        "parameters: the mass and the centre of mass of the payload, and the damping of a joint, "
        "which is larger than in the file. The first reading is noisy, too, so the fit also "
        "estimates the initial state.",
        f"The fit evaluated the simulation with its exact derivatives {found.evaluations} times. "
        f"The RMS residual of {rms:.2f} mrad is the noise. {found.identifiable.summary()}",
    )
    return ReportSection(
        "Identify a robot: mass, centre of mass and damping at once",
        text,
        (("identify.png", "Left: simulated minus measured, with the file's values and after the "
          "fit. Right: estimates minus truth, in standard errors."),),
        ("parameter", "file", "estimate (95 % interval)", "truth", "unit"),
        tuple(rows),
        note="The measurement was simulated by MuJoCo C with the values under 'truth'.",
        links=(("identification.html", "The report of the fit"),),
        code=_CODE,
    )  # fmt: skip


def _picture(
    path: Path, ts: Array, before: Array, after: Array, found: Identified, truth: dict[str, float]
) -> None:
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(
            2, 2, figsize=(11, 5.4), width_ratios=(1.5, 1), layout="constrained", sharex="col"
        )
        for ax, joint in ((axes[0, 0], 3), (axes[1, 0], 5)):
            ax.plot(ts, 1e3 * before[:, joint], ".", ms=4, color=ORANGE, label="file")
            ax.plot(ts, 1e3 * after[:, joint], ".", ms=4, color=BLUE, label="fitted")
            ax.set(ylabel="residual [mrad]", title=f"Joint {joint + 1}: simulated minus measured")
        axes[0, 0].legend(loc="upper right", ncols=2)
        axes[1, 0].set(xlabel="time [s]")
        ax = figure.add_subplot(axes[0, 1].get_gridspec()[:, 1])
        for old in axes[:, 1]:
            old.remove()
        names = list(found.values)
        sigma = {n: found.estimates.interval(n).sigma for n in names}
        away = [(found.values[n] - truth[n]) / sigma[n] for n in names]
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
