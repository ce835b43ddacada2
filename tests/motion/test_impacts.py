"""Motions with rigid impacts, against closed forms, with the derivatives of bounces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import rbjax as rb
from rbjax.motion.impacts import FAILED, TOO_MANY
from tests.contact.scenes import ball, load, row

G = 9.81


def drop(h=0.5, v=0.0, T=0.6, model=None, e=0.6, g=None, **options):
    """The trajectory of a ball from a height h above the floor."""
    model = load(ball()) if model is None else model
    if g is not None:
        model = model.replace(gravity=jnp.stack([0.0, 0.0, -g]))
    state = rb.State(jnp.stack([jnp.asarray(h, float)]), jnp.stack([jnp.asarray(v, float)]))
    options = {"max_impacts": 2, "throw": False} | options
    return rb.simulate_impacts(model, state, jnp.array([0.0, T]), restitution=e, **options)


def test_the_derivatives_of_a_bounce():
    """z = e w tau - g tau^2 / 2 after one bounce from rest, by h, e and g."""
    h, e, T, model = 0.5, 0.6, 0.6, load(ball())

    def height(h, e, g):
        return drop(h, T=T, model=model, e=e, g=g).q[-1, 0]

    w = np.sqrt(2 * G * h)
    tau = T - w / G
    value, slopes = height(h, e, G), jax.jit(jax.jacfwd(height, (0, 1, 2)))(h, e, G)
    np.testing.assert_allclose(value, e * w * tau - G * tau**2 / 2, rtol=1e-12)
    by_g = e * tau * w / (2 * G) + e * w**2 / (2 * G**2) - tau**2 / 2 - tau * w / (2 * G)
    np.testing.assert_allclose(slopes, [(1 + e) * G * tau / w - e, w * tau, by_g], rtol=1e-10)


def test_the_derivatives_without_gravity():
    """(dz/dh, dz/dw, dz/de) = (-e, e T, w T - h), in reverse mode."""
    h, w, e, T, model = 0.3, 1.0, 0.6, 0.8, load(ball(), gravity=0.0)

    def height(h, w, e):
        return drop(h, -w, T, model, e).q[-1, 0]

    slopes = jax.jit(jax.grad(height, (0, 1, 2)))(h, w, e)
    np.testing.assert_allclose(slopes, [-e, e * T, w * T - h], rtol=1e-11)


def test_times_of_impact_and_their_accumulation():
    e, h = 0.5, 0.5
    w = np.sqrt(2 * G * h)
    zeno = np.sqrt(2 * h / G) * (1 + e) / (1 - e)
    path = drop(h, T=1.1 * zeno, e=e, max_impacts=12)
    gaps = 2 * e ** np.arange(1, 12) * w / G
    times = np.cumsum([w / G, *gaps])
    np.testing.assert_allclose(path.times, times, rtol=1e-12)
    assert path.status == TOO_MANY and path.count == 12 and np.isnan(path.q[-1]).all()
    assert path.times[-1] < zeno < path.times[-1] + 2 * gaps[-1]
    with pytest.raises(rb.InputError, match=r"more than 12 events .* rest_speed"):
        drop(h, T=1.1 * zeno, e=e, max_impacts=12, throw=True)
    rest = drop(h, T=1.1 * zeno, e=e, max_impacts=12, rest_speed=0.02)
    assert rest.success and rest.kept.all() and rest.count < 12
    np.testing.assert_allclose(rest.q[-1], 0.0, atol=1e-12)


def test_two_balls():
    """Equal balls exchange their velocities: x2 = v0 T + x1 + 2 r, gradient (1, 0, 1, 0)."""
    model = load(row(2, gap=0.32), gravity=0.0, floor="")

    def last(x):
        state = rb.State(x[:2], x[2:])
        path = rb.simulate_impacts(
            model, state, jnp.array([0.0, 1.0]), restitution=1.0, friction=0.0, max_impacts=2
        )
        return path.q[-1, 1]

    start = jnp.array([0.0, 0.0, 1.0, 0.0])
    value, slope = last(start), jax.jacfwd(last)(start)
    np.testing.assert_allclose(value + 0.52, 1.2, rtol=1e-13)
    np.testing.assert_allclose(slope, [1, 0, 1, 0], atol=1e-12)


def test_a_cradle_with_gaps():
    """The last of four balls has the gradient 1 by the first position and T by its velocity."""
    model = load(row(4, gap=0.05), gravity=0.0, floor="")

    def last(x):
        state = rb.State(x[:4], x[4:])
        path = rb.simulate_impacts(
            model, state, jnp.array([0.0, 0.5]), restitution=1.0, friction=0.0, max_impacts=4
        )
        return path.q[-1, 3], (path.v[-1], path.count)

    start = jnp.zeros(8).at[4].set(1.0)
    slope, (v, count) = jax.jacfwd(last, has_aux=True)(start)
    np.testing.assert_allclose(v, [0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(slope, [1, 0, 0, 0, 0.5, 0, 0, 0], atol=1e-11)
    assert count == 3


def test_a_ball_slides_until_it_rolls():
    """It rolls at t = 2 v0 / (7 mu g) with 5 v0 / 7, after 12 v0^2 / (49 mu g)."""
    joints = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
    model = load(ball(joint=joints + '<joint axis="0 1 0"/>'))
    mu, T, v0 = 0.2, 1.0, 2.0

    def end(v0, mu):
        state = rb.State(jnp.zeros(3), jnp.stack([v0, 0.0 * v0, 0.0 * v0]))
        path = rb.simulate_impacts(
            model, state, jnp.array([0.0, T]), friction=mu, max_impacts=3, throw=False
        )
        return path.q[-1, 0], path

    (by_speed, by_mu), path = jax.jit(jax.jacfwd(end, (0, 1), has_aux=True))(v0, mu)
    assert path.success and path.kept.all()
    np.testing.assert_allclose(path.times[0], 2 * v0 / (7 * mu * G), rtol=1e-9)
    np.testing.assert_allclose(path.v[-1], [5 * v0 / 7, 0, 5 * v0 / 0.7], atol=1e-9)
    x = 5 * v0 * T / 7 + 2 * v0**2 / (49 * mu * G)
    np.testing.assert_allclose(path.q[-1, 0], x, rtol=1e-9)
    np.testing.assert_allclose(by_speed, 5 * T / 7 + 4 * v0 / (49 * mu * G), rtol=1e-8)
    np.testing.assert_allclose(by_mu, -2 * v0**2 / (49 * mu**2 * G), rtol=1e-7)


SPOKES, SLOPE, RADIUS = 8, 0.08, 0.3
ALPHA = np.pi / SPOKES


def rimless_wheel():
    """A wheel of unit mass, 0.3 m radius of gyration, on eight spokes of 1 m, on a slope."""
    feet = "".join(
        f'<geom type="sphere" size="1e-12" mass="0" pos="{np.sin(a)} 0 {-np.cos(a)}"/>'
        for a in 2 * ALPHA * np.arange(SPOKES)
    )
    joints = (
        '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>'
    )
    J = RADIUS**2
    hub = f'<inertial pos="0 0 0" mass="1" diaginertia="{J} {J} {J}"/>'
    model = load(f"<body>{joints}{hub}{feet}</body>")
    return model.replace(gravity=jnp.array([G * np.sin(SLOPE), 0.0, -G * np.cos(SLOPE)]))


def stride(model, w, **options):
    """The motion from an impact to the next: on the front spoke, turning forwards at w."""
    v = jnp.stack([w * np.cos(ALPHA), w * np.sin(ALPHA), w])
    state = rb.State(jnp.array([0.0, np.cos(ALPHA) + 1e-12, ALPHA]), v)
    return rb.simulate_impacts(
        model, state, jnp.array([0.0, 1.3]), friction=jnp.inf, max_impacts=2, throw=False,
        tolerance=1e-12, **options,
    )  # fmt: skip


def test_the_rimless_wheel():
    """The limit cycle, its period and its eigenvalue eta^2, through the impact of a foot."""
    model, k2 = rimless_wheel(), RADIUS**2
    found = rb.stability.limit_cycle(lambda w: stride(model, w[0]).after.v[0, 2:], [1.2])
    eta = (k2 + np.cos(2 * ALPHA)) / (k2 + 1)
    drop = 4 * G / (1 + k2) * np.sin(ALPHA) * np.sin(SLOPE)
    w = eta * np.sqrt(drop / (1 - eta**2))
    np.testing.assert_allclose(found.state, [w], rtol=1e-9)
    np.testing.assert_allclose(found.eigenvalues, [eta**2], atol=1e-8)

    def rate(angle):  # energy: (1 + k^2) w^2 / 2 + g cos(angle)
        return np.sqrt(w**2 + 2 * G / (1 + k2) * (np.cos(SLOPE - ALPHA) - np.cos(angle)))

    period = quad(lambda x: 1 / rate(x), SLOPE - ALPHA, SLOPE + ALPHA, epsabs=1e-13)[0]
    path = stride(model, found.state[0])
    np.testing.assert_allclose(path.times[0], period, atol=1e-9)
    assert path.success and path.count == 1 and path.kept.sum() == 1


def test_single_precision_batches_and_failures():
    model = load(ball())
    states = rb.State(jnp.array([[0.5], [0.7]], jnp.float32), jnp.zeros((2, 1), jnp.float32))

    def last(state):
        path = rb.simulate_impacts(
            model, state, jnp.array([0.0, 0.6]), restitution=0.6, max_impacts=2, throw=False
        )
        return path.q[-1, 0], path.status

    z, status = jax.vmap(last)(states)
    w = np.sqrt(2 * G * np.array([0.5, 0.7]))
    tau = 0.6 - w / G
    assert z.dtype == jnp.float32 and not status.any()
    np.testing.assert_allclose(z, 0.6 * w * tau - G * tau**2 / 2, atol=1e-5)
    few = drop(max_steps=1)
    assert few.status == FAILED and np.isnan(few.q[-1]).all()
    with pytest.raises(rb.InputError, match="a phase failed"):
        drop(max_steps=1, throw=True)


def test_bad_arguments():
    for options, message in [
        ({"max_impacts": 0}, "max_impacts is 0"),
        ({"e": -0.5}, "restitution is -0.5"),
        ({"rest_speed": -1.0}, "rest_speed is -1"),
        ({"law": "poisson"}, "law is 'poisson'"),
        ({"tolerance": 0.0}, "tolerance is 0"),
        ({"T": -1.0}, "ts must increase"),
    ]:
        with pytest.raises(rb.InputError, match=message):
            drop(**options)
