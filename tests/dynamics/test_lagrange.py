"""The coefficients of Lagrange's equations: table 4.1 of Cai Zixing, and inverse dynamics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.tolerances import F32_MAX, F64_IDENTITY

#: m2 in kg; cos of joint 2; D_11, D_12, D_22 (m1 = 2 kg, both links 1 m): the robot without load,
#: with a load on the ground, and with one in space
TABLE_4_1 = [
    (1, 1, 6, 2, 1), (1, 0, 4, 1, 1), (1, -1, 2, 0, 1),
    (4, 1, 18, 8, 4), (4, 0, 10, 4, 4), (4, -1, 2, 0, 4),
    (100, 1, 402, 200, 100), (100, 0, 202, 100, 100), (100, -1, 2, 0, 100),
]  # fmt: skip


@pytest.mark.parametrize(("m2", "cosine", "D11", "D12", "D22"), TABLE_4_1)
def test_table_4_1(m2, cosine, D11, D12, D22):
    arm = rb.load("two_link")
    arm = arm.replace(bodies=arm.bodies.replace(mass=jnp.array([2.0, m2])))
    angle, g = np.arccos(cosine), 9.81
    found = rb.lagrange_coefficients(arm, jnp.array([0.3, angle]))
    np.testing.assert_allclose(found.inertia, [[D11, D12], [D12, D22]], atol=1e-12 * m2)
    # equations (4.9) and (4.10): D_122 = -m2 d1 d2 sin, D_112 = D_121 = the same, D_211 = -D_122
    s = m2 * np.sin(angle)
    expected = np.array([[[0, -s], [-s, -s]], [[s, 0], [0, 0]]])
    np.testing.assert_allclose(found.velocity, expected, atol=1e-12 * m2)
    outer = m2 * g * np.sin(0.3 + angle)
    gravity = [(2 + m2) * g * np.sin(0.3) + outer, outer]
    np.testing.assert_allclose(found.gravity, gravity, atol=1e-12 * m2 * g)


@pytest.mark.parametrize("name", ["cart_pole", "free_body", "arm7"])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_sum_of_all_terms_is_inverse_dynamics(name, dtype):
    model = rb.load(name).astype(dtype)
    state = model.random_state(jax.random.key(0))
    a = jax.random.normal(jax.random.key(1), (model.nv,), dtype)
    D = rb.lagrange_coefficients(model, state.q)
    assert {x.dtype for x in D} == {jnp.dtype(dtype)}
    np.testing.assert_array_equal(D.velocity, jnp.swapaxes(D.velocity, 1, 2))
    tau = D.inertia @ a + jnp.einsum("ijk,j,k", D.velocity, state.v, state.v) + D.gravity
    expected = rb.inverse_dynamics(model, state.q, state.v, a)
    scale = float(jnp.abs(expected).max())
    tolerance = F64_IDENTITY if dtype == jnp.float64 else F32_MAX
    np.testing.assert_allclose(tau, expected, rtol=0, atol=tolerance * scale)


def test_no_dof_and_wrong_arguments():
    still = rb.load("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>", floating_base=False)
    assert [x.shape for x in rb.lagrange_coefficients(still, jnp.zeros(0))] == [
        (0, 0), (0, 0, 0), (0,)
    ]  # fmt: skip
    with pytest.raises(rb.InputError, match=r"lagrange_coefficients: q has shape \(3,\)"):
        rb.lagrange_coefficients(rb.load("two_link"), jnp.zeros(3))
    with pytest.raises(rb.InputError, match="expected a Model"):
        rb.lagrange_coefficients("two_link", jnp.zeros(2))
