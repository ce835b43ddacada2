"""Trees of rigid and flexible links: identities between algorithms, and sums over points of mass.

The trees are random in their placements, numbers and states. They have beams in strain coordinates
and `Modal`, a body of points of mass whose deformation is a sum of modes.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.dynamics.algorithms.energy import momentum_and_rate
from rbjax.joints import Flexible, FrameMotion, LinkInertia
from rbjax.lanes import Mat3, Sym3, Vec3, add, inner, mul, sincos
from rbjax.spatial import Force, Motion, RigidInertia, Transform
from tests.tolerances import F64_TRANSFORM

#: masses, positions and modes of the points of `Modal`: (3 points), (3, 3), (3 points, 2 modes, 3)
MASSES = (0.2, 0.35, 0.15)
PLACES = ((0.2, 0.05, -0.03), (0.5, -0.04, 0.06), (0.9, 0.02, 0.01))
MODES = (
    ((0.1, 0.3, 0.05), (-0.2, 0.1, 0.2)),
    ((0.05, 0.6, -0.1), (0.1, -0.3, 0.25)),
    ((-0.1, 1.0, 0.2), (0.02, 0.15, -0.4)),
)
TURNS = (1.3, -0.7)  # slopes of the modes at the last point, rad per unit, about z
HERE = jnp.array([0.1, -0.2, 0.3])


class Modal(Flexible):
    """Points of mass at f_i + U_i q in the base frame. The body is at the last point."""

    name, coordinates, count = "points_in_two_modes", 2, 3

    def points(self, q):
        """Mass, position and modes of each point."""
        for m, f, U in zip(MASSES, PLACES, MODES, strict=True):
            yield m, Vec3(*f) + along(U, q), [Vec3(*u) for u in U]

    def frames(self, q, v, params):
        base, none = Transform(Mat3.identity(), Vec3.zero()), Motion.zero()
        out = [FrameMotion.at_pose(base, [none, none], none, none)]
        for i, turns in ((1, (0.0, 0.0)), (2, TURNS)):
            c, s = sincos(inner(turns, q))
            R = Mat3(c, mul(-1.0, s), 0.0, s, c, 0.0, 0.0, 0.0, 1.0)
            _, p, U = list(self.points(q))[i]
            axes = [Motion(Vec3(0.0, 0.0, t), R.T @ u) for t, u in zip(turns, U, strict=True)]
            twist = axes[0] * v[0] + axes[1] * v[1]
            out.append(FrameMotion.at_pose(Transform(R, p), axes, twist, none))
        return out

    def inertia(self, q, v, w, params):
        rigid, force = RigidInertia.zero(), Force.zero()
        coupling, mass, forces = [Force.zero()] * 2, [[0.0, 0.0], [0.0, 0.0]], [0.0, 0.0]
        for (m, p, U), modes in zip(self.points(q), MODES, strict=True):
            rigid = rigid + RigidInertia(m, Vec3.zero(), Sym3.zero()).shifted(p)
            coriolis = w.cross(along(modes, v)) * (2.0 * m)
            force = force + Force(p.cross(coriolis), coriolis)
            total = coriolis + w.cross(w.cross(p)) * m
            for j in range(2):
                coupling[j] = coupling[j] + Force(p.cross(U[j]), U[j]) * m
                forces[j] = add(forces[j], U[j].dot(total))
                for k in range(2):
                    mass[j][k] = add(mass[j][k], mul(m, U[j].dot(U[k])))
        return LinkInertia(rigid, tuple(coupling), tuple(map(tuple, mass)), force, tuple(forces))


def along(modes, x):
    """sum_j U_j x_j."""
    out = Vec3.zero()
    for u, y in zip(modes, x, strict=True):
        out = out + Vec3(*u) * y
    return out


PLANAR = rb.flexible.beam(
    0.8, [0, 0, 5.0, 0, 0, 0], {"k_z": 2}, mass=0.6, inertia=[2e-2, 1e-2, 1e-2]
)
SPATIAL = rb.flexible.beam(
    1.2, [3.0, 4.0, 5.0, 0, 0, 0], {"k_x": 1, "k_y": 1, "k_z": 1},
    mass=0.5, inertia=[2e-2, 8e-3, 1.2e-2], natural={"k_y": [0.3], "k_z": [0.2, -0.4]},
)  # fmt: skip
SHEARED = rb.flexible.beam(
    0.7, [3.0, 4.0, 5.0, 50.0, 30.0, 30.0], {"k_z": 1, "e_x": 0, "g_y": 1},
    mass=0.9, inertia=[2e-2, 8e-3, 1.2e-2],
)  # fmt: skip

HUB = """<mujoco><option gravity="0.3 -0.5 -9.81"/>
<default><geom contype="0" conaffinity="0" type="box"/></default>
<worldbody><body name="hub" pos="0.1 0 0.3">{base}
  <geom size="0.1 0.04 0.06" pos="0.05 0.01 0" mass="1.3"/>
  <body name="arm" pos="0 0.2 0.1" euler="0 50 0"><joint name="h" axis="0.6 0 0.8"/>
    <geom size="0.02 0.05 0.03" pos="0.02 0.05 0.01" mass="0.4"/></body>
</body></worldbody></mujoco>"""
BASES = {"hinge": '<joint name="first" axis="0.1 0.2 0.9" pos="0.02 0 0"/>', "free": "<freejoint/>"}


class Grower:
    """Adds links with random placements to a model."""

    def __init__(self, model: rb.Model, seed: int, with_points: bool):
        self.model, self.rng = model, np.random.default_rng(seed)
        self.with_points = with_points
        self.beams: dict[str, rb.flexible.Beam] = {}

    def place(self) -> dict[str, np.ndarray]:
        turn = self.rng.normal(size=4)
        position = 0.2 * self.rng.normal(size=3)
        return {"position": position, "orientation": turn / np.linalg.norm(turn)}

    def beam(self, name: str, parent: str, beam: rb.flexible.Beam, frames=None) -> None:
        """Add a beam, if `with_points` with a frame at each Gauss point."""
        nodes = beam.joint().nodes if self.with_points else []
        points = {f"{name}/{g}": x for g, x in enumerate(nodes)}
        frames = {**points, **(frames or {})}
        self.model = self.model.with_beam(name, beam, parent, frames=frames, **self.place())
        self.beams[name] = beam

    def link(self, name: str, parent: str, joint: rb.joints.Joint, frames=None) -> None:
        self.model = self.model.with_link(name, joint, parent, frames=frames, **self.place())

    def load(self, name: str) -> None:
        """Give a body mass, mass centre and inertia."""
        b, bodies = self.model.body(name), self.model.bodies
        half = 0.2 * self.rng.normal(size=(3, 3))
        bodies = bodies.replace(
            mass=bodies.mass.at[b].set(self.rng.uniform(0.2, 1.0)),
            com=bodies.com.at[b].set(0.1 * self.rng.normal(size=3)),
            inertia=bodies.inertia.at[b].set(half @ half.T + 0.02 * np.eye(3)),
        )
        self.model = dataclasses.replace(self.model, bodies=bodies)


@functools.cache
def tree(name: str, with_points: bool = False) -> tuple[rb.Model, dict[str, rb.flexible.Beam]]:
    """A tree by its name, and its beams with frames at their Gauss points."""
    if name == "alone":  # a beam is the only link
        return rb.load("<mujoco/>").with_beam("rod", PLANAR), {}
    if name == "one":  # one coordinate, and a spatial beam that flies
        slim = rb.flexible.beam(1.0, [0, 0, 5.0, 0, 0, 0], {"k_z": 0}, mass=0.6)
        model = rb.load("<mujoco/>").with_beam("rod", slim)
        return model.with_beam("other", SPATIAL, free=True), {}
    base, seed = name.split()
    grow = Grower(rb.load(HUB.format(base=BASES[base])), int(seed), with_points)
    grow.beam("rod", "arm", SPATIAL, {"middle": 0.4})
    grow.link("elbow", "rod", rb.joints.kind("hinge"))
    grow.load("elbow")
    if base == "free":
        grow.beam("branch", "middle", SHEARED)
        grow.link("body", "hub", Modal(), {"root": 0, "inner": 1})
        grow.link("wrist", "inner", rb.joints.kind("ball"))
        grow.load("wrist")
        grow.load("body")
    else:
        grow.link("body", "elbow", Modal(), {"root": 0, "inner": 1})
        grow.beam("last", "body", PLANAR)
        grow.load("last")
        grow.load("inner")
    return grow.model, grow.beams


TREES = ["alone", "one", "hinge 1", "free 2"]


def moving(name: str, with_points: bool = False):
    """A tree, a state, an acceleration or force, and wrenches on the bodies."""
    model, _ = tree(name, with_points)
    state = model.random_state(jax.random.key(3))
    flexible = np.zeros(model.nq, bool)
    for kind, joint in zip(model.topology.joints, model.joint_names, strict=True):
        if isinstance(kind, Flexible):
            flexible[model.q_slice(joint)] = True
    q = jnp.where(flexible, 0.5 * state.q, state.q)
    a = jax.random.normal(jax.random.key(4), (model.nv,))
    return model, q, state.v, a, jax.random.normal(jax.random.key(5), (model.nb, 6))


@functools.cache
def found(name: str):
    """All algorithms at one state, in one program."""
    model, q, v, a, wrenches = moving(name)
    frames = [rb.Frame(body, point=HERE) for body in model.body_names[-4:]]

    def everything(q, v, a, wrenches):
        def at(h):
            moved = rb.integrate(model, q, h * v)
            poses = [rb.frame_pose(model, moved, f)[1] for f in frames]
            return rb.mass_matrix(model, moved), jnp.stack(poses)

        def energy(h):
            moved, faster = rb.integrate(model, q, h * v), v + h * acceleration
            T = rb.kinetic_energy(model, moved, faster)
            return T + rb.potential_energy(model, moved)

        tau = rb.inverse_dynamics(model, q, v, a, wrenches)
        acceleration = rb.forward_dynamics(model, q, v, a, wrenches)
        _, (M_rate, p_rate) = jax.jvp(at, (0.0,), (1.0,))
        _, power = jax.jvp(energy, (0.0,), (1.0,))
        return {
            "tau": tau,
            "back": rb.forward_dynamics(model, q, v, tau, wrenches),
            "a": acceleration,
            "M": rb.mass_matrix(model, q),
            "inverse": rb.inverse_mass_matrix(model, q),
            "b": rb.bias_forces(model, q, v),
            "g": rb.gravity_forces(model, q),
            "C": rb.coriolis_matrix(model, q, v),
            "T": rb.kinetic_energy(model, q, v),
            "Q": rb.dynamics.generalized_forces(model, q, wrenches),
            "J": jnp.stack([rb.jacobian(model, q, f) for f in frames]),
            "J_rate": jnp.stack([rb.jacobian_rate(model, q, v, f) for f in frames]),
            "twist": jnp.stack([rb.frame_velocity(model, q, v, f) for f in frames]),
            "bias": jnp.stack([rb.frame_bias_acceleration(model, q, v, f) for f in frames]),
            "M_rate": M_rate,
            "p_rate": p_rate,
            "power": power,
        }

    return compiled(everything)(q, v, a, wrenches)


def compiled(f):
    return jax.jit(f, compiler_options=rb.compiler_options())


def close(x, y, tolerance=F64_TRANSFORM, name=""):
    np.testing.assert_allclose(
        x, y, rtol=0, atol=tolerance * max(1.0, np.abs(y).max()), err_msg=name
    )


def test_forward_dynamics_of_a_beam() -> None:
    model, q, v, tau, _ = moving("alone")
    M, b = rb.mass_matrix(model, q), rb.bias_forces(model, q, v)
    close(M @ rb.forward_dynamics(model, q, v, tau), tau - b)
    close(rb.inverse_dynamics(model, q, v, tau), M @ tau + b)


@pytest.mark.slow
@pytest.mark.parametrize("name", TREES)
def test_identities(name: str) -> None:
    """ABA, RNEA, CRBA, momenta, energies and Jacobians belong together."""
    model, _, v, a, _ = moving(name)
    ours = found(name)
    M = ours["M"]
    close(M @ ours["a"], a + ours["Q"] - ours["b"])
    close(ours["tau"], M @ a + ours["b"] - ours["Q"])
    solved = max(F64_TRANSFORM, 1e-16 * np.linalg.cond(M))
    close(ours["back"], a, solved)
    close(M @ ours["inverse"], np.eye(model.nv), solved)
    close(M, M.T)
    assert np.linalg.eigvalsh(M).min() > 0
    close(ours["C"] @ v + ours["g"], ours["b"])
    close(ours["C"] + ours["C"].T, ours["M_rate"])
    close(ours["T"], v @ M @ v / 2)
    close(ours["power"], v @ (a + ours["Q"]))
    close(ours["J"] @ v, ours["twist"])
    close(ours["J_rate"] @ v, ours["bias"])
    close(ours["twist"][:, 3:], ours["p_rate"])


@pytest.mark.slow
def test_momentum_and_its_rate() -> None:
    """p = M v, p' = tau + d(v.M v / 2 - U)/dq, which is M a + M' v."""
    model, q, v, tau, _ = moving("one")
    p, rate = compiled(functools.partial(momentum_and_rate, model))(q, v, tau)
    ours = found("one")
    close(p, ours["M"] @ v)
    close(rate, ours["M"] @ rb.forward_dynamics(model, q, v, tau) + ours["M_rate"] @ v)


def points_of(name: str, poses):
    """Mass, place and inertia about it of the rigid bodies, sections and points of a tree."""
    model, beams = tree(name, True)
    R, p = poses.R, poses.p
    inertia, com = np.asarray(model.bodies.inertia), np.asarray(model.bodies.com)
    for b, m in enumerate(np.asarray(model.bodies.mass)):
        if m > 0:
            yield m, R[b], p[b] + R[b] @ com[b], inertia[b]
    for rod, beam in beams.items():
        for g, w in enumerate(beam.joint().weights):
            b, share = model.body(f"{rod}/{g}"), w * float(beam.length)
            J = share * np.diag(np.asarray(beam.section.inertia))
            yield share * float(beam.section.mass), R[b], p[b], J


def sums(name: str):
    """The mass matrix, the weights and momenta of a tree by sums over points."""
    model, q, v, _, _ = moving(name, True)

    def placed(dv):
        moved = rb.integrate(model, q, dv)
        poses = rb.forward_kinematics(model, moved)
        at = list(points_of(name, poses))
        root, own = model.body("root"), moved[model.q_slice("body")]
        for m, f, U in zip(MASSES, PLACES, MODES, strict=True):
            r = jnp.array(f) + own @ jnp.array(U)
            at.append((m, poses.R[root], poses.p[root] + poses.R[root] @ r, np.zeros((3, 3))))
        return at

    def where(dv):
        at = placed(dv)
        return jnp.stack([R for _, R, _, _ in at]), jnp.stack([p for _, _, p, _ in at])

    zero = jnp.zeros(model.nv)
    (R, p), (R_by, p_by) = compiled(lambda x: (where(x), jax.jacfwd(where)(x)))(zero)
    W = np.einsum("gji,gjkn->gikn", R, R_by)
    spin = np.stack([W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]], 1)
    at = placed(zero)
    mass, J = np.array([x[0] for x in at]), np.array([x[3] for x in at])
    M = np.einsum("g,gin,gim->nm", mass, p_by, p_by) + np.einsum("gin,gij,gjm->nm", spin, J, spin)
    com = mass @ np.asarray(p) / mass.sum()
    rates = p_by @ v
    turning = np.einsum("gij,gjk,gkn,n->i", R, J, spin, v)
    lever = (mass[:, None] * np.cross(p - com, rates)).sum(0) + turning
    weights = -np.einsum("g,gin,i->n", mass, p_by, model.gravity)
    return {"M": M, "g": weights, "com": com, "h": np.r_[lever, mass @ rates]}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hinge 1", "free 2"])
def test_sums_over_points(name: str) -> None:
    """M, weights, mass centre and momenta by derivatives of the positions of points."""
    model, q, v, _, _ = moving(name, True)
    ours = {
        "M": rb.mass_matrix(model, q),
        "g": rb.gravity_forces(model, q),
        "com": rb.center_of_mass(model, q),
        "h": rb.centroidal_momentum(model, q, v),
    }
    for key, want in sums(name).items():
        close(ours[key], want, name=key)


@pytest.mark.slow
def test_lagrange() -> None:
    """b = M' v - d(v.M v / 2)/dq + g, with derivatives of M by the coordinates."""
    model, q, v, _, _ = moving("hinge 1")
    M_by, ours = compiled(jax.jacfwd(functools.partial(rb.mass_matrix, model)))(q), found("hinge 1")
    quadratic = np.einsum("ijk,k,j->i", M_by, v, v) - np.einsum("ijk,i,j->k", M_by, v, v) / 2
    close(ours["b"], quadratic + ours["g"])


def implicit(model, q, v, tau):
    return jnp.linalg.solve(rb.mass_matrix(model, q), tau - rb.bias_forces(model, q, v))


@pytest.mark.slow
def test_derivatives() -> None:
    """Forward and reverse mode by q, v, tau and the parameters, against the dense equations."""
    model, q, v, tau, _ = moving("alone")
    key = jax.random.key(6)

    def by_params(f):
        def g(params, q, v, tau):
            return f(model.replace(joints=model.joints.replace(params=params)), q, v, tau)

        return g

    at = (model.joints.params, q, v, tau)
    along = tuple(jax.random.normal(jax.random.fold_in(key, i), x.shape) for i, x in enumerate(at))
    weights = jax.random.normal(key, v.shape)
    values = []
    for f in map(by_params, (rb.forward_dynamics, implicit)):
        a, slope = compiled(lambda *x, f=f: jax.jvp(f, x, along))(*at)
        back = compiled(lambda *x, f=f: jax.vjp(f, *x)[1](weights))(*at)
        values.append((a, slope, *back))
        pairing = sum(np.vdot(x, y) for x, y in zip(back, along, strict=True))
        np.testing.assert_allclose(pairing, weights @ slope, rtol=1e-9)
    for x, y in zip(*values, strict=True):
        close(x, y, 1e-9)
    M, accelerations = rb.mass_matrix(model, q), rb.forward_dynamics_derivatives(model, q, v, tau)
    close(accelerations.tau @ M, np.eye(model.nv), 1e-11)
    by_q = compiled(jax.jacfwd(lambda q: implicit(model, q, v, tau)))(q)
    close(accelerations.q, by_q, 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["alone", "one"])
def test_batches_and_precision(name: str) -> None:
    """Batches of none, one and three with vmap in jit, and f32 against f64."""
    model, q, v, tau, _ = moving(name)
    one = rb.forward_dynamics(model, q, v, tau)
    for n in (0, 1, 3):
        many = [jnp.tile(x, (n, 1)) for x in (q, v, tau)]
        mapped = compiled(jax.vmap(functools.partial(rb.forward_dynamics, model)))(*many)
        assert mapped.shape == (n, model.nv)
        if n:
            close(mapped, np.tile(one, (n, 1)), 1e-11)
    single = [x.astype(np.float32) for x in (q, v, tau)]
    M, accelerations = rb.mass_matrix(model, single[0]), rb.forward_dynamics(model, *single)
    assert M.dtype == accelerations.dtype == np.float32
    close(M, rb.mass_matrix(model, q), 1e-6)
    close(accelerations, one, 1e-4)
