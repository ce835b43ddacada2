# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A chaotic pendulum, and what slows a real one
#
# A pendulum of three arms is chaotic: a small difference grows until two motions have nothing in
# common. So a simulation from one start cannot be fitted to a long swing unless the first guess is
# nearly right. *Multiple shooting* cuts the swing into pieces with starts of their own, fits them
# all, and ties the end of each piece to the start of the next, ever more stiffly.

# %%
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.io import loadmat

import rbjax as rb
from rbjax.plotting import STYLE
from rbjax.sysid import Channel, Grid, Recording, Setup, Unknown, free_run, identify
from rbjax.sysid.statistics import Scored, compare, whiteness

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE)


def pendulum(mass, centre, length, inertia, viscous, g=9.81):
    """Arms in a plane; angles are relative to the arm before, 0 hanging down."""
    xml = ""
    rows = zip(mass, centre, [0.0, *length], inertia, viscous, strict=True)
    for k, (m, a, above, I, d) in enumerate(rows):
        xml += (
            f'<body name="arm{k + 1}" pos="0 0 {-above}">'
            f'<joint name="joint{k + 1}" axis="0 1 0" damping="{d}"/>'
            f'<inertial pos="0 0 {-a}" mass="{m}" diaginertia="{I} {I} {I}"/>'
        )
    xml += "</body>" * len(mass)
    down = f'<option gravity="0 0 {-g}"/>'
    return rb.load(f"<mujoco>{down}<worldbody>{xml}</worldbody></mujoco>")


# %% [markdown]
# ## Two seconds of chaos
#
# The true pendulum is let go from far up; its angles are read with a noise of 1 mrad. The first
# guess is off by a quarter in the centres of mass and by a factor of 2 to 4 in the friction.

# %%
LINKS = ([0.25, 0.28, 0.12], [0.16, 0.2, 0.18], [0.17, 0.23])
truth = pendulum(*LINKS, [1e-3] * 3, [1e-3] * 3)
guess = pendulum(LINKS[0], [0.12, 0.15, 0.14], LINKS[2], [3e-4, 4e-4, 1e-3], [3e-4, 4e-3, 2e-3])
N, T = 200, 0.01
first = rb.State(jnp.array([2.0, 0.6, -1.0]), jnp.zeros(3))
path = rb.rollout(truth, first, jnp.zeros((N, 0)), T, integrator="rk4")
t, noise = np.arange(N + 1) * T, 1e-3
seen = np.asarray(path.q) + noise * np.random.default_rng(0).normal(size=path.q.shape)
swing = Recording("swing", {"q": Channel(t, seen)})
unknowns = {
    "centre": Unknown("bodies.com", (np.arange(3), 2), scale=0.1),
    "inertia": Unknown("bodies.inertia", ([0, 1], 1, 1), positive=True),
    "viscous": Unknown("joints.damping", positive=True),
}
grid = Grid(T, 2)
found = identify(
    guess, swing, unknowns, multiple_shooting=0.2, estimate_initial_state=True, grid=grid
)
print(found.status.text, "in", found.evaluations, "evaluations; rms [mrad]", 1e3 * found.rms["q"])
for name, value in found.values.items():
    print(f"{name:11s} {value:9.5f} +- {found.estimates.interval(name).sigma:.1e}")

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 3.4), sharey=True)
runs = {
    "first guess, from the first reading": free_run(guess, [swing], grid=grid),
    "found, with its start": found.traces,
}
for ax, (label, run) in zip(axes, runs.items(), strict=True):
    trace = run["swing"]["q"]
    ax.plot(trace.t, trace.recorded, color="0.6", lw=3)
    ax.set_prop_cycle(None)
    ax.plot(trace.t, trace.simulated, lw=1.2, label=["joint 1", "joint 2", "joint 3"])
    ax.set(title=label, xlabel="time [s]", ylim=(-8, 8))
axes[0].set_ylabel("angle [rad] (grey: recorded)")
axes[1].legend()
plt.show()

# %% [markdown]
# ## A real pendulum
#
# Kaheman and others recorded free swings of a pendulum with one, two and three arms, and published
# the parameters that they fitted (arXiv 2205.06231; the files are MIT-licensed). The files are in
# `../shared/data`, outside the repository. Every other stretch for identification is fitted here;
# all the others are left for validation.

# %%
places = [p / "shared" / "data" / "multiarm_pendulum" for p in Path.cwd().resolve().parents]
DATA = next((p for p in places if p.exists()), None)
if DATA is None:
    print("The recordings are not here, so the rest of this notebook shows nothing.")
NAMES = ("single", "double", "triple") if DATA else ()


def published(name):
    p = json.loads((DATA / "estimated_parameters.json").read_text())[name.capitalize()]
    n = ("single", "double", "triple").index(name) + 1
    if n == 1:
        a, m, inertia, viscous, g = p
        return pendulum([m], [a], [], [inertia], [viscous], g)
    m, a, length, inertia, viscous, g = np.split(p, np.cumsum([n, n, n - 1, n, n]))
    return pendulum(m, a, length, inertia, viscous, g[0])


def pieces(name, seconds=1.5, every=4):
    """Fitted and unseen pieces; the files count angles from the vertical, with pi hanging down."""
    files = loadmat(DATA / f"{name.capitalize()}PendulumDataForParameterEstimation.mat")
    fitted, unseen = [], []
    samples = round(1000 * seconds)
    for kind in ("id", "vad"):
        for k, Y in enumerate(files[f"Y_{kind}"].ravel()):
            q = np.diff(np.split(Y, 2)[0] - np.pi, axis=0, prepend=0).T
            for j in range(len(q) // samples):
                part = q[j * samples : (j + 1) * samples + 1 : every]
                seen = Channel(np.arange(len(part)) * 1e-3 * every, part)
                run = Recording(f"{kind} {k}.{j}", {"q": seen})
                ours = kind == "id" and (j if name == "single" else k) % 2 == 0
                (fitted if ours else unseen).append(run)
    return fitted, unseen


GRID = Grid(0.005, 2)
data = {name: pieces(name) for name in NAMES}
for name, (fitted, unseen) in data.items():
    print(f"{name}: {len(fitted)} pieces of 1.5 s to fit, {len(unseen)} to score")

# %% [markdown]
# ## What slows it?
#
# The published model has viscous friction in the joints. Here there may also be Coulomb friction,
# drag of the air on the arms (which sees how fast an arm turns, not its joint), and encoders that
# do not read zero below. A free swing shows only ratios of inertias: masses, and the last arm's
# inertia, are held.


# %%
class Air(rb.forces.Element):
    """A torque -c |w| w on each body, with its angular velocity w in the world."""

    drag: jax.Array  # (nb,) N m s^2/rad^2

    def loads(self, context):
        def turn(body, drag):
            w = body.angular_velocity
            return body.push(jnp.zeros(3), w * (-drag * w.norm(1e-6)))

        return rb.forces.on_each(context, range(context.model.nb), turn, self.drag)


def design(name, terms):
    model = published(name)
    n = model.nv
    if "viscous" not in terms:
        model = model.replace(joints=model.joints.replace(damping=np.zeros(n)))
    dry = rb.forces.JointFriction.of(
        model, model.joint_names, coulomb=1e-4 if "coulomb" in terms else 0.0, smoothing=0.05
    )
    drag = jnp.full(n, 1e-5 if "air" in terms else 0.0)
    setup = Setup.of(model.with_forces(dry, Air(drag)))
    unknowns = {"centre": Unknown("bodies.com", (np.arange(n), 2), scale=0.1)}
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
    return setup, unknowns | {k: possible[k] for k in terms}


def fit(name, *terms):
    setup, unknowns = design(name, terms)
    return identify(setup, data[name][0], unknowns, grid=GRID, estimate_initial_state=True)


def residuals(found):
    return [sensors["q"].residual for sensors in found.traces.values()]


if DATA:
    ladder = [("viscous",), ("viscous", "bias"), ("coulomb", "bias"), ("coulomb", "air", "bias"),
              ("viscous", "coulomb", "air", "bias")]  # fmt: skip
    fits = {" + ".join(terms): fit("single", *terms) for terms in ladder}
    scores = {}
    for label, f in fits.items():
        off = residuals(f)
        scores[label] = Scored(
            label, sum(float((r**2).sum()) for r in off), f.estimates.values.size
        )
        print(f"{label:32s} rms {1e3 * f.rms['q'][0]:.2f} mrad, on unseen pieces "
              f"{1e3 * f.validate(data['single'][1]).rms:.2f}")  # fmt: skip
    effective = sum(whiteness(r[:, 0]).effective_samples for r in off)
    print(f"the residuals are smooth: {effective:.0f} samples' worth")
    names = list(scores)
    for a, b in ((0, 1), (1, 4), (2, 3)):
        print(compare(scores[names[a]], scores[names[b]], effective).summary())
    print(f"viscosity with both: {fits[names[4]].values['viscous[0]']:.1e} N m s/rad")

# %% [markdown]
# Coulomb friction and drag explain the swing. Fitted together with both, the viscosity is almost
# zero and does not reduce the error, so the model does not need it. The published viscosity is the
# best replacement of the two over all amplitudes together.
#
# ## Free runs on pieces that no fit saw
#
# Each model starts where it comes nearest to the piece (least squares over the 1.5 s), so the error
# is what the model gets wrong of the motion.

# %%


def errors(model, runs):
    """By piece, the RMS over samples and arms of the angles from the vertical, mrad."""
    found = free_run(model, runs, grid=GRID, estimate_initial_state=True).values()
    return np.array([1e3 * np.sqrt((np.cumsum(s["q"].residual, -1) ** 2).mean()) for s in found])


scored = {}
for name in NAMES:
    model = (
        fits["coulomb + air + bias"] if name == "single" else fit(name, "coulomb", "air", "bias")
    )
    ours, theirs = (errors(m, data[name][1]) for m in (model.setup, published(name)))
    scored[name] = ours, theirs
    print(f"{name}: median {np.median(ours):.2f} mrad, largest {ours.max():.2f}; published numbers "
          f"{np.median(theirs):.2f} and {theirs.max():.2f}; better on {(ours < theirs).sum()} of "
          f"{len(ours)}")  # fmt: skip

# %%
if DATA:
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), sharey=True)
    for ax, (name, (ours, theirs)) in zip(axes, scored.items(), strict=True):
        ax.plot(theirs, "o", color="0.6", label="published numbers")
        ax.plot(ours, "o", label="found here")
        ax.set(title=name, xlabel="piece, as the swing dies down", ylim=(0, None))
    axes[0].set_ylabel("error of 1.5 s [mrad]")
    axes[0].legend()
    plt.show()
