"""Moreau's time stepping, against closed forms of sliding, stacking and impacts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.contact.scenes import ball, load, row

G = 9.81
FREE = "<freejoint/>"


def box(height, size="0.05 0.05 0.05", mass=1.0):
    geom = f'<geom type="box" size="{size}" mass="{mass}"/>'
    return f'<body pos="0 0 {height}">{FREE}{geom}</body>'


def residuals(path):
    return path.memory[:, -1]


def test_a_bouncing_ball():
    model = load(ball(height=0.6))
    law = rb.contact.MoreauContact.of(model, restitution=0.5)
    heights = []
    for dt in (1e-3, 5e-4):
        path = rb.rollout(
            model, model.default_state(), None, dt, steps=round(0.48 / dt), dynamics=law
        )
        heights.append(float(path.q[-1, 0]))
    w = np.sqrt(2 * G * 0.5)
    tau = 0.48 - w / G
    exact = 0.5 * w * tau - G * tau**2 / 2 - 0.5
    assert abs(heights[1] - exact) < 2e-3 and abs(heights[0] - exact) < 4e-3


def test_a_sliding_box_stops_and_does_not_lift():
    """A cube at 6 m/s: s = v^2 / (2 mu g), without lift and without creep."""
    model, v, mu = load(box(0.05)), 6.0, 0.5
    law = rb.contact.MoreauContact.of(model, friction=mu)
    state = model.default_state().replace(v=jnp.array([v, 0, 0, 0, 0, 0.0]))
    errors = []
    for dt in (4e-3, 2e-3):
        path = rb.rollout(model, state, None, dt, steps=round(1.4 / dt), dynamics=law)
        errors.append(abs(float(path.q[-1, 0]) - v**2 / (2 * mu * G)))
        assert path.q[:, 2].max() < 0.05 + 1e-6 and residuals(path).max() < 1e-6
        np.testing.assert_allclose(path.v[-1], 0.0, atol=1e-9)
    assert max(errors) < 3e-6


def test_two_boxes_at_rest():
    model = load(box(0.05) + box(0.15))
    law = rb.contact.MoreauContact.of(model, friction=0.6)
    path = rb.rollout(model, model.default_state(), None, 2e-3, steps=500, dynamics=law)
    np.testing.assert_allclose(path.q[-1], path.q[0], atol=2e-6)  # in a second
    floor = path.memory[-1, :-1].reshape(-1, 3)
    count = [sum(1 for pair in law.pairs if 0 in pair) * 8]
    np.testing.assert_allclose(floor[: count[0], 0].sum() / 2e-3, 2 * G, rtol=0.05)


def test_a_row_of_balls_with_gaps():
    """The last ball leaves with the speed of the first; the others stand."""
    model = load(row(3), gravity=0.0, floor="")
    law = rb.contact.MoreauContact.of(model, restitution=1.0, friction=0.0)
    state = model.default_state().replace(v=jnp.array([1.0, 0, 0]))
    path = rb.rollout(model, state, None, 1e-3, steps=100, dynamics=law)
    np.testing.assert_allclose(path.v[-1], [0, 0, 1], atol=1e-12)


def test_a_constraint_holds_in_an_impact():
    """A pendulum of two links, whose tip is kept on a vertical line, strikes the floor."""
    model = load(
        '<body pos="0 0 1"><joint axis="0 1 0"/><geom type="capsule" size="0.02" mass="1" '
        'fromto="0 0 0 0.5 0 -0.3" contype="0" conaffinity="0"/>'
        '<body pos="0.5 0 -0.3"><joint axis="0 1 0"/><geom type="capsule" size="0.02" mass="1" '
        'fromto="0 0 0 -0.5 0 -0.3" contype="0" conaffinity="0"/>'
        '<geom type="sphere" size="0.1" mass="0.1" pos="-0.5 0 -0.3"/></body></body>'
    )
    rail = rb.constraints.Inplane.between(model, None, 1, point=[0, 0, 0.4], axis=[1, 0, 0])
    model = model.with_constraints(rail)
    law = rb.contact.MoreauContact.of(model, friction=0.0)
    path = rb.rollout(model, model.default_state(), None, 1e-3, steps=600, dynamics=law)
    q = path.q[-1]
    assert path.success and float(rb.contact.detect(model, q, reach=1.0).distance[0]) > -1e-4
    rate = rb.constraints.residual(model, path.state(-1)).rate
    np.testing.assert_allclose(rate, 0.0, atol=1e-3)


def test_derivatives_batches_and_single_precision():
    model = load(ball(height=0.6))
    law = rb.contact.MoreauContact.of(model, restitution=0.5)

    def height(v, law=law):
        state = rb.State(jnp.zeros(1), jnp.stack([v]))
        return rb.rollout(model, state, None, 1e-2, steps=40, dynamics=law).q[-1, 0]

    slope = jax.grad(height)(-1.0)
    np.testing.assert_allclose(jax.jvp(height, (-1.0,), (1.0,))[1], slope, rtol=1e-9)
    assert np.isfinite(slope)
    by_law = jax.grad(lambda law: height(-1.0, law))(law)
    assert by_law.restitution[0] > 0
    states = rb.State(jnp.zeros((2, 1), jnp.float32), jnp.array([[-1.0], [0.0]], jnp.float32))
    path = rb.rollout(model, states, None, 1e-2, steps=40, dynamics=law)
    assert path.q.dtype == jnp.float32 and path.success.all()
    np.testing.assert_allclose(path.q[0, -1, 0], height(-1.0), atol=1e-4)


def test_bad_arguments():
    model = load(ball())
    for options, message in [
        ({"restitution": -1.0}, "restitution"),
        ({"correction": 2.0}, "correction"),
        ({"rest_speed": -1.0}, "rest_speed"),
        ({"sweeps": 0}, "sweeps"),
        ({"pairs": [(0,)]}, "two geoms"),
    ]:
        with pytest.raises(rb.InputError, match=message):
            rb.contact.MoreauContact.of(model, **options)


def on_a_rail(joint, axis="0 0 1", others="", tendon=""):
    """A body of 2 kg that slides, in front of bodies that may touch."""
    geoms = '<geom type="plane" size="0 0 1"/>'
    body = (
        f'<body pos="0 0 1"><joint name="a" type="slide" axis="{axis}" {joint}/>'
        f'<geom size=".1" mass="2"/></body>'
    )
    return rb.load(f"<mujoco><worldbody>{geoms}{body}{others}</worldbody>{tendon}</mujoco>")


def test_a_limit_stops_without_rebound():
    """A fall of 0.5 m onto a lower limit: q = -g t^2 / 2, then rest, on any step."""
    model = on_a_rail('range="-.5 .2"')
    for dt in (1e-2, 7e-3):
        steps = round(0.5 / dt)
        path = rb.rollout(model, model.default_state(), None, dt, steps=steps, contact="impulse")
        t = dt * np.arange(steps + 1)
        np.testing.assert_allclose(path.q[:, 0], np.maximum(-G * t**2 / 2, -0.5), atol=1e-12)
        np.testing.assert_allclose(path.v[-1], 0.0, atol=1e-12)
        lower, upper = path.memory[-1, -7:-1].reshape(2, 3)
        np.testing.assert_allclose(lower, [2 * G * dt, 0, 0], atol=1e-10)
        np.testing.assert_allclose(upper, 0.0, atol=1e-12)


def test_friction_loss_brakes_and_holds():
    """v0^2 m / (2 f) from v0 to rest; a force below f does not move the body, above it does."""
    model, m, f = on_a_rail('frictionloss="3"', axis="1 0 0"), 2.0, 3.0
    state = model.default_state()

    def distance(v, push=0.0, steps=110):
        at = state.replace(v=v[None])
        tau = jnp.array([push])
        run = rb.rollout(model, at, None, 1e-2, tau=tau, steps=steps, contact="impulse")
        return run.q[-1, 0]

    x, slope = jax.value_and_grad(distance)(jnp.array(1.507))
    np.testing.assert_allclose(x, 1.507**2 * m / (2 * f), atol=1e-10)
    np.testing.assert_allclose(slope, 1.507 * m / f, atol=1e-10)
    assert abs(distance(jnp.array(0.0), 2.99)) < 1e-13
    np.testing.assert_allclose(distance(jnp.array(0.0), 5.0), (5 - f) / m * 1.1**2 / 2, atol=1e-10)


def test_limits_and_friction_loss_of_tendons_and_a_contact():
    """Two bodies on rails hang on a tendon of length a + b <= 0: one falls onto the floor, then the
    other one falls with the friction loss of the tendon and stops at the limit."""
    other = (
        '<body pos="1 0 2"><joint name="b" type="slide" axis="0 0 -1"/>'
        '<geom size=".1" mass="1"/></body>'
    )
    tendon = (
        '<tendon><fixed limited="true" range="-9 .3" frictionloss="2">'
        '<joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed></tendon>'
    )
    model = on_a_rail('range="-9 9"', others=other, tendon=tendon)
    path = rb.rollout(model, model.default_state(), None, 2e-3, steps=400, contact="impulse")
    a, b = path.q[:, 0], path.q[:, 1]
    assert (a + b).max() < 0.3 + 1e-9
    np.testing.assert_allclose(a[-1], -0.9, atol=1e-9)  # on the floor
    np.testing.assert_allclose(residuals(path).max(), 0.0, atol=1e-6)
    # both fall, a by -x and b by x, so the tendon moves at (rate of a) + (rate of b) = 0 and holds
    np.testing.assert_allclose((a + b)[:100], 0.0, atol=1e-9)


def test_the_limit_of_a_ball():
    body = (
        '<body pos="0 0 1"><joint type="ball" range="0 40"/>'
        '<geom type="box" size=".2 .3 .25" pos="0 0 -.3" mass="1"/></body>'
    )
    model = rb.load(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    state = model.default_state().replace(v=jnp.array([4.0, 1.0, 0.5]))
    path = rb.rollout(model, state, None, 2e-3, steps=200, contact="impulse")
    angle = 2 * np.arccos(np.clip(np.abs(path.q[:, 0]), 0, 1))
    assert np.degrees(angle).max() < 40 + 0.03  # the limit curves: h^2 over the correction
    assert np.degrees(angle).max() > 39.9


def test_a_model_without_rows_is_named():
    body = '<body pos="0 0 1"><joint type="slide"/><geom size=".1" mass="2"/></body>'
    model = rb.load(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    with pytest.raises(rb.InputError, match="no two geoms"):
        rb.contact.MoreauContact.of(model)


def test_friction_that_is_left_out_is_named():
    text = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>
      <body pos="0 0 0.1"><freejoint/><geom name="ball" size="0.1" condim="6"/></body>
    </worldbody></mujoco>"""
    model = rb.load(text)
    with pytest.warns(UserWarning, match="floor and ball have torsional"):
        rb.contact.MoreauContact.of(model)
    rb.contact.MoreauContact.of(model, friction=0.5)
