"""Printed figures: Cai's table 4.1, Modern Robotics, RBDL's test cases."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.oracles import load
from tests.oracles.textbook import Case, modern_robotics, planar_2r, rbdl, two_link
from tests.tolerances import F64_IDENTITY, F64_PARITY, relative_error


def test_cai_table_41() -> None:
    """Effective inertias of the two-link arm, of a model whose load is changed as a leaf."""
    model, rows = rb.load("two_link"), np.array(load("two_link_table41")["rows"])

    def inertias(m2, theta2):
        bodies = model.bodies.replace(mass=model.bodies.mass.at[1].set(m2))
        (d11, d12), (_, d22) = rb.mass_matrix(
            model.replace(bodies=bodies), jnp.array([0.3, theta2])
        )
        return jnp.stack([d11, d12, d22, d11, d11 - d12**2 / d22])

    got = jax.jit(jax.vmap(inertias))(rows[:, 0], np.radians(rows[:, 1]))
    # the scene's links have some moment of inertia where the book's are points
    assert relative_error(got, rows[:, 2:], batch_dims=1).max() <= F64_IDENTITY


def test_cai_gravity() -> None:
    """(4.20): g = 9.81 [(m1 + m2) sin + m2 sin; m2 sin], lengths of one metre."""
    model = rb.load("two_link")
    q = np.array([0.3, 0.9])
    m1, m2 = np.asarray(model.bodies.mass)
    first, both = np.sin(0.3), np.sin(1.2)
    want = 9.81 * np.array([(m1 + m2) * first + m2 * both, m2 * both])
    assert relative_error(rb.gravity_forces(model, q), want) <= F64_IDENTITY


@pytest.mark.parametrize("name", ["three_link", "UR5"])
def test_modern_robotics(name: str) -> None:
    case = modern_robotics(name)
    model, s = rb.load(case.xml), case.scale
    q, v, a = (s * np.array(case.data[k]) for k in ("q", "v", "a"))
    tau = np.array(case.data["tau"]) / s
    tip, last = np.array(case.data["tip_wrench"]), model.nb - 1

    def answers(q, v, a, tau):
        R, p = rb.frame_pose(model, q, site="tip")  # the wrench is in the tip's axes, by the robot
        at_tip = jnp.concatenate([R @ tip[:3], R @ tip[3:]])
        arm = p - rb.forward_kinematics(model, q).p[last]
        moment = at_tip[:3] + jnp.cross(arm, at_tip[3:])
        on_robot = jnp.zeros((model.nb, 6)).at[last].set(-jnp.r_[moment, at_tip[3:]])
        g = rb.gravity_forces(model, q)
        return {
            "MassMatrix": s[:, None] * rb.mass_matrix(model, q) * s,
            "InverseDynamics": s * rb.inverse_dynamics(model, q, v, a, on_robot),
            "ForwardDynamics": rb.forward_dynamics(model, q, v, tau, on_robot) / s,
            "GravityForces": s * g,
            "VelQuadraticForces": s * (rb.bias_forces(model, q, v) - g),
            "EndEffectorForces": -s * rb.dynamics.generalized_forces(model, q, on_robot),
        }

    got = jax.jit(answers)(q, v, a, tau)
    for key, value in got.items():
        want = case.data["recomputed"][key]
        assert relative_error(value, want) <= F64_PARITY, key
        coarse = name == "UR5" and key == "VelQuadraticForces"  # printed to six decimals
        book = case.data["published"][key]
        np.testing.assert_allclose(
            value, book, rtol=1e-8, atol=1e-6 if coarse else 1e-8, err_msg=key
        )


def test_planar_2r() -> None:
    case: Case = planar_2r()
    model, q, v = rb.load(case.xml), np.array(case.data["theta"]), np.array(case.data["thetadot"])
    assert relative_error(rb.mass_matrix(model, q), case.data["M"]) <= F64_IDENTITY
    bias = np.add(case.data["c"], case.data["grav"])
    assert relative_error(rb.bias_forces(model, q, v), bias) <= F64_IDENTITY


@pytest.mark.parametrize("name", load("rbdl_cases")["cases"])
def test_rbdl(name: str) -> None:
    case = rbdl(name)
    model = rb.load(case.xml)
    q, tau = np.array(case.data["q"]), np.broadcast_to(case.data.get("tau", 0.0), model.nv)
    got = rb.forward_dynamics(model, q, np.zeros(model.nv), np.array(tau))
    assert relative_error(got, case.data["qdd"]) <= F64_PARITY


def test_table_41_of_the_book_and_the_scene_agree() -> None:
    book, scene = rb.load(two_link(1.0).xml), rb.load("two_link")
    q = np.array([0.3, 0.9])
    assert relative_error(rb.mass_matrix(scene, q), rb.mass_matrix(book, q)) <= F64_IDENTITY
