"""The DFKI double pendulum: its recordings, its published model, a fit, and scores.

Two quasi-direct-drive motors with gears of 6 : 1, in two designs. SOURCE.md beside the recordings
says where they come from. Angles count from the hanging position, the second from the first link.
"""

from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax import sysid
from rbjax.sysid.torque.encoder_zeros import WithZeros
from rbjax.sysid.torque.rows import TorqueRows

DATA = Path(__file__).parents[3] / "shared" / "data" / "dfki_double_pendulum"
#: design -> folder of its recordings, name of the published model, length of the first link
DESIGNS = {
    "A.0": ("design_A.0/20220815/sys_id", "model_2.0", 0.3),
    "C.1": ("design_C.1/sys_id/20230629-*", "model_1.0", 0.2),
}
JOINTS = ("shoulder", "elbow")
TERMS = ("armature", "viscous", "coulomb", "gear_loss")
#: columns that a planar arm shows, whose links are symmetric about their axis
PLANAR = tuple(f"{body}.{x}" for body in ("upper", "lower") for x in ("m", "hz", "Iyy"))
COLUMNS = (*PLANAR, *(f"{joint}.{term}" for term in TERMS for joint in JOINTS))
SMOOTHING = 0.016  # rad/s, that of the published friction
CUTOFF = 4.0  # Hz, of the equations
SIGNALS = 40.0  # Hz, of positions, velocities and accelerations
FIRST = 3.0  # s of a recording that was not fitted, by which its encoders' zeros are found
WINDOWS = 32  # of a free run, at most
DRIVEN = 0.05  # N m, standard deviation of a command that drives its joint

MJCF = """
<mujoco><option gravity="0 0 -9.81" timestep="0.002"/><worldbody>
<body name="upper"><joint name="shoulder" axis="0 -1 0"/>
 <inertial pos="0 0 {r1}" mass="{m1}" diaginertia="{J1} {J1} 1e-4"/>
 <body name="lower" pos="0 0 {l1}"><joint name="elbow" axis="0 -1 0"/>
  <inertial pos="0 0 {r2}" mass="{m2}" diaginertia="{J2} {J2} 1e-4"/></body></body>
</worldbody><actuator><motor name="shoulder" joint="shoulder"/><motor name="elbow" joint="elbow"/>
</actuator></mujoco>
"""


class Published(NamedTuple):
    """A published model: as a `Model`, and its numbers in the order of `parameter_names`."""

    model: rb.Model
    parameters: np.ndarray


def numbers(design: str, name: str) -> dict[str, float]:
    """A published file of parameters, line by line."""
    file = DATA / "identified_parameters" / f"design_{design}" / name / "model_parameters.yml"
    lines = (line.split(":") for line in file.read_text().splitlines() if line)
    return {key: float(value) for key, value in lines}


def published(design: str, name: str | None = None) -> Published:
    """A published model.

    Its mass matrix has (g^2 + 1) Ir, -g Ir and g^2 Ir of the rotors, and its dry friction is
    cf atan(100 v), about (pi/2) cf tanh(v / 0.016).
    """
    x = numbers(design, name or DESIGNS[design][1])
    g, Ir = x["gr"], x["Ir"]
    own = {k: x[f"I{k}"] - x[f"m{k}"] * x[f"r{k}"] ** 2 for k in (1, 2)}
    # the rotor's part of M_12 belongs to the second body, and is taken from the armatures
    own[2] -= g * Ir
    signed = {f"r{k}": -x[f"r{k}"] for k in (1, 2)} | {"l1": -x["l1"]}
    text = MJCF.format(**(x | signed), J1=max(own[1], 1e-4), J2=max(own[2], 1e-4))
    model = rb.load(text, contacts=False)
    armature = jnp.array([(g * g + 1 + g) * Ir, (g * g + g) * Ir])
    joints = model.joints.replace(armature=armature, damping=jnp.array([x["b1"], x["b2"]]))
    dry = np.pi / 2 * np.array([x["cf1"], x["cf2"]])
    friction = rb.forces.JointFriction.of(model, JOINTS, dry, smoothing=np.pi / 200)
    model = model.replace(joints=joints).with_forces(friction)
    values, names = (
        f(model, TERMS) for f in (sysid.torque.parameter_values, sysid.torque.parameter_names)
    )
    values = np.array(values, float)
    for k in (0, 1):  # moments about y; some files hold none that a body can have
        at = 10 * k + 6
        values[at] += own[k + 1] - max(own[k + 1], 1e-4)
    values[[names.index(f"{j}.coulomb") for j in JOINTS]] = dry
    return Published(model, values)


def recordings(design: str) -> list[sysid.Recording]:
    """All runs, with positions, measured torques and commanded torques."""
    folder, _, _ = DESIGNS[design]
    files = sorted(f for place in DATA.glob(folder) for f in place.glob("*.npz"))
    columns = {
        f"{there}{k + 1}": sysid.Column(sensor, joint)
        for sensor, there in (("q", "pos_meas"), ("tau", "tau_meas"), ("ctrl", "tau_con"))
        for k, joint in enumerate(JOINTS)
    }
    name = {f: f.stem if design == "A.0" else f.parent.name for f in files}
    return [sysid.read_recording(f, columns, time="time", name=name[f]) for f in files]


def rows(
    model: rb.Model, runs: Any, cutoff: float = CUTOFF, terms: Any = TERMS, **how: Any
) -> list[TorqueRows]:
    """The equations of each run."""
    how = {"signal_cutoff": SIGNALS, "smoothing": SMOOTHING, **how}
    return [sysid.torque.torque_rows(model, r, cutoff, joint_terms=terms, **how) for r in runs]


def driven(run: sysid.Recording) -> np.ndarray:
    """Whether each motor was commanded to do something."""
    return np.asarray(run["ctrl"].values.std(0) > DRIVEN)


def swings_up(run: sysid.Recording) -> bool:
    """Whether the shoulder comes to the upright position."""
    return bool(np.abs(run["q"].values[:, 0]).max() > 2.8)


class Score(NamedTuple):
    """Squares left and squares there, a joint, over the runs that drive it; R2 by run."""

    left: np.ndarray
    there: np.ndarray
    by_run: dict[str, np.ndarray]

    @property
    def R2(self) -> np.ndarray:
        return 1 - self.left / self.there


def score(
    parameters: np.ndarray, runs: Any, rows: Any, *, noise: Any = 0.05, zeros: bool = True
) -> Score:
    """Torque explained after the first seconds of each run; these give the encoders' zeros."""
    left, there, by_run = np.zeros(2), np.zeros(2), {}
    for run, r in zip(runs, rows, strict=True):
        first, rest = r.segment(end=r.t[0] + FIRST), r.segment(start=r.t[0] + FIRST)
        z = first.encoder_zeros(parameters, noise=noise) if zeros else np.zeros(2)
        off = (rest.residual(parameters, z) ** 2).sum(0)
        all_of_it = ((rest.tau - rest.tau.mean(0)) ** 2).sum(0)
        moved = driven(run)
        by_run[run.name] = np.where(moved, 1 - off / all_of_it, np.nan)
        left, there = left + moved * off, there + moved * all_of_it
    return Score(left, there, by_run)


class Fitted(NamedTuple):
    """A fit: zeros and noise by regression, and a model that bodies can have."""

    linear: WithZeros
    values: np.ndarray
    model: rb.Model


def fit(model: rb.Model, rows: Any) -> Fitted:
    """Regression with zeros, then physically consistent parameters at these zeros."""
    linear = sysid.torque.regress_with_zeros([r.only(COLUMNS) for r in rows])
    W = np.concatenate([r.at(linear.zeros[r.name]) for r in rows])
    tau = np.concatenate([r.tau for r in rows])
    found = sysid.torque.consistent(model, W, tau, joint_terms=TERMS, noise=linear.noise)
    return Fitted(linear, found.values, simulated(found.model, found.values))


def simulated(model: rb.Model, values: np.ndarray) -> rb.Model:
    """The model with its dry friction and the losses of its gears as forces."""
    x = dict(zip(sysid.torque.parameter_names(model, TERMS), values, strict=True))
    dry, lost = ([x[f"{j}.{term}"] for j in JOINTS] for term in ("coulomb", "gear_loss"))
    friction = rb.forces.JointFriction.of(model, JOINTS, jnp.array(dry), smoothing=SMOOTHING)
    gear = rb.forces.GearLoss.of(model, JOINTS, jnp.array(lost), smoothing=SMOOTHING)
    return model.replace(forces=(friction, gear))


def free_run(
    model: rb.Model, run: sysid.Recording, zeros: Any, *, seconds: float = 1.0, every: float = 0.2
) -> np.ndarray:
    """Angles simulated less angles measured (windows, samples, 2), under the measured torques.

    Windows begin after the seconds that gave the zeros, at measured angles and filtered speeds.
    """
    h = 0.002
    t = run.start + h * np.arange(int((run.end - run.start) / h))
    seen = run.on_clock(t)
    q, tau = seen["q"].values, seen["tau"].values
    v = sysid.data.low_pass(t, q, 15.0, derivative=1).values
    q = sysid.data.low_pass(t, q, SIGNALS).values + zeros
    n = int(seconds / h)
    begins = np.arange(int((FIRST + 0.5) / h), len(t) - n - 50, int(every / h))
    count = len(begins)
    padded = np.pad(begins, (0, WINDOWS - count), mode="edge")  # one program for all runs
    ctrl = np.stack([tau[k : k + n] for k in padded])
    start = rb.State(jnp.asarray(q[padded]), jnp.asarray(v[padded]))
    path = rb.rollout(model, start, jnp.asarray(ctrl), h, integrator="rk4", save_every=10)
    samples = np.linspace(0, n, path.q.shape[1]).astype(int)
    want = np.stack([q[k + samples] for k in padded])
    return (np.asarray(path.q) - want)[:count]


def ladder(rows: Any, models: Any, full: WithZeros) -> tuple[list[sysid.statistics.Scored], float]:
    """Sums of squares of nested models (name, columns, spread of zeros), all in the noise of the
    full one, and the effective number of samples of its residuals."""
    rows, scored = list(rows), []
    for name, columns, spread in models:
        few = [r.only(columns) for r in rows]
        found = sysid.torque.regress_with_zeros(few, noise=full.noise, spread=spread)
        count = found.regression.combinations.rank - (2 * len(rows) if spread < 1e-3 else 0)
        scored.append(sysid.statistics.Scored(name, found.squares, count))
    few = [r.only(COLUMNS) for r in rows]
    left = [r.residual(full.parameters, full.zeros[r.name]) for r in few]
    effective = sum(sysid.statistics.whiteness(x).effective_samples for off in left for x in off.T)
    return scored, effective
