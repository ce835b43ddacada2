"""Distributed loads on beams, against gravity and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.errors import InputError, UnknownName

MASS, LENGTH, EI = 0.7, 1.3, 5.0


def rod(gravity: str = "0 0 0", **given) -> rb.Model:
    beam = rb.flexible.beam(
        LENGTH, [3.0, EI, EI, 0, 0, 0], {"k_y": 2, "k_z": 2}, mass=MASS, **given
    )
    return rb.load(f'<mujoco><option gravity="{gravity}"/></mujoco>').with_beam("rod", beam)


def test_a_load_of_the_weight_is_gravity() -> None:
    model, heavy = rod(), rod("0.3 -0.5 -9.81")
    load = rb.flexible.BeamLoad.of(model, "rod", force=MASS * heavy.gravity)
    q = jnp.array([0.4, -0.3, 0.2, 0.5, 0.1, -0.2])
    v = 0.3 * q[::-1]
    got = rb.acceleration(model.with_forces(load), rb.State(q, v))
    np.testing.assert_allclose(got, rb.acceleration(heavy, rb.State(q, v)), rtol=1e-11)


def test_a_small_load_deflects_a_cantilever_by_its_closed_form() -> None:
    """Deflection f L^4 / (8 EI) and slope f L^3 / (6 EI): the curvature is of degree 2."""
    model, f = rod(), 1e-6
    load = rb.flexible.BeamLoad.of(model, "rod", force=[0.0, f, 0.0])
    K = -jax.jacfwd(lambda q: rb.applied_forces(model, rb.State(q, 0 * q)))(jnp.zeros(6))
    q0 = jnp.zeros(6)
    tau = rb.applied_forces(model.with_forces(load), rb.State(q0, q0))
    R, p = rb.frame_pose(model, jnp.linalg.solve(K, tau), "rod")
    np.testing.assert_allclose(p[1], f * LENGTH**4 / (8 * EI), rtol=1e-9)
    np.testing.assert_allclose(R[1, 0], f * LENGTH**3 / (6 * EI), rtol=1e-9)


def test_a_moment_that_turns_with_the_sections_does_work_on_curvature_only() -> None:
    """int m . W_j ds of a planar beam: the same at every shape."""
    model = rod()
    load = rb.flexible.BeamLoad.of(model, "rod", moment=[0.0, 0.0, 0.4], axes="section")
    elastic = lambda q: rb.applied_forces(model, rb.State(q, 0 * q))  # noqa: E731
    own = lambda q: rb.applied_forces(model.with_forces(load), rb.State(q, 0 * q)) - elastic(q)  # noqa: E731
    bent = jnp.zeros(6).at[3:].set(jnp.array([0.9, -0.4, 0.3]))
    np.testing.assert_allclose(own(bent), own(0 * bent), rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(own(bent)[3], 0.4 * LENGTH**2 / 2, rtol=1e-12)


def test_rows_at_gauss_points_and_derivatives() -> None:
    model = rod()
    points = model.topology.joints[0].shape.points
    one = rb.flexible.BeamLoad.of(model, "rod", force=[1.0, 2.0, 3.0])
    each = rb.flexible.BeamLoad.of(model, "rod", force=np.tile([1.0, 2.0, 3.0], (points, 1)))
    q = jnp.linspace(-0.3, 0.4, 6)

    def tau(load):
        return rb.applied_forces(model.with_forces(load), rb.State(q, q))

    np.testing.assert_allclose(tau(each), tau(one), rtol=1e-12)
    slope = jax.jacfwd(lambda f: tau(one.replace(force=f)))(one.force)
    unit = tau(one.replace(force=jnp.array([0.0, 1.0, 0.0]))) - tau(one.replace(force=jnp.zeros(3)))
    np.testing.assert_allclose(slope[:, 1], unit, rtol=1e-12, atol=1e-13)


def test_wrong_loads() -> None:
    model = rod()
    with pytest.raises(InputError, match="expected \\(3,\\) or \\(6, 3\\)"):
        rb.flexible.BeamLoad.of(model, "rod", force=[1.0, 2.0])
    with pytest.raises(InputError, match="expected 'world' or 'section'"):
        rb.flexible.BeamLoad.of(model, "rod", axes="body")  # type: ignore[arg-type]
    with pytest.raises(UnknownName):
        rb.flexible.BeamLoad.of(model, "rope")
    with pytest.raises(InputError, match="expected a beam"):
        rb.flexible.BeamLoad.of(rb.load("pendulum"), rb.load("pendulum").joint_names[0])
