"""Velocities after an impact, against closed forms and computed digits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.impacts.impulse_equations import (
    ImpulseProblem,
    _in_order,
    _sweeps,
    sweep_impulses,
)
from tests.contact.scenes import ball, kane_levinson, load, load_text, row

FREE = "<freejoint/>"


def energy(model, q, v):
    return float(rb.kinetic_energy(model, q, v))


@pytest.mark.parametrize(
    ("mu", "slip", "sticks"), [(0.3, 1.0, True), (0.1, 1.0, False), (0.3, 3.0, False)]
)
def test_the_oblique_impact_of_a_sphere(mu, slip, sticks):
    """It sticks if |v + r w| <= 3.5 mu (1 + e) |v_n|."""
    e, down, r = 0.5, 1.0, 0.1
    model = load(ball(r, r, FREE))
    v, spin = 0.6 * slip, 0.4 * slip / r
    state = model.default_state().replace(v=jnp.array([v, 0, -down, 0, -spin, 0]))
    before = np.array(state.v)
    found = rb.contact.impulse(model, state, restitution=e, friction=mu)
    linear, angular = np.array(found.v[:3]), np.array(found.v[3:])
    order = (0, 1)
    if abs(before[0] - v) > 1e-12:  # angular velocity first
        linear, angular, order = angular, linear, (1, 0)
    assert order in ((0, 1), (1, 0)) and found.success
    assert sticks == (slip <= 3.5 * mu * (1 + e) * down)
    if sticks:
        expected = v - 2 * slip / 7, spin - 5 * slip / (7 * r)
    else:
        lost = mu * (1 + e) * down
        expected = v - lost, spin - 5 / (2 * r) * lost
    np.testing.assert_allclose([linear[0], -angular[1]], expected, atol=1e-12)
    np.testing.assert_allclose(linear[2], e * down, atol=1e-12)


@pytest.mark.parametrize(
    ("law", "e", "ratio", "rates"),
    [
        ("newton", 0.5, 1.587495, (-0.33464893, 0.36311536)),
        ("energetic", 0.5, 0.525841, (-0.19260193, 0.20898534)),
        ("energetic", 1.0, 0.6662851, None),  # slip stops in restitution: below, by hand
    ],
)
def test_the_double_pendulum_of_kane_and_levinson(law, e, ratio, rates):
    """Newton's restitution creates energy if the slip reverses; energetic restitution does not."""
    model, state = kane_levinson()
    found = rb.contact.impulse(model, state, restitution=e, friction=0.7, law=law)
    assert found.success
    before, after = energy(model, state.q, state.v), energy(model, state.q, found.v)
    np.testing.assert_allclose(before, 0.023181410863, rtol=1e-9)
    np.testing.assert_allclose(after / before, ratio, atol=1e-6)
    if law == "energetic":
        # friction works until slip stops, and the normal force by (1 - e^2) of its compression
        xx, xz, zz = 2.4403380457, 1.5213086580, 1.0095602905
        slip, down, mu = -0.26717434, -0.13420201, 0.7
        friction = -mu * slip**2 / (2 * (xz + mu * xx))
        compression = -(down**2) / (2 * (zz + mu * xz))
        lost = friction + (1 - e**2) * compression
        np.testing.assert_allclose(after / before, 1 + lost / before, atol=1e-7)
    if rates:
        np.testing.assert_allclose(np.cumsum(found.v), rates, atol=1e-7)


def test_a_row_of_touching_balls():
    """All touch at once, elastic: Newton's law alone spreads the momentum, and keeps it."""
    model = load(row(3, gap=0.0), floor="")
    state = model.default_state().replace(v=jnp.array([1.0, 0.0, 0.0]))
    found = rb.contact.impulse(model, state, restitution=0.0, friction=0.0)
    np.testing.assert_allclose(found.v, 1 / 3, rtol=1e-12)
    apart = state.replace(v=jnp.array([-1.0, 0.0, 0.5]))  # separating contacts have no impulse
    found = rb.contact.impulse(model, apart, restitution=1.0, friction=0.0)
    np.testing.assert_allclose(found.v, apart.v, atol=1e-14)
    assert found.success and not found.impulses.any()


def test_derivatives_of_the_velocity_after_an_impact():
    model = load(ball(0.1, 0.1, FREE))
    state = model.default_state()
    v = jnp.array([0.7, 0.2, -1.0, 0.3, 1.0, -0.5])

    def after(v, e, mu):
        found = rb.contact.impulse(model, state.replace(v=v), restitution=e, friction=mu)
        return found.v

    for mu in (0.05, 0.9):
        push = jax.jvp(after, (v, 0.5, mu), (0.1 * v, 0.2, 0.3))[1]
        h = 1e-6
        near = [after(v + s * h * 0.1 * v, 0.5 + s * h * 0.2, mu + s * h * 0.3) for s in (1, -1)]
        np.testing.assert_allclose(push, (near[0] - near[1]) / (2 * h), atol=1e-8)
        w = jnp.arange(6.0)
        pull = jax.grad(lambda *x, w=w: w @ after(*x), (0, 1, 2))(v, 0.5, mu)
        np.testing.assert_allclose(
            pull[0] @ (0.1 * v) + 0.2 * pull[1] + 0.3 * pull[2], w @ push, rtol=1e-9
        )


def test_a_box_that_lands_on_four_corners():
    """The contacts are redundant: the velocity is unique, the impulses are not."""
    geom = '<geom type="box" size="0.2 0.1 0.05" mass="2"/>'
    model = load(f'<body pos="0 0 0.05">{FREE}{geom}</body>')
    state = model.default_state().replace(v=jnp.array([0.0, 0, -1, 0, 0, 0]))
    found = rb.contact.impulse(model, state, restitution=0.4, friction=0.5)
    np.testing.assert_allclose(found.v, [0, 0, 0.4, 0, 0, 0], atol=1e-10)
    np.testing.assert_allclose(found.impulses[:, 0].sum(), 2 * 1.4, rtol=1e-10)
    assert found.success
    oblique = state.replace(v=jnp.array([1.0, 0, -1, 0.3, 0, 2.0]))
    few = rb.contact.impulse(model, oblique, restitution=0.4, friction=0.5, sweeps=1)
    assert not few.success and few.residual > 1e-12


def test_batches_and_single_precision():
    model = load(ball())
    v = jnp.array([[-1.0], [-2.0], [3.0]])
    q = model.default_state().q
    found = jax.vmap(lambda v: rb.contact.impulse(model, rb.State(q, v), restitution=0.5).v)(v)
    np.testing.assert_allclose(found[:, 0], [0.5, 1.0, 3.0], rtol=1e-12)
    small = rb.State(jnp.asarray(q, jnp.float32), jnp.array([-2.0], jnp.float32))
    found = rb.contact.impulse(model, small, restitution=0.5)
    assert found.v.dtype == jnp.float32 and found.success
    np.testing.assert_allclose(found.v, [1.0], rtol=1e-5)


def test_bad_arguments():
    model = load(ball())
    state = model.default_state()
    for options, message in [
        ({"restitution": -0.1}, "restitution is -0.1"),
        ({"friction": -1.0}, "friction is -1.0"),
        ({"restitution": np.nan}, "restitution is nan"),
        ({"friction": np.inf, "law": "energetic"}, "friction is inf"),
        ({"law": "poisson"}, "poisson"),
        ({"restitution": [0.1, 0.2]}, r"restitution has shape \(2,\)"),
        ({"pairs": []}, "no two geoms"),
        ({"sweeps": 0}, "sweeps is 0"),
    ]:
        with pytest.raises(rb.RbjaxError, match=message):
            rb.contact.impulse(model, state, **options)
    with pytest.raises(rb.InputError, match="no two geoms"):
        rb.contact.impulse(rb.load("pendulum"), rb.load("pendulum").default_state())


@pytest.mark.parametrize(
    ("pair", "mu"), [('friction="0.1 0.1 0 0 0"', 0.1), ('condim="1"', 0.0), (None, 0.4)]
)
def test_the_friction_of_the_file(pair, mu):
    """An explicit pair has its own friction, or none if its condim is 1."""
    own = "" if pair is None else f'<pair geom1="ball" geom2="floor" {pair}/>'
    xml = f"""<mujoco><default><geom friction="0.4"/></default><worldbody>
        <geom name="floor" type="plane" size="0 0 1"/>
        <body pos="0 0 0.1"><freejoint/><geom name="ball" size="0.1" mass="1"/></body></worldbody>
        <contact>{own}</contact></mujoco>"""
    model = load_text(xml)
    state = model.default_state().replace(v=jnp.array([3.0, 0, -1.0, 0, 0, 0]))
    impulses = rb.contact.impulse(model, state).impulses
    np.testing.assert_allclose(np.linalg.norm(impulses[0, 1:]), mu * impulses[0, 0], atol=1e-12)
    np.testing.assert_allclose(rb.contact.MoreauContact.of(model).friction, mu, rtol=1e-15)
    compliant = rb.contact.CompliantContact.of(model, stiffness=1e4)
    np.testing.assert_allclose(compliant.friction, mu, rtol=1e-15)


def test_sweeps_visit_only_contacts_that_may_have_an_impulse():
    """Two contacts and a friction loss of nine candidates: impulses and both derivatives are those
    of sweeps over all, for finite and infinite friction."""
    rng = np.random.default_rng(0)
    n, nv = 9, 5
    J, L = rng.normal(size=(n, 3, nv)), rng.normal(size=(nv, nv))
    Y = (L @ L.T + np.eye(nv)) @ J.reshape(3 * n, nv).T
    active, dry = np.zeros(n, bool), np.zeros(n)
    active[[2, 7]], dry[4] = True, 0.3
    given = ImpulseProblem(
        jnp.asarray(J), jnp.asarray(Y), jnp.asarray(rng.normal(size=(n, 3)) - 1.0),
        jnp.zeros(n), jnp.full(n, 0.5).at[7].set(jnp.inf), jnp.asarray(active), jnp.asarray(dry),
    )  # fmt: skip
    order, length = _in_order(given.active | (given.dry > 0))
    assert order[:3].tolist() == [2, 4, 7] and int(length) == 3
    start = jnp.zeros((n, 3))
    found = {some: _sweeps(given, start, count=40, some=some) for some in (False, True)}
    np.testing.assert_allclose(found[True], found[False], atol=1e-12)
    p = sweep_impulses(given, start, 40)
    np.testing.assert_allclose(p, found[True], atol=1e-12)
    pushed = set(np.flatnonzero(np.abs(p).sum(1)).tolist())
    assert pushed <= {2, 4, 7} and len(pushed) > 1
    every = given.relative_velocity(p)
    np.testing.assert_allclose(given.D.reshape(3 * n, -1) @ p.ravel(), (every - given.u).ravel())

    def of(u):
        return sweep_impulses(given._replace(u=u), start, 40)[jnp.array([2, 4, 7])]

    forward, back = jax.jacfwd(of)(given.u), jax.jacrev(of)(given.u)
    np.testing.assert_allclose(forward, back, atol=1e-12)
    h, way = 1e-6, jnp.asarray(rng.normal(size=(n, 3)))
    change = (of(given.u + h * way) - of(given.u - h * way)) / (2 * h)
    np.testing.assert_allclose((forward * way).sum((-2, -1)), change, atol=1e-7)
