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
    assert path.ok and float(rb.contact.detect(model, q, reach=1.0).distance[0]) > -1e-4
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
    assert path.q.dtype == jnp.float32 and path.ok.all()
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
