"""One motion in every formulation, compared with each other and with MuJoCo C."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax import body, spatial
from rbjax.body import (
    Lagrange,
    Momentum,
    NewtonEuler,
    QuasiLagrange,
    Spatial,
    formulations,
    lagrange,
)
from rbjax.errors import InputError
from rbjax.rotations import quaternion, se3, so3
from tests.body.motion import ATTITUDE_FREE, MINIMAL, SLOW, motion
from tests.tolerances import F64_IDENTITY, relative_error

RNG = np.random.default_rng(11)
_off = se3.exp(0.4 * RNG.normal(size=6))  # the centre of mass is not the origin, no axis principal
PROPERTIES = spatial.transform_properties(_off, *spatial.shapes.box([0.3, 0.5, 0.8], mass=2.0))
_half = RNG.normal(size=(6, 6))
ADDED = 0.1 * _half @ _half.T
EVERYTHING = (
    body.UniformGravity(),
    body.CentralGravity(5.0, [0.0, 0.0, -9.0]),
    body.Buoyancy(1000.0, 1e-3, [0.1, 0.0, 0.0]),
    body.LinearDrag(np.diag(RNG.uniform(0.1, 1, 6)), [0.0, 0.3, 0.0]),
    body.QuadraticDrag(RNG.uniform(0.1, 1, 6), [1.0, 0.0, 0.0]),
    body.Spring(3.0, [1.0, 0.0, 0.0], [0.1, 0.2, 0.3], 0.5),
    body.Damper(2.0, [1.0, 1.0, 1.0], [0.1, 0.1, 0.1]),
)
T = np.asarray(se3.exp(0.7 * RNG.normal(size=6)))
V = RNG.normal(size=6)


@functools.partial(jax.jit, static_argnums=0)
def rates(f, situation, T, V):
    """Pose and twist of the formulation, and their rates."""
    y = f.initial(situation.body, T, V)

    def seen(y):
        return f.pose(situation.body, y), f.twist(situation.body, y)

    return jax.jvp(seen, (y,), (f.rate(0.0, y, situation),))


OTHERS = {
    "newton_euler_at_a_point": NewtonEuler([0.3, -0.2, 0.1]),
    "spatial_about_a_point": Spatial([0.3, -0.2, 0.1]),
    "momentum_about_a_point": Momentum([0.3, -0.2, 0.1]),
    "quasi_lagrange_zyz": QuasiLagrange("zyz"),
    "quasi_lagrange_rotation_matrix": QuasiLagrange("rotation_matrix"),
}


@pytest.mark.parametrize(
    "name",
    [*ATTITUDE_FREE, *MINIMAL, *OTHERS, *(pytest.param(n, marks=pytest.mark.slow) for n in SLOW)],
)
def test_accelerations_are_the_same(name: str) -> None:
    """Under all forces, with added mass, at one state."""
    situation = body.rigid_body(PROPERTIES, EVERYTHING, ADDED)
    want = rates(formulations()["spatial_body"], situation, T, V)
    got = rates(OTHERS.get(name) or formulations()[name], situation, T, V)
    assert relative_error(got[0][0], T) < 1e-14 and relative_error(got[0][1], V) < 1e-13
    for a, b in zip(got[1], want[1], strict=True):
        assert relative_error(a, b) <= F64_IDENTITY


def test_as_mujoco_has_it() -> None:
    """A free body under gravity and a wrench, and Newton's equations again with numpy."""
    R, c = np.asarray(quaternion.to_matrix(RNG.normal(size=4))), np.array([0.1, -0.2, 0.3])
    I = R @ np.diag([0.2, 0.3, 0.4]) @ R.T
    wrench = RNG.normal(size=6)
    full = " ".join(map(str, [I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]]))
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option gravity="0 0 -9.81"/><worldbody>
      <body><freejoint/><inertial mass="2" pos="{c[0]} {c[1]} {c[2]}" fullinertia="{full}"/></body>
      </worldbody></mujoco>""")
    data = mujoco.MjData(model)
    data.qpos = np.r_[T[:3, 3], quaternion.from_matrix(T[:3, :3])]
    data.qvel = np.r_[T[:3, :3] @ V[3:], V[:3]]
    data.qfrc_applied = np.r_[T[:3, :3] @ wrench[3:], wrench[:3]]
    mujoco.mj_forward(model, data)
    properties = spatial.MassProperties(np.array(2.0), c, I)
    situation = body.rigid_body(
        properties, [body.UniformGravity(), jax.tree_util.Partial(applied, wrench)]
    )
    for name in ("newton_euler", "newton_euler_origin", "spatial_world"):
        _, (dT, dV) = rates(formulations()[name], situation, T, V)
        a = T[:3, :3] @ (dV[3:] + np.cross(V[:3], V[3:]))
        assert relative_error(np.r_[a, dV[:3]], data.qacc) < 1e-12
        assert relative_error(dT, T @ se3.hat(V)) < 1e-13


def applied(wrench, t, body, T, V):
    return wrench


# Sprung to an attitude from which each of 24 Euler sequences, and every other representation, is
# 48 degrees or more from its singularity: a turn of 60 degrees about (1, 1, 1).
HOME = np.asarray(se3.pose(so3.exp(np.full(3, np.pi / 3 / np.sqrt(3))), np.zeros(3)))
CORNERS = np.array([[0.5, 0, 0], [0, 0.6, 0], [0, 0, 0.7], [-0.4, -0.4, 0.3]])
SWING = body.rigid_body(
    PROPERTIES,
    [
        body.UniformGravity([0.3, -0.2, -0.5]),
        body.LinearDrag(0.02 * np.eye(6)),
        *(body.Spring(20.0, HOME[:3, :3] @ (3 * p), p, 0.2) for p in CORNERS),
    ],
)
KICK = np.array([0.5, -0.6, 0.4, 0.2, 0.3, -0.2])
TIMES = np.linspace(0, 10, 3)
SLOWLY = pytest.mark.slow


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=SLOWLY) for n in (*MINIMAL, *SLOW, *ATTITUDE_FREE)],
)
def test_trajectories_are_the_same(name: str) -> None:
    """Ten seconds of swinging, as Kirchhoff has them."""
    want = motion(formulations()["kirchhoff"], SWING, HOME, KICK, TIMES, 1e-13)
    got = motion(formulations()[name], SWING, HOME, KICK, TIMES, 1e-13)
    assert got[2].min() > 0.3, "too near the singularity for the comparison to mean much"
    assert np.abs(want[0] - HOME).max() > 0.1, "it hardly moved"
    for a, b in zip(got[:2], want[:2], strict=True):
        assert np.abs(a - b).max() <= 1e-10


def test_lagrange_terms_of_a_body() -> None:
    """M = A^T I A, M' - 2C skew, g the gradient, M q'' + C q' + g = 0 along the motion."""
    f = Lagrange("zyz")
    situation = body.rigid_body(PROPERTIES, EVERYTHING[:3], ADDED)
    y = f.initial(situation.body, T, V)

    @jax.jit
    def terms(situation, y):
        system = f.system(situation)
        M, dM = jax.jvp(lambda q: lagrange.mass_matrix(system, q), (y.q,), (y.v,))
        C = lagrange.coriolis_matrix(system, y.q, y.v)
        A = jax.jacfwd(lambda v: f._twist(y.q, v))(y.v)
        left = M @ f.rate(0.0, y, situation).v + C @ y.v + lagrange.gravity_forces(system, y.q)
        return M, A.T @ body.inertia_matrix(situation.body) @ A, dM - 2 * C, left

    M, AIA, skew, left = terms(situation, y)
    assert relative_error(M, AIA) < 1e-14
    assert relative_error(skew, -skew.T) < 1e-13
    assert np.abs(left).max() < 1e-11


def test_at_a_singularity_nothing_is_nan() -> None:
    """There the direct Lagrangian equations raise an error; the others work."""
    level = np.eye(4)  # zyz: its second angle is zero
    situation = body.rigid_body(PROPERTIES, EVERYTHING[:1])
    f = formulations()["lagrange_zyz"]
    with pytest.raises(InputError, match=r"0\.0e\+00 rad from where zyz is singular"):
        f.initial(situation.body, level, V)
    y = jax.jit(f.initial)(situation.body, level, V)
    assert f.singularity_distance(y) == 0 and np.isfinite(np.asarray(y.v)).all()
    free = formulations()["quasi_lagrange"]
    assert np.isinf(free.singularity_distance(free.initial(situation.body, level, V)))
    (_, V0), (_, dV) = rates(free, situation, level, V)
    assert np.isfinite(dV).all() and relative_error(V0, V) < 1e-14


@pytest.mark.slow
def test_differentiable_and_batched() -> None:
    """The gradient of the end by the mass, and a batch of starts."""

    def end(mass, V):
        properties = PROPERTIES._replace(mass=mass)
        situation = body.Situation(body.Body(*properties), SWING.forces[:2])
        f = formulations()["newton_euler"]
        y = diffrax.diffeqsolve(
            f.term(), diffrax.Heun(), 0.0, 0.5, 0.05, f.initial(situation.body, HOME, V), situation
        ).ys
        return f.pose(situation.body, jax.tree.map(lambda x: x[-1], y))[:3, 3].sum()

    both = jax.jit(jax.vmap(jax.value_and_grad(end), (None, 0)))
    starts = np.stack([KICK, 2 * KICK])
    _, gradient = both(jnp.array(2.0), starts)
    h = 1e-4
    ends = [both(jnp.array(2.0 + s * h), starts)[0] for s in (-1, 1)]
    assert relative_error(gradient, (ends[1] - ends[0]) / (2 * h), floor=1e-2) < 1e-6


def test_what_cannot_be_is_refused_in_a_sentence() -> None:
    with pytest.raises(rb.InputError, match=r"4 parameters.*minimal.*QuasiLagrange"):
        Lagrange("unit_quaternion")
    with pytest.raises(rb.UnknownName, match=r"unknown formulation 'newton'.*'newton_euler'"):
        body.formulation("newton")
    with pytest.raises(rb.InputError, match="triangle"):
        body.rigid_body(PROPERTIES._replace(inertia=np.diag([1.0, 1.0, 3.0])))
