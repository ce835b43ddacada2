"""Contacts of geoms on the frames of a beam (`rb.contact.with_geom`)."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.flexible.beams import random_state, round_beam, with_mass

G, BALL, LENGTH, RADIUS = 9.81, 0.02, 1.0, 0.01
MU = 1000 * np.pi * RADIUS**2  # kg/m of `round_beam`
FLOOR = """
<mujoco><option gravity="0 0 -9.81" cone="elliptic" timestep="0.001"/><worldbody>
  <geom name="floor" type="plane" size="0 0 1" friction="0.5"/>{bodies}</worldbody></mujoco>"""
HUB = """
<body name="hub" pos="0 0 0.02"><joint name="hip" axis="0 1 0"/>
  <inertial pos="0 0 0" mass="1e-3" diaginertia="1e-6 1e-6 1e-6"/></body>"""
#: stiff contacts: k = 1e5 / s^2
STIFF = {"solref": (-1e5, -600.0), "solimp": (0.9, 0.9, 0.001, 0.5, 2.0), "friction": (0.5, 0, 0)}


def with_balls(model: rb.Model, bodies: tuple[str, ...], **given) -> rb.Model:
    """Fix a ball to each body."""
    for body in bodies:
        model = rb.contact.with_geom(model, f"{body} ball", body, "sphere", BALL, **(STIFF | given))
    return model


@functools.cache
def on_supports(degree: int = 6, E: float = 1e9) -> tuple[rb.Model, rb.State]:
    """A horizontal beam on a hinge, on a ball at midspan and one at the tip, at rest."""
    rod = round_beam({"k_y": degree}, E=E, damping=0.02)
    model = rb.load(FLOOR.format(bodies=HUB)).with_beam("tip", rod, "hub", frames={"middle": 0.5})
    model = with_balls(model, ("middle", "tip"))
    path = rb.rollout(
        model, model.default_state(), None, steps=2500, integrator="implicitfast", save_every=2500
    )
    assert np.abs(path.v[-1]).max() < 1e-9
    return model, path.state(-1)


def test_reactions_of_a_beam_on_three_supports() -> None:
    """48 EI / L^3 at midspan and 5 mu g L^4 / 384 EI, with the penetration of both balls.

    About the hinge, R_1 L / 2 + R_2 L = mu g L^2 / 2. A polynomial of degree 6 errs by 1.5e-3,
    because a force in a span makes a kink in the curvature.
    """
    model, rest = on_supports()
    EI, w = 1e9 * np.pi * RADIUS**4 / 4, MU * G
    found = rb.contact.solve(model, rest)
    order = [model.geoms.names[max(pair)] for pair in found.contacts.geoms]
    R = dict(zip(order, np.asarray(found.contacts.force[:, 0]), strict=True))
    p = {name: BALL - float(rb.frame_pose(model, rest.q, name)[1][2]) for name in ("middle", "tip")}
    about_hip = R["middle ball"] * LENGTH / 2 + R["tip ball"] * LENGTH
    assert about_hip == pytest.approx(w * LENGTH**2 / 2, rel=1e-4)
    free = 5 * w * LENGTH**4 / (384 * EI)
    want = (free - (p["middle"] - p["tip"] / 2)) * 48 * EI / LENGTH**3
    assert R["middle ball"] == pytest.approx(want, rel=2e-3)
    assert R["middle ball"] == pytest.approx(5 * w * LENGTH / 8, rel=0.05)  # rigid supports


def test_axes_of_an_inner_frame_against_its_jacobian() -> None:
    """The acceleration with frictionless contact: M a + b = J^T f with the Jacobian of the frame.

    Source: the forces that `rb.contact.solve` reports, in the axes of each contact.
    """
    rod = round_beam(E=1e7)
    model = rb.load(FLOOR.format(bodies="")).with_beam(
        "tip", rod, position=(0, 0, 0.015), frames={"a": 0.3, "middle": 0.5}
    )
    model = with_balls(model, ("a", "middle", "tip"), condim=3)
    state = random_state(model)
    state = state.replace(q=0.01 * state.q, v=0.1 * state.v)
    found = rb.contact.solve(model, state)
    assert int((found.contacts.force[:, 0] > 0).sum()) >= 2
    tau = jnp.zeros(model.nv)
    for k, (_, ball) in enumerate(found.contacts.geoms):
        if not float(found.contacts.force[k, 0]) > 0:
            continue
        body = model.body_names[model.geoms.bodies[ball]]
        R, at = rb.frame_pose(model, state.q, body)
        point = R.T @ (found.contacts.position[k] - at)
        J = rb.jacobian(model, state.q, body, point)[3:]
        tau = tau + J.T @ (found.contacts.frame[k].T @ found.contacts.force[k, :3])
    applied = rb.applied_forces(model, state)
    want = rb.inverse_dynamics(model, state.q, state.v, found.acceleration)
    scale = np.abs(want).max()
    np.testing.assert_allclose(applied + tau, want, atol=1e-8 * scale)


def lying(dtype=np.float64, drop: float = 0.0) -> rb.Model:
    """A free beam along x on a floor, with five balls."""
    rod = round_beam({"k_y": 1, "k_z": 1}, damping=0.02)
    frames = {f"s{k}": k / 4 for k in (1, 2, 3)}
    model = rb.load(FLOOR.format(bodies="")).with_beam(
        "tip", rod, position=(0, 0, BALL + drop), free=True, frames=frames
    )
    return with_balls(model, ("tip_base", *frames, "tip"), condim=3).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_beam_comes_to_rest_on_a_floor(dtype) -> None:
    """It falls from 5 mm. The forces carry its weight, without a moment about its middle."""
    model = lying(dtype, drop=5e-3)
    path = rb.rollout(
        model, model.default_state(), None, steps=1500, integrator="implicitfast", save_every=1500
    )
    found = rb.contact.solve(model, path.state(-1))
    N, x = np.asarray(found.contacts.force[:, 0]), np.asarray(found.contacts.position[:, 0])
    close = 1e-4 if dtype == np.float32 else 1e-6
    assert N.min() > 0 and N.sum() == pytest.approx(MU * LENGTH * G, rel=close)
    assert N @ (x - LENGTH / 2) == pytest.approx(0, abs=float(close * N.sum()))


def test_a_sliding_beam_is_slowed_by_friction() -> None:
    """v = v_0 - mu g t of the center of mass, by Coulomb's law."""
    model, steps = lying(), 100
    rest = rb.rollout(
        model, model.default_state(), None, steps=500, integrator="implicitfast", save_every=500
    ).state(-1)  # fmt: skip
    v = rest.v.at[model.v_slice("tip_base").start].set(1.0)
    path = rb.rollout(
        model, rb.State(rest.q, v), None, steps=steps, contact="coulomb", save_every=steps
    )
    momentum = rb.centroidal_momentum(model, path.q[-1], path.v[-1])[3]
    t = steps * model.timestep
    assert momentum / (MU * LENGTH) == pytest.approx(1.0 - 0.5 * G * t, abs=2e-3)


def test_derivatives_of_a_contact_at_an_inner_frame() -> None:
    """By the state, Young's modulus and the friction, against central differences."""
    rod = round_beam(E=1e8)
    base = rb.load(FLOOR.format(bodies="")).with_beam(
        "tip", rod, position=(0, 0, 0.0195), frames={"middle": 0.5}
    )
    model = with_balls(base, ("middle", "tip"), condim=3, friction=(0.05, 0, 0))
    rng = np.random.default_rng(5)
    q, v = jnp.full(model.nv, 1e-3), jnp.asarray([0.1, 0.1, 3.0, 3.0])  # both balls slide
    dq, dv = (jnp.asarray(x) for x in rng.normal(size=(2, model.nv)))

    def acceleration(x):
        factor, mu = 1.0 + x[1], model.geoms.friction.at[0, 0].set(0.1 + x[2])
        soft = model.forces[0]
        forces = (soft.replace(stiffness=factor * soft.stiffness),)
        one = model.replace(forces=forces, geoms=model.geoms.replace(friction=mu))
        return rb.acceleration(one, rb.State(q + x[0] * dq, v + x[0] * dv), contact="mujoco")

    zero, h = jnp.zeros(3), 1e-6
    J = jax.jacfwd(acceleration)(zero)
    reverse = jax.jacrev(acceleration)(zero)
    step = jax.jit(acceleration)
    slopes = [(step(h * e) - step(-h * e)) / (2 * h) for e in np.eye(3)]
    free = rb.acceleration(model.replace(contact=None), rb.State(q, v))
    assert np.abs(step(zero) - free).max() > 1.0  # the contacts act
    want = np.stack(slopes, 1)
    assert np.abs(want).max(0).min() > 1e-3
    for got in (J, reverse):
        np.testing.assert_allclose(got, want, atol=1e-6 * np.abs(want).max(0).max())


def test_a_stiff_beam_is_a_rigid_link() -> None:
    """A light beam on a hinge, with a mass at the tip, falls on a ball at midspan and stays there.

    The angle of the hinge tends to that of a rigid link with the same ball.
    """
    hub = HUB.replace("0 0 0.02", "0 0 0.1").replace("</body>", "{more}</body>")
    tip = """<body name="tip" pos="1 0 0">
      <inertial pos="0 0 0" mass="0.1" diaginertia="1e-3 1e-3 1e-3"/></body>"""
    text = FLOOR.format(bodies=hub).replace("friction", 'condim="1" friction')
    rigid = rb.contact.with_geom(
        rb.load(text.format(more=tip)),
        "ball",
        "hub",
        "sphere",
        BALL,
        position=(0.5, 0, 0),
        condim=1,
    )

    def angles(model: rb.Model) -> np.ndarray:
        path = rb.rollout(
            model, model.default_state(), None, 2e-3, steps=400, integrator="discrete",
            save_every=40,
        )  # fmt: skip
        return np.asarray(path.q[:, 0])

    want, errors = angles(rigid), []
    bare = rb.load(text.format(more=""))
    for E in (1e9, 1e11, 1e13):
        section = rb.flexible.circle(RADIUS, E=E, nu=0.3, density=1e-3)
        beam = rb.flexible.beam(LENGTH, section, {"k_y": 2}, damping=1e-3)
        model = with_mass(bare.with_beam("tip", beam, "hub", frames={"middle": 0.5}), "tip")
        model = rb.contact.with_geom(model, "ball", "middle", "sphere", BALL, condim=1)
        errors.append(np.abs(angles(model) - want).max())
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 2e-4
    assert want[-1] == pytest.approx(np.arcsin((0.1 - BALL) / 0.5), abs=0.02)  # on the ball
