"""Contacts of bodies on beams."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.problem.assemble import Assembly
from rbjax.contact.problem.link_stiffness import LinkStiffness
from rbjax.contact.problem.problem import relative_axes
from rbjax.lanes import unpack
from rbjax.spatial import ArticulatedInertia
from tests.flexible.beams import random_state, round_beam
from tests.tolerances import F64_IDENTITY, F64_TRANSFORM

G, GAP, BALL = 9.81, 1e-3, 0.05
SCENE = """
<mujoco><option gravity="0 0 -9.81" cone="elliptic" timestep="0.002"/><worldbody>
  <geom name="floor" type="plane" size="0 0 1" pos="0 0 {floor}" condim="{condim}"
    solimp="0.9 0.9 0.001 0.5 2"/>
  <body name="tip"><joint name="rod"/>
    <geom name="ball" type="sphere" size="{ball}" mass="0.2" condim="{condim}"
      solref="0.02 1" solimp="0.9 0.9 0.001 0.5 2"/></body>
  </worldbody></mujoco>"""


@functools.cache
def scene(condim: int = 3, E: float = 1e8) -> rb.Model:
    """A ball of 0.2 kg at the tip of a beam along x, `GAP` over a floor."""
    text = SCENE.format(floor=-BALL - GAP, ball=BALL, condim=condim)
    model = rb.load(text, contacts=True)
    return round_beam({"k_y": 1, "k_z": 0}, E=E, damping=0.02).replace_joint(model, "rod")


@functools.cache
def trees():
    """The same tree for articulated-body sweeps and as a matrix; axes of the link and the world."""
    model = scene()
    state = random_state(model)
    q, v = state.q, state.v
    fast, dense = Assembly(model, q, v, iterative=True), Assembly(model, q, v, iterative=True)
    assert fast._articulated
    dense.__dict__["_articulated"] = False
    return model, q, fast, dense


def test_twists_and_forces_of_touching_links() -> None:
    """J x and J^T w of both trees against the Jacobian of the tip."""
    model, q, fast, dense = trees()
    rng = np.random.default_rng(1)
    x, w = jnp.asarray(rng.normal(size=model.nv)), jnp.asarray(rng.normal(size=(2, 6)))
    J, R = rb.jacobian(model, q, "tip"), rb.frame_pose(model, q, "tip")[0]
    world = J @ x
    own = jnp.concatenate([R.T @ world[:3], R.T @ world[3:]])
    np.testing.assert_allclose(fast._tree().twists(x, x.dtype)[0], own, atol=F64_TRANSFORM)
    np.testing.assert_allclose(dense._tree().twists(x, x.dtype)[0], world, atol=F64_TRANSFORM)
    turned = jnp.concatenate([R @ w[0, :3], R @ w[0, 3:]])
    want = J.T @ turned
    np.testing.assert_allclose(fast._tree().generalized(w), want, atol=F64_TRANSFORM)
    both = jnp.stack([turned, w[1]])
    np.testing.assert_allclose(dense._tree().generalized(both), want, atol=F64_TRANSFORM)


def test_the_hessian_of_a_contact_at_a_frame() -> None:
    """M + J^T K J + rows, factorized by sweeps and as a matrix, against NumPy."""
    model, q, fast, dense = trees()
    rng = np.random.default_rng(2)
    K = rng.normal(size=(6, 6))
    K, b = K @ K.T, rng.normal(size=model.nv)
    J, R = np.asarray(rb.jacobian(model, q, "tip")), rb.frame_pose(model, q, "tip")[0]
    H = np.asarray(rb.mass_matrix(model, q)) + J.T @ K @ J
    H[1, 1] += 2.0
    rows, turn = [({1: 1.0}, 2.0)], np.kron(np.eye(2), np.asarray(R))
    for assembly, own in ((fast, turn.T @ K @ turn), (dense, K)):
        factors = assembly._tree().factorize(_stiffness(own), rows)
        got = factors.solve(jnp.asarray(b))
        np.testing.assert_allclose(H @ np.asarray(got), b, atol=F64_IDENTITY * np.abs(H).max())


def _stiffness(K):
    """The stiffness of one link, a symmetric 6 x 6 matrix [[J, H], [H^T, M]]."""
    sym = lambda A: [A[0, 0], A[1, 1], A[2, 2], A[0, 1], A[0, 2], A[1, 2]]  # noqa: E731
    lanes = [*sym(K[:3, :3]), *K[:3, 3:].ravel(), *sym(K[3:, 3:])]
    return LinkStiffness.zero(1, K.dtype).add(0, ArticulatedInertia.from_lanes(lanes))


def test_relative_axes_of_two_frames_of_one_beam() -> None:
    """J of the tip minus J of another frame, about one origin."""
    _, _, _, dense = trees()
    top = dense.top
    tip, other = top.body_links[0], top.nv + 1
    S = relative_axes(dense._axes, top.ancestors[other], top.ancestors[tip])
    x = unpack(jnp.asarray(np.random.default_rng(3).normal(size=top.nv)))
    tree = dense._tree()._replace(touching=[other, tip])
    twists = tree.twists(jnp.stack(x), x[0].dtype)
    got = sum(jnp.asarray([*S[n].ang, *S[n].lin]) * x[n] for n in S)
    np.testing.assert_allclose(got, twists[1] - twists[0], atol=F64_TRANSFORM)


def test_a_tip_at_rest_on_a_floor() -> None:
    """The penetration p of a ball on a cantilever: k p / R = 3 EI / L^3 (d - gap - p).

    d = (m / 3 + mu L / 8) g L^3 / EI is the deflection without the floor, k and R = w (1 - i) / i
    are those of MuJoCo's model with the impedance i, and w is the mean of the diagonal of
    J M^-1 J^T. The deflection is 1e-3 of the length, so linear theory errs by about 1e-6.
    """
    model = scene(condim=1, E=1e10)
    EI, mu = 1e10 * np.pi * 0.01**4 / 4, 1000 * np.pi * 0.01**2
    start = model.default_state()
    path = rb.rollout(
        model, start, None, 2e-3, steps=1500, integrator="implicitfast", contact="mujoco",
        save_every=1500,
    )  # fmt: skip
    z = float(rb.frame_pose(model, path.q[-1], "tip")[1][2])
    J = rb.jacobian(model, start.q, "tip")[3:]
    w = np.trace(J @ rb.inverse_mass_matrix(model, start.q) @ J.T) / 3
    i, k = 0.9, 1 / (0.9**2 * 0.02**2)
    contact, beam = k * i / (w * (1 - i) / i), 3 * EI
    free = (0.2 / 3 + mu / 8) * G / EI
    p = beam * (free - GAP) / (contact + beam)
    assert np.abs(path.v[-1]).max() < 1e-9
    assert abs(-z - GAP - p) < 1e-5 * p


@pytest.mark.parametrize("law", ["coulomb", "impulse"])
def test_laws_of_contact_hold_a_tip(law: str) -> None:
    """The ball comes to rest on the floor."""
    model = scene()
    path = rb.rollout(
        model, model.default_state(), None, 2e-3, steps=1500, contact=law, save_every=1500
    )
    z = float(rb.frame_pose(model, path.q[-1], "tip")[1][2])
    assert -GAP - 1e-3 < z < -GAP + 1e-6
    assert np.abs(path.v[-1]).max() < 1e-6


PAIR = """
<mujoco><option gravity="0 0 -9.81" cone="elliptic" timestep="0.002"/><worldbody>
  <geom name="floor" type="plane" size="0 0 1" pos="0 0 -0.0499"/>
  <body name="a"><joint name="one"/><geom type="sphere" size="0.05" mass="0.2"/></body>
  <body name="b" pos="0 0.0999 0"><joint name="two"/>
    <geom type="sphere" size="0.05" mass="0.2"/></body>
  </worldbody></mujoco>"""


@functools.cache
def two_beams() -> rb.Model:
    """Two parallel beams whose balls touch each other and a floor."""
    rod = round_beam({"k_y": 1, "k_z": 0}, E=1e9, damping=0.02)
    model = rb.load(PAIR, contacts=True)
    return rod.replace_joint(rod.replace_joint(model, "one"), "two")


def test_derivatives_with_contacts_between_two_beams() -> None:
    """Values by sweeps and conjugate gradients, derivatives by the matrix: central differences."""
    model = two_beams()
    q = model.default_state().q
    rng = np.random.default_rng(4)
    v, dv = (jnp.asarray(0.1 * rng.normal(size=model.nv)) for _ in range(2))

    @jax.jit
    def both(v, dv):
        f = lambda v: rb.acceleration(model, rb.State(q, v), contact="mujoco")  # noqa: E731
        h = 1e-6
        slope = (f(v + h * dv) - f(v - h * dv)) / (2 * h)
        return f(v), jax.jvp(f, (v,), (dv,))[1], slope

    a, exact, slope = both(v, dv)
    free = rb.acceleration(model.replace(contact=None), rb.State(q, v))
    assert np.abs(a - free).max() > 1.0  # the contacts act
    np.testing.assert_allclose(exact, slope, atol=1e-6 * np.abs(slope).max())


@pytest.mark.parametrize("integrator", ["implicitfast", "discrete"])
def test_two_beams_come_to_rest(integrator: str) -> None:
    """Both balls are on the floor, and mirror images of each other. `discrete` uses the matrix."""
    model = two_beams()
    path = rb.rollout(
        model, model.default_state(), None, 2e-3, steps=500, contact="mujoco",
        integrator=integrator, save_every=500,
    )  # fmt: skip
    q = np.asarray(path.q[-1])
    np.testing.assert_allclose(q[:2], q[3:5], atol=1e-9)
    np.testing.assert_allclose(q[2], -q[5], atol=1e-9)
    assert np.abs(path.v[-1]).max() < 1e-6
    assert q[2] < -1e-5  # the contact bends the beams apart


FINGER = """
<mujoco><option gravity="0 0 -9.81" cone="elliptic" timestep="0.002"/><worldbody>
  <geom name="floor" type="plane" size="0 0 1" pos="0 0 -0.3"/>
  <body name="arm"><joint name="hip" axis="0 1 0"/>
    <geom type="sphere" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
    <body name="tip">{joint}
      <geom type="capsule" size="0.03" fromto="{start} 0 0 {end} 0 0" mass="0.2"/>
    </body></body></worldbody></mujoco>"""


def test_a_stiff_finger_is_a_rigid_finger() -> None:
    """A capsule at the tip of a beam on a hinge falls on a floor and stays there.

    With stiffness the angle of the hinge tends to that of a rigid finger. The difference that is
    left, 3e-5 at rest and 1e-4 in the impact, is MuJoCo's softness of the contact: it depends on
    J M^-1 J^T, which is larger with the coordinates of the beam.
    """
    rigid = rb.load(FINGER.format(joint="", start=0.9, end=1.1), contacts=True)
    tip = rb.load(FINGER.format(joint='<joint name="rod"/>', start=-0.1, end=0.1), contacts=True)

    def angles(model: rb.Model) -> np.ndarray:
        path = rb.rollout(
            model, model.default_state(), None, 2e-3, steps=400, integrator="discrete",
            contact="mujoco", save_every=40,
        )  # fmt: skip
        return np.asarray(path.q[:, 0])

    want, errors = angles(rigid), []
    for E in (1e9, 1e11, 1e13):
        section = rb.flexible.circle(0.01, E=E, nu=0.3, density=1e-3)
        beam = rb.flexible.beam(1.0, section, {"k_y": 1, "k_z": 1}, damping=1e-3)
        errors.append(np.abs(angles(beam.replace_joint(tip, "rod")) - want).max())
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 2e-4
