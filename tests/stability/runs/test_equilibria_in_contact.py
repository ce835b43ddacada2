"""Equilibria of robots on the floor, and linearised motions about them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb

BOX = """<mujoco><option timestep="0.002" cone="elliptic"/><worldbody>
  <geom type="plane" size="0 0 1"/><body pos="0 0 0.1"><freejoint/>
    <geom type="box" size="0.1 0.1 0.1" mass="2" priority="1" solref="0.02 1"
      solimp="0.9 0.9 0.001"/></body></worldbody></mujoco>"""
LEG = """<body pos="{x} 0 0"><joint name="{name}" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.38" size="0.02" mass="0.3" contype="0" conaffinity="0"/>
  <geom type="sphere" size="0.02" pos="0 0 -0.38" mass="0.05"/></body>"""
TWO_LEGS = f"""<mujoco><option timestep="0.002"/><worldbody><geom type="plane" size="0 0 1"/>
  <body name="trunk" pos="0 0 0.4">
    <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>
    <geom type="box" size="0.2 0.1 0.05" mass="6" contype="0" conaffinity="0"/>
    {LEG.format(x=0.15, name="front")}{LEG.format(x=-0.15, name="rear")}
  </body></worldbody><actuator><position joint="front" kp="100" kv="2"/>
  <position joint="rear" kp="100" kv="2"/></actuator></mujoco>"""


def loaded(text: str) -> rb.Model:
    double = lambda x: x.astype(float) if getattr(x, "dtype", None) == jnp.float32 else x  # noqa: E731
    return jax.tree.map(double, rb.load(text, contacts=True))


def tilted_box(model: rb.Model) -> rb.State:
    q = jnp.array([0.0, 0.0, 0.099, 1.0, 0.003, 0.0, 0.0])
    return rb.State(q.at[3:].divide(jnp.linalg.norm(q[3:])), jnp.zeros(6))


def test_a_box_rests_at_the_depth_of_the_closed_form() -> None:
    """With constant impedance d, stiffness k = 1 / (d tc)^2 and four contacts of the weight m g / 4
    each, d / (1 - d) m k d r = m g / 4, so r = (1 - d) g tc^2 / 4 (damping ratio 1)."""
    model = loaded(BOX)
    rest = rb.stability.equilibrium(model, tilted_box(model))
    assert 0.1 - float(rest.q[2]) == pytest.approx(0.1 * 9.81 * 0.02**2 / 4, rel=1e-9)
    np.testing.assert_allclose(np.abs(rest.q[3:]), [1, 0, 0, 0], atol=1e-12)


def test_a_robot_on_two_legs_stands() -> None:
    """The acceleration vanishes, the weight is on the feet, and the motion about it decays; the
    continuous and the discrete matrices agree."""
    model, ctrl = loaded(TWO_LEGS), jnp.array([0.2, -0.2])
    q = jnp.array([0.0, 0.38 * np.cos(0.2) - 0.383, 0.0, 0.2, -0.2])
    rest = rb.stability.equilibrium(model, rb.State(q, jnp.zeros(5)), ctrl)
    assert abs(float(rest.q[2])) < 1e-9 and float(rest.q[3]) == pytest.approx(-float(rest.q[4]))
    A, B = jax.jit(lambda s: tuple(rb.linearise(model, s, ctrl)))(rest)
    assert np.linalg.eigvals(A).real.max() < 1e-6
    h = 1e-5
    A_h, B_h = jax.jit(lambda s: tuple(rb.linearise(model, s, ctrl, h)))(rest)
    np.testing.assert_allclose((A_h - np.eye(10)) / h, A, atol=2e-3 * np.abs(A).max())
    np.testing.assert_allclose(B_h / h, B, atol=2e-3 * np.abs(B).max())


def test_a_box_above_the_floor_has_no_equilibrium_near() -> None:
    model = loaded(BOX)
    state = tilted_box(model)
    with pytest.raises(rb.InputError, match=r"an acceleration of 9\.8e\+00 is left"):
        rb.stability.equilibrium(model, state.replace(q=state.q.at[2].set(0.2)), steps=3)
