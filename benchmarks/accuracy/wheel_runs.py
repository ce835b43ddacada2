"""Motions of wheeled robots in rbjax, MuJoCo C and MJX, for `wheel_contact`. No benchmark itself.

A motion lasts SECONDS. Torques begin and end at zero; steerings turn at a constant rate, so that
their inertia, which our equations leave out, has nothing to do. Controls of fixed steps are those
in the middle of a step. MuJoCo starts where its wheels, standing, have sunk in.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from mujoco import mjx

import rbjax as rb
from rbjax import wheeled
from rbjax.compiling import WITHOUT_EMITTERS, xla_accepts
from rbjax.wheeled.models.robot_model import with_twist

SECONDS, SAVED = 4.0, 40
STEERED = 0.12  # rad, to each side, of steerings that turn from one to the other
STEERING_TIME = 1e-3
HEAVY = 1e3  # times the inertia of a steering's column and its servo: what wheels do to it, no less


@dataclass(frozen=True)
class Manoeuvre:
    """A robot and what it does: its speed ahead, and controls(t, np or jnp) -> (..., nu)."""

    title: str
    robot: wheeled.Robot
    speed: float
    controls: Callable[[Any, Any], Any]
    steered: float = field(default=0.0)

    def start(self, vehicle: Any) -> rb.State:
        s, l = wheeled.start(vehicle), self.robot.layout
        q = s.q.at[l.steerings.start : l.steerings.stop].set(-self.steered)
        return with_twist(vehicle, q, jnp.array([self.speed, 0.0, 0.0]))


def _turns(t: Any, xp: Any) -> Any:
    push, turn = 0.15 * xp.sin(np.pi * t / SECONDS), 0.05 * xp.sin(2 * np.pi * t / SECONDS)
    return xp.stack([push - turn, push + turn], -1)


def _bends(t: Any, xp: Any) -> Any:
    rate = 2 * STEERED / SECONDS
    return xp.stack([300.0 * xp.sin(np.pi * t / SECONDS), rate + 0.0 * t], -1)


def manoeuvres() -> dict[str, Manoeuvre]:
    """By name of the kind."""
    made = {name: kind.make for name, kind in wheeled.kinds().items()}
    return {
        "differential_drive": Manoeuvre(
            "differential drive", made["differential_drive"](), 0.4, _turns
        ),
        "car": Manoeuvre("car", made["car"](), 3.0, _bends, STEERED),
        "car_trailer": Manoeuvre("car and trailer", made["car_trailer"](), 3.0, _bends, STEERED),
    }


class Run(NamedTuple):
    """Poses (SAVED, 3); the rms sliding speed of contacts, m/s; wall seconds of a second."""

    poses: np.ndarray
    sliding: float
    seconds: float


# ------------------------------------------------------------------------------------ rbjax


def times() -> jax.Array:
    return jnp.linspace(0.0, SECONDS, SAVED + 1)


class Rolling:
    """The fidelity "reduced": the reference, and fixed steps."""

    def __init__(self, of: Manoeuvre):
        self.of = of
        self.vehicle = wheeled.at(of.robot, "reduced")
        self.start = of.start(self.vehicle)
        self.path = self._solved(1e-12)
        self.bound = float(np.abs(self.path.q - self._solved(1e-10).q)[:, :3].max())

    @property
    def poses(self) -> np.ndarray:
        return np.asarray(self.path.q[1:, :3])

    def _solved(self, tolerance: float) -> Any:
        u = self.of.controls
        path = wheeled.simulate(
            self.vehicle, self.start, times(), lambda t, s: u(t, jnp), tolerance=tolerance
        )
        assert path.success
        return path

    def way(self) -> float:
        """Metres that the chassis goes."""
        xy = np.asarray(self.path.q[:, :2])
        return float(np.hypot(*np.diff(xy, axis=0).T).sum())

    def demand(self) -> float:
        """The largest traction that a wheel takes for each newton of its load at rest."""
        held, most = wheeled.at(self.of.robot, "constrained"), 0.0
        for t, q, v in zip(times(), self.path.q, self.path.v, strict=True):
            u = self.of.controls(t, jnp)
            context = self.vehicle.context(rb.State(q, v), u)
            w = jnp.stack([jnp.asarray(x, float) for x in self.vehicle.full_velocities(context)])
            found = wheeled.contacts(held, rb.State(q, w), u)
            most = max(most, float((jnp.linalg.norm(found.forces, axis=1) / found.loads).max()))
        return most

    def steps(self, dt: float, method: str, clocked: int = 3) -> Run:
        count = round(SECONDS / dt)
        u = jnp.asarray(self.of.controls((np.arange(count) + 0.5) * dt, np))
        every = count // SAVED

        @jax.jit
        def run(u: jax.Array) -> jax.Array:
            return wheeled.rollout(
                self.vehicle, self.start, u, dt, integrator=method, save_every=every
            ).q

        q = np.asarray(run(u))
        best = np.inf
        for _ in range(clocked):
            begin = time.perf_counter()
            jax.block_until_ready(run(u))
            best = min(best, time.perf_counter() - begin)
        return Run(q[1:, :3], 0.0, best / SECONDS)


class Slipping:
    """The fidelity "slipping" with Fiala's tyre: one program for all its stiffnesses."""

    def __init__(self, of: Manoeuvre):
        start = of.start(self._with(of, 10.0, 1.0))

        @jax.jit
        def run(stiffness: Any, friction: Any) -> Any:
            vehicle = self._with(of, stiffness, friction)
            path = wheeled.simulate(
                vehicle, start, times(), lambda t, s: of.controls(t, jnp),
                solver=diffrax.Kvaerno5(), tolerance=1e-9, max_steps=20_000,
            )  # fmt: skip

            def sliding(args: Any) -> jax.Array:
                t, q, v = args
                return wheeled.contacts(vehicle, rb.State(q, v), of.controls(t, jnp)).sliding

            slides = jax.lax.map(sliding, (times()[1:], path.q[1:], path.v[1:]))
            return path.q, path.success, slides

        self.run = run

    @staticmethod
    def _with(of: Manoeuvre, stiffness: Any, friction: Any) -> Any:
        return wheeled.at(of.robot, "slipping", tyre=wheeled.Fiala(stiffness, friction))

    def __call__(self, stiffness: float, friction: float) -> Run | None:
        given = jnp.asarray(stiffness), jnp.asarray(friction)
        begin = time.perf_counter()
        q, ok, slides = jax.block_until_ready(self.run(*given))
        seconds = (time.perf_counter() - begin) / SECONDS
        return Run(np.asarray(q[1:, :3]), rms(slides), seconds) if ok else None


def touching_law(rolling: Rolling, law: str, shape: str, width: float, dt: float) -> Run:
    """Wheels of geoms under a contact law of rbjax, as stiff as the step allows."""
    of = rolling.of
    text = wheeled.write_mjcf(
        of.robot, wheel=shape, width=width, timestep=dt, solref=(2 * dt, 1.0),
        solimp=(0.95, 0.95, 0.001), impratio=100.0,
    )  # fmt: skip
    count = round(SECONDS / dt)
    u = jnp.asarray(of.controls((np.arange(count) + 0.5) * dt, np))
    full = wheeled.full_model_state(rolling.vehicle, rolling.start, u[0], "free")
    model, every = rb.load(text), count // SAVED

    def run() -> rb.Trajectory:
        path = rb.rollout(
            model, rb.State(full.q, full.v), u, dt, contact=law, save_every=every
        )  # fmt: skip
        return jax.block_until_ready(path)

    q = np.asarray(run().q)[1:]
    begin = time.perf_counter()
    run()
    return Run(
        np.column_stack([q[:, :2], heading(q)]), 0.0, (time.perf_counter() - begin) / SECONDS
    )


def rms(slides: Any) -> float:
    """Root of the mean of |sliding|^2 over wheels and times, (..., 2)."""
    return float(np.sqrt((np.asarray(slides) ** 2).sum(-1).mean()))


# ----------------------------------------------------------------------------------- MuJoCo


class Touching:
    """A manoeuvre in MuJoCo."""

    def __init__(self, rolling: Rolling):
        self.of = rolling.of
        u = self.of.controls(jnp.asarray(0.0), jnp)
        full = wheeled.full_model_state(rolling.vehicle, rolling.start, u, "free")
        self.q, self.v = np.asarray(full.q), np.asarray(full.v)

    def model(
        self, time_constant: float, dt: float, friction: float = 1.0, **option: Any
    ) -> mujoco.MjModel:
        """The file's model, of which d is 0.95 at all depths."""
        text = wheeled.write_mjcf(
            self.of.robot, timestep=dt, friction=friction, solref=(time_constant, 1.0),
            solimp=(0.95, 0.95, 0.001), steering_range=1.05 * STEERED,
            steering_time=max(STEERING_TIME, 2 * dt), **option,
        )  # fmt: skip
        m = mujoco.MjModel.from_xml_string(text)
        for j in range(m.njnt):
            if m.joint(j).name.startswith(("steering", "knuckle")):
                m.dof_armature[m.jnt_dofadr[j]] *= HEAVY
        for a in range(m.nu):
            if m.actuator(a).name.startswith("steering"):
                m.actuator_gainprm[a] *= HEAVY
                m.actuator_biasprm[a] *= HEAVY
        m.opt.tolerance, m.opt.iterations = 1e-14, 100
        mujoco.mj_setConst(m, mujoco.MjData(m))
        return m

    def __call__(self, m: mujoco.MjModel, clocked: int = 1) -> Run:
        h = m.opt.timestep
        count = round(SECONDS / h)
        u = np.asarray(self.of.controls((np.arange(count) + 0.5) * h, np))
        q0, best = self.settled(m), np.inf
        for _ in range(clocked):
            begin = time.perf_counter()
            q, v = _rolled(m, q0, self.v, u)
            best = min(best, time.perf_counter() - begin)
        every = count // SAVED
        q, v = q[every - 1 :: every], v[every - 1 :: every]
        poses = np.column_stack([q[:, :2], heading(q)])
        slides = np.concatenate([_slides(m, a, b) for a, b in zip(q, v, strict=True)])
        return Run(poses, rms(slides), best / SECONDS)

    def settled(self, m: mujoco.MjModel) -> np.ndarray:
        """Where it stands: as at the start, but with wheels that have sunk in."""
        steps = round(1.0 / m.opt.timestep)
        end = _rolled(m, self.q, np.zeros(m.nv), np.zeros((steps, m.nu)))[0][-1]
        back, out = np.array([1.0, 0, 0, 0]), self.q.copy()
        mujoco.mju_axisAngle2Quat(back, np.array([0.0, 0, 1]), -heading(end[None])[0])
        out[2] = end[2]
        mujoco.mju_mulQuat(out[3:7], back, end[3:7])
        return out


def heading(q: np.ndarray) -> np.ndarray:
    """The direction of the chassis, of its free joint's quaternion."""
    w, x, y, z = q[:, 3:7].T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _rolled(
    m: mujoco.MjModel, q: np.ndarray, v: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    d, kind = mujoco.MjData(m), mujoco.mjtState.mjSTATE_FULLPHYSICS
    d.qpos[:], d.qvel[:] = q, v
    state = np.empty(mujoco.mj_stateSize(m, kind))
    mujoco.mj_getState(m, d, state, kind)
    states = mujoco.rollout.rollout(m, d, state[None], u[None])[0][0]
    return states[:, 1 : 1 + m.nq], states[:, 1 + m.nq : 1 + m.nq + m.nv]


def _slides(m: mujoco.MjModel, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The velocity along the ground, (wheels, 2), of each wheel where it touches."""
    d, twist, out = mujoco.MjData(m), np.zeros(6), []
    d.qpos[:], d.qvel[:] = q, v
    mujoco.mj_forward(m, d)
    for contact in d.contact:
        wheel = max(contact.geom)
        mujoco.mj_objectVelocity(m, d, mujoco.mjtObj.mjOBJ_GEOM, wheel, twist, 0)
        arm = contact.pos - d.geom_xpos[wheel]
        out.append((twist[3:] + np.cross(twist[:3], arm))[:2])
    return np.array(out).reshape(-1, 2)


def mjx_poses(touching: Touching, models: list[mujoco.MjModel]) -> tuple[np.ndarray, dict]:
    """The last qpos (models, nq) in MJX of models that differ in friction, solref and impratio,
    one program for all; and its seconds."""
    first, h = models[0], models[0].opt.timestep
    count = round(SECONDS / h)
    u = jnp.asarray(touching.of.controls((np.arange(count) + 0.5) * h, np))
    common = mjx.put_model(first)
    names = ("geom_friction", "geom_solref", "eq_solref")
    given = {name: jnp.stack([jnp.asarray(getattr(m, name)) for m in models]) for name in names}
    given["impratio"] = jnp.array([m.opt.impratio for m in models])
    given["qpos"] = jnp.stack([jnp.asarray(touching.settled(m)) for m in models])

    def one(x: dict[str, jax.Array]) -> jax.Array:
        model = common.replace(**{name: x[name] for name in names})
        model = model.replace(opt=model.opt.replace(impratio=x["impratio"]))
        data = mjx.make_data(common).replace(qpos=x["qpos"], qvel=jnp.asarray(touching.v))

        def step(d: mjx.Data, u: jax.Array) -> tuple[mjx.Data, None]:
            moved = mjx.step(model, d.replace(ctrl=u))
            # with tendons MJX makes some of its int32 int64
            return jax.tree.map(lambda new, old: new.astype(old.dtype), moved, d), None

        return jax.lax.scan(step, data, u)[0].qpos

    # the fusion emitters of XLA's CPU compiler slow MJX down by a thousand
    options = dict(option for option in [WITHOUT_EMITTERS] if xla_accepts(*option))
    begin = time.perf_counter()
    program = jax.jit(jax.vmap(one)).lower(given).compile(compiler_options=options)
    compiled = time.perf_counter()
    q = np.asarray(program(given))
    ended = time.perf_counter()
    each = (ended - compiled) / len(models) / SECONDS
    return q, {"compile_s": compiled - begin, "seconds": each}
