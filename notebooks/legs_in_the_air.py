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
# # A quadruped's legs in the air
#
# A Unitree Go2 hangs by its trunk and swings its legs for 23 s, faster and faster. Twelve angles
# and the commands were recorded at 200 Hz, and nothing else. What do they say of the robot? The
# usual model has armature, friction and an offset for each joint, and a delay: 49 numbers. It ends
# on the bounds of what is possible, so it lacks something. Here is how to see what.
#
# The recording is of the *sim2real-robot-identification* project of the DLS lab of IIT (BSD-3).
# It is in `../shared/data`, outside the repository. Without it this notebook only says so.

# %%
import warnings
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import mujoco
import numpy as np

import rbjax as rb
from rbjax.plotting import STYLE
from rbjax.sysid import Channel, Grid, Recording, Setup, Shared, Unknown, identify
from rbjax.sysid.data import low_pass

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(STYLE)

HERE = globals().get("__file__", "notebooks/legs_in_the_air.py")
PLACES = [p / "shared/data/go2_in_air" for p in Path(HERE).resolve().parents]
DATA = next((p for p in PLACES if p.exists()), None)
if DATA is None:
    print("The recording shared/data/go2_in_air is not there: nothing is computed.")

# %% [markdown]
# ## The robot and its recording
#
# Each joint's controller pulls towards the last command with 20 N m/rad and damps with 1.5 N m s.
# The first half of the recording is fitted. The second half, with the fast motions, is held out: a
# model starts at its first sample, and runs free under the recorded commands.

# %%
RATE, HALF, KP, KD = 200, 2349, 20.0, 1.5


def robot():
    """With a position servo on each joint."""
    spec = mujoco.MjSpec.from_file(str(DATA / "go2_in_air.xml"))
    for actuator in spec.actuators:
        actuator.set_to_position(kp=KP, kv=KD)
    with warnings.catch_warnings(action="ignore"):  # joint limits, which are far away
        model = rb.load(spec.compile())
    ones = np.ones(12)
    return model.replace(joints=model.joints.replace(armature=0.01 * ones, damping=0.1 * ones))


def piece(name, first, last):
    data = np.load(DATA / "traj_0.npz")
    t = np.arange(first, last) / RATE
    q, asked = (np.array(data[k], float)[first:last] for k in ("position_rad", "command_rad"))
    noise = np.full(12, 1e-3)
    return Recording(name, {"q": Channel(t, q, noise=noise), "ctrl": Channel(t, asked)})


def mrad(residuals):
    return 1e3 * float(np.sqrt(np.mean(residuals**2)))


if DATA is not None:
    model = robot()
    names = model.joint_names
    first_half, second_half = piece("slow", 0, HALF), piece("fast", HALF, 4698)

# %% [markdown]
# ## Forty-nine numbers
#
# Armature, viscous and Coulomb friction and the bias of the angle for each joint, and a delay of
# the commands. The controller reads the biased angle too, so that a bias is also a torque.

# %%
if DATA is not None:
    dry = rb.forces.JointFriction.of(model, names, 0.3, smoothing=0.03)
    setup = Setup.of(model.with_forces(dry), delay=0.005)
    bias = [Unknown("sensors.q.bias", bounds=(-0.1, 0.1)), Unknown("actuators.bias", (..., 0))]
    usual = identify(
        setup,
        first_half,
        {
            "armature": Unknown("joints.armature", bounds=(1e-5, 1.0)),
            "viscous": Unknown("joints.damping", bounds=(0.0, 7.0)),
            "coulomb": Unknown("forces.0.coulomb", bounds=(0.0, 2.0)),
            "bias": Shared(tuple(bias), (1.0, -KP)),
            "delay": Unknown("delay", bounds=(0.0, 0.02)),
        },
        grid=Grid(1 / RATE, 2, "rk4", 4),
        estimate_initial_state=False,
        max_evaluations=12,
        restarts=0,
    )
    print(f"error of the fit {mrad(usual.traces['slow']['q'].residual):.1f} mrad")
    print(usual.validate([second_half]).summary())
    for kind in ("armature", "viscous", "bias", "delay"):
        print(kind, np.round([x for n, x in usual.values.items() if n.startswith(kind)], 3))

# %% [markdown]
# Biases of 0.1 rad, no delay, calves with little viscous friction: the model bends what it has
# towards something that it does not have.
#
# ## What is missing
#
# The commands and the angles give the torque of each servo. This torque less gravity, inertia and
# the servo's own damping is friction. The plot over the angle shows it: it opposes the motion in
# both directions, by an amount that depends on the angle. In the calf of the rear left leg, whose
# motor drives it through a linkage, it doubles as the knee closes. The other joints have ripples of
# 0.1 to 0.3 N m. Every swing repeats them at the same angles.

# %%
if DATA is not None:
    t, q = first_half["q"].t, first_half["q"].values
    asked = first_half["ctrl"].values
    smooth, v, a = (
        low_pass(t, q, 8.0, derivative=k).values
        for k in range(3)
    )
    inertial = jax.jit(jax.vmap(lambda q, v, a: rb.inverse_dynamics(model, q, v, a)))
    rest = KP * (low_pass(t, asked, 8.0).values - smooth) - KD * v - inertial(smooth, v, a)
    figure, axes = plt.subplots(2, 3, figsize=(12, 6), constrained_layout=True)
    shown = ["FL_calf_joint", "RL_calf_joint", "RR_calf_joint", "FR_hip_joint", "RL_thigh_joint"]
    for ax, name in zip(axes.flat, [*shown, "FR_calf_joint"], strict=True):
        j = list(names).index(name)
        ax.plot(smooth[20:-20, j], rest[20:-20, j], lw=0.8)
        ax.set(title=name, xlabel="angle [rad]", ylabel="friction [N m]")
    plt.show()

# %% [markdown]
# ## A model with curves
#
# `JointCurves` has a torque c and a dry friction F for each joint, both Chebyshev series in the
# angle. Constant terms are the offset and Coulomb's friction of the model above; the others are new
# here. Hips, thighs and calves of the four legs have the same motors, so armature and viscous
# friction are shared: what friction does at other speeds must not be learned from one leg's curve.
# The lengths of the series were chosen on the last third of the first half, by fits of its first
# two thirds (`benchmarks/cpu/legs_in_the_air.py`). A delay was tried, too: it came out as 0.4 ms.

# %%
if DATA is not None:
    ends = np.stack([q.min(0) - 0.005, q.max(0) + 0.005], 1)
    series = np.zeros((12, 8))
    series[:, 0] = 0.3
    curves = rb.forces.JointCurves.of(
        model, names, ends, torque=np.zeros((12, 12)), coulomb=series, smoothing=0.03
    )

    def alike(leaf):
        members = (Unknown(leaf, slice(k, k + 3), positive=True) for k in (0, 3, 6, 9))
        return Shared(tuple(members))

    found = identify(
        model.with_forces(curves),
        first_half,
        {
            "armature": alike("joints.armature"),
            "viscous": alike("joints.damping"),
            "torque": Unknown("forces.0.torque"),
            "coulomb": Unknown("forces.0.coulomb"),
        },
        grid=Grid(1 / RATE, 2),
        estimate_initial_state=False,
        max_evaluations=14,
        restarts=0,
    )
    print(f"error of the fit {mrad(found.traces['slow']['q'].residual):.2f} mrad")
    print(found.status.text)
    verdict = found.validate([second_half])
    print(f"held out {1e3 * verdict.rms:.1f} mrad; {verdict.summary()}")
    for kind in ("armature", "viscous"):
        print(kind, "of hip, thigh, calf", [
            round(x, 4) for n, x in found.values.items() if n.startswith(kind)
        ])  # fmt: skip

# %% [markdown]
# Error of the free run over the second half, joint by joint, and over time for the worst joint of
# the usual model.

# %%
if DATA is not None:
    runs = {"49 numbers": usual, "with curves": found}
    tested = {name: fit.simulated([second_half])["fast"]["q"] for name, fit in runs.items()}
    each = {name: 1e3 * np.sqrt(np.mean(x.residual**2, 0)) for name, x in tested.items()}
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4), constrained_layout=True)
    for k, (name, error) in enumerate(each.items()):
        left.bar(np.arange(12) + 0.4 * k - 0.2, error, 0.4, label=name)
    left.set_xticks(range(12), [n.removesuffix("_joint") for n in names], rotation=60)
    left.set(ylabel="error [mrad RMS]", title="held-out half, free run")
    left.legend()
    worst = int(each["49 numbers"].argmax())
    for name, x in tested.items():
        right.plot(x.t, 1e3 * x.residual[:, worst], lw=0.9, label=name)
    right.set(xlabel="time [s]", ylabel="error [mrad]", title=names[worst])
    right.legend()
    plt.show()
    print({name: round(mrad(x.residual), 2) for name, x in tested.items()}, "mrad RMS")

# %% [markdown]
# The error that is left grows with the speed, and is largest in the calves at the end: the slow
# half shows friction at 1 rad/s, the fast half reaches 4 rad/s. The verdict above says so: the
# error is several times the error of the fit. A recording for a fit needs fast motions, too.
#
# The curves that were found: what rubs in the four calves, at each angle.

# %%
if DATA is not None:
    fitted = np.asarray(found.model.forces[0].coulomb)
    figure, ax = plt.subplots(figsize=(7, 3.6), constrained_layout=True)
    x = np.linspace(-1, 1, 200)
    for j in (2, 5, 8, 11):
        angle = ends[j].mean() + x * np.ptp(ends[j]) / 2
        ax.plot(angle, np.polynomial.chebyshev.chebval(x, fitted[j]), label=names[j])
    ax.set(xlabel="angle of the calf [rad]", ylabel="dry friction [N m]")
    ax.legend()
    plt.show()
