"""Modal bodies as links of a robot: frequencies, equations of motion, momenta, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.errors import InputError, UnknownName
from rbjax.flexible.modal import (
    BeamSection,
    Interface,
    ModalLayout,
    ModalLink,
    add_modal_body,
    beam_mesh,
    craig_bampton,
    from_points,
)
from rbjax.lanes import Vec3
from tests.flexible.modal.points import energy, lagrange, random_points

HUB = """<mujoco><option gravity="0 0 0"/><worldbody><body name="hub">
  <joint name="turn" type="hinge" axis="0 0 1"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
</body></worldbody></mujoco>"""
SECTION = BeamSection(EA=2.8e7, EIy=2.8e4, EIz=1.4e4, GJ=1.4e4, mass=1.2, rotary=(1e-3, 0.0, 0.0))


def beam(**options):
    mesh = beam_mesh(np.linspace([0.0, 0, 0], [10.0, 0, 0], 11), SECTION)
    ends = [Interface("root", [0]), Interface("tip", [10])]
    return craig_bampton(mesh, ends, 8, frame="root", keep=4, **options)


def test_a_clamped_body_has_its_frequencies():
    body = beam().with_damping(0.01)
    model = add_modal_body(rb.load("<mujoco/>"), "arm", body)
    state = model.default_state()
    M = np.asarray(rb.mass_matrix(model, state.q))
    assert np.abs(M - np.asarray(body.modal_mass)).max() < 1e-12

    def accelerations(q, v):
        state_ = state.replace(q=q, v=v)
        return rb.forward_dynamics(model, q, v, rb.applied_forces(model, state_))

    K, D = (-np.asarray(x) for x in jax.jit(jax.jacfwd(accelerations, (0, 1)))(state.q, state.v))
    assert np.allclose(np.sort(np.linalg.eigvals(K).real), body.frequencies**2, rtol=1e-10)
    assert np.allclose(D, np.diag(0.02 * body.frequencies), atol=1e-12 * D.max())


def test_a_free_body_obeys_lagrange():
    """Forward dynamics of a free modal body against its points, with a force on it."""
    rng = np.random.default_rng(1)
    points = random_points(rng, n=6, m=2)
    body = from_points(**points, stiffness=np.diag([3.0, 5.0]), frames=[0, 3])
    world = rb.load('<mujoco><option gravity="0 0 0"/></mujoco>')
    model = add_modal_body(world, "blob", body, free=True, frames={"spot": "0"})
    q = jnp.asarray([0.0, 0, 0, 1, 0, 0, 0, *rng.normal(size=2)])
    v, tau = jnp.asarray(rng.normal(size=8)), jnp.asarray(rng.normal(size=8))
    a = np.asarray(jax.jit(rb.forward_dynamics)(model, q, v, tau))
    # at the identity attitude the linear acceleration in the world is that in body axes
    found = lagrange(
        lambda *x: energy(points, *x), v[3:6], v[:3], q[7:], v[6:], a[3:6], a[:3], a[6:]
    )
    got = np.concatenate([found[1], found[0], found[2]])
    assert np.abs(got - np.asarray(tau)).max() < 1e-11 * np.abs(a).max()
    back = np.asarray(jax.jit(rb.inverse_dynamics)(model, q, v, jnp.asarray(a)))
    assert np.abs(back - np.asarray(tau)).max() < 1e-11 * np.abs(a).max()
    want = energy(points, v[3:6], v[:3], q[7:], v[6:])
    M = np.asarray(rb.mass_matrix(model, q))
    assert abs(v @ M @ v / 2 - want) < 1e-12 * want


def test_spin_up_without_stiffening_diverges_in_the_equations():
    """The hub turns at 6 rad/s: the stiffness of the modes in the plane, by the model's forces."""
    least = []
    for body in (beam(), beam(stiffening=False)):
        model = add_modal_body(rb.load(HUB), "arm", body, "hub")
        v = jnp.zeros(5).at[0].set(6.0)

        def forces(x, model=model, v=v):
            q = jnp.concatenate([jnp.zeros(1), x])
            state = model.default_state().replace(q=q, v=v)
            bias = rb.inverse_dynamics(model, q, v, jnp.zeros(5))
            return (bias - rb.applied_forces(model, state))[1:]

        K = np.asarray(jax.jit(jax.jacfwd(forces))(jnp.zeros(4)))
        least.append(np.linalg.eigvalsh((K + K.T) / 2)[0])
    assert least[0] > 0 > least[1]
    assert abs(least[1] - -21.58) < 0.01


def test_mass_matrix_of_a_light_hub_is_positive_definite():
    """Tip deflections of a fifth of the length: the modes have almost all of the inertia of the
    hub's joint, so terms of second order in J alone would make it negative.
    """
    body = beam()
    model = add_modal_body(rb.load(HUB), "arm", body, "hub")
    mass = jax.jit(rb.mass_matrix)
    rng = np.random.default_rng(0)
    tip = np.abs(np.asarray(body.modes)[1]).max()
    for _ in range(20):
        q = rng.normal(size=5)
        q[1:] *= 2.0 / tip / np.linalg.norm(q[1:])
        assert np.linalg.eigvalsh(np.asarray(mass(model, jnp.asarray(q))))[0] > 0
    # with all terms of second order it is not
    q = jnp.asarray([0.0, *np.eye(4)[1] * 2.0 / tip])
    full = ModalLink.of(body, 1e-12, second_order=True).inertia(
        list(q[1:]), [0.0] * 4, Vec3.zero(), ModalLayout.of(body, 1e-12).values(body)
    )
    c = np.array([float(x.ang[2]) for x in full.coupling])
    assert float(full.rigid.J.dense[8]) - c @ c + 1.0 < 0


def test_derivatives_by_the_numbers_of_the_body():
    body = from_points(**random_points(np.random.default_rng(2), n=5, m=2), frames=[4])
    layout = ModalLayout.of(body)
    world = rb.load('<mujoco><option gravity="0 0 -9.81"/></mujoco>')

    @jax.jit
    def tip(scale):
        model = add_modal_body(
            world, "blob",
            body.replace(coupling=body.coupling, first_moment1=body.first_moment1 * scale),
            layout=layout,
        )  # fmt: skip
        q, v = jnp.array([0.1, -0.2]), jnp.array([0.3, 0.4])
        return rb.forward_dynamics(model, q, v, jnp.zeros(2)).sum()

    slope = float(jax.grad(tip)(1.0))
    assert abs(slope - float(tip(1.5) - tip(0.5))) < 1e-10 * abs(slope)  # linear in the weight


def test_wrong_input():
    world, body = rb.load("<mujoco/>"), beam()
    with pytest.raises(InputError, match="no frames"):
        add_modal_body(world, "x", from_points([1.0], [[0, 0, 0]], np.ones((1, 3, 1))))
    with pytest.raises(UnknownName, match="tipp"):
        add_modal_body(world, "x", body, at="tipp")
    with pytest.raises(InputError, match="use 'x'"):
        add_modal_body(world, "x", body, frames={"y": "tip"})
    with pytest.raises(InputError, match="free=True"):
        add_modal_body(rb.load(HUB), "x", body, "hub", free=True)
    with pytest.raises(InputError, match="different names"):
        body.with_frames(["tip", "tip"])
