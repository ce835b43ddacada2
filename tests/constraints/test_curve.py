"""A point on a curve and on a surface: their rows, the nearest point, the motion of a bead."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc
from rbjax.constraints.equations.constrained_motion import constrained_motion
from tests.constraints.rows import check, tree

A = rc.Place.on(body="leg", point=[0.1, -0.2, 0.05], axis=[1.0, 0.4, 2.0])
B = rc.Place.on(body="hand", point=[0.05, 0.1, -0.1])
TABLE = jnp.linspace(-3.0, 3.0, 61)


def helix(s, numbers):
    radius, pitch = numbers
    return jnp.stack([radius * jnp.cos(s), radius * jnp.sin(s), pitch * s])


def torus(x, radii):
    """Of a ring in the plane of x and y."""
    return (jnp.sqrt(x[0] ** 2 + x[1] ** 2) - radii[0]) ** 2 + x[2] ** 2 - radii[1] ** 2


def test_rows():
    """Of both kinds, in one program."""
    surface = rc.PointOnSurface(A, B, torus, jnp.array([1.0, 0.2]))
    curve = rc.PointOnCurve(A, B, helix, TABLE, jnp.array([0.2, 0.3]))
    check(tree(floating=False).with_constraints(surface, curve), atol=5e-14)


def test_nearest_and_its_derivatives():
    """To third order, by x, where a circle says what they are; to first order by its numbers."""
    r = jnp.array([0.7, 0.0])
    on = rc.PointOnCurve(A, B, helix, TABLE, r)
    x = jnp.array([0.5, 0.8, 0.1])
    turn = lambda x: jnp.arctan2(x[1], x[0])  # noqa: E731
    dx = jnp.array([0.3, -0.2, 0.9])

    def line(f):
        """f along a line, and its first three derivatives."""
        ways = [lambda s: f(x + s * dx)]
        for _ in range(3):
            ways.append(jax.grad(ways[-1]))
        return jnp.stack([way(0.0) for way in ways])

    found = jax.jit(lambda: (line(on.nearest), line(turn)))()
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-13)

    @jax.jit
    def at(pitch):
        return rc.PointOnCurve(A, B, helix, TABLE, jnp.stack([r[0], pitch])).nearest(x)

    h = 1e-5
    np.testing.assert_allclose(jax.grad(at)(0.2), (at(0.2 + h) - at(0.2 - h)) / (2 * h), rtol=1e-8)


def test_points_of_equal_distance():
    """The first of the table's nearest decides, and both are nearest."""
    parabola = lambda s: jnp.stack([s, s * s, 0 * s])  # noqa: E731
    x = jnp.array([0.0, 2.0, 0.0])
    found = [float(rc.PointOnCurve(A, B, parabola, table).nearest(x)) for table in (TABLE, -TABLE)]
    np.testing.assert_allclose(found, [-np.sqrt(1.5), np.sqrt(1.5)], rtol=1e-14)


def bead() -> rb.Model:
    return rb.load("""<mujoco><worldbody><body name="bead"><joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 1 0"/><joint type="slide" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>""")


@pytest.mark.slow
def test_bead_on_a_wire():
    """A bead on a cycloid swings in 4 pi sqrt(r / g), from wherever it begins (Huygens)."""
    r, g = 0.25, 9.81

    def cycloid(s):
        return r * jnp.stack([s + jnp.sin(s), 0 * s, 1 - jnp.cos(s)])

    wire = rc.PointOnCurve(rc.Place.on(), rc.Place.on(body="bead"), cycloid, TABLE / 1.1)
    model = bead().with_constraints(wire)

    def rate(y):
        a, _ = constrained_motion(model, 0.0, rb.State(y[0], y[1]), jnp.zeros(3), {})
        return jnp.stack([y[1], a])

    dt = 4 * np.pi * np.sqrt(r / g) / 1000

    def step(_, y):
        k1 = rate(y)
        k2 = rate(y + dt / 2 * k1)
        k3 = rate(y + dt / 2 * k2)
        k4 = rate(y + dt * k3)
        return y + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    @jax.jit
    def half_and_whole(s):
        y = jnp.stack([cycloid(s), jnp.zeros(3)])
        half = jax.lax.fori_loop(0, 500, step, y)
        return y, half, jax.lax.fori_loop(500, 1000, step, half)

    for s in (0.4, 1.7):
        start, half, end = half_and_whole(s)
        np.testing.assert_allclose(half, start * jnp.array([-1.0, 1.0, 1.0]), rtol=0, atol=1e-8)
        np.testing.assert_allclose(end, start, rtol=0, atol=1e-8)


def test_motion_is_differentiated():
    """By the position and by the curve's numbers: this takes the third derivative of s(x)."""
    model, v = bead(), jnp.array([0.3, 0.1, -0.2])

    def moved(y):
        wire = rc.PointOnCurve(rc.Place.on(), rc.Place.on(body="bead"), helix, TABLE, y[3:])
        held = model.with_constraints(wire)
        return jnp.concatenate(
            constrained_motion(held, 0.0, rb.State(y[:3], v), jnp.zeros(3), {}, 1.0, 2.0)
        )

    y, h = jnp.array([0.4, 0.5, 0.1, 0.7, 0.2]), 1e-5
    run, slope = jax.jit(jax.vmap(moved)), jax.jit(jax.jacrev(moved))
    ends = run(y + h * jnp.concatenate([jnp.eye(5), -jnp.eye(5)]))
    want = (ends[:5] - ends[5:]).T / (2 * h)
    np.testing.assert_allclose(slope(y), want, rtol=0, atol=1e-8 * np.abs(want).max())


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: rc.PointOnCurve(A, B, None, TABLE), "c=...): got NoneType, expected a function"),
        (lambda: rc.PointOnCurve(A, B, helix, 0.0), "starts=...): got the shape (), expected (n,)"),
        (lambda: rc.PointOnSurface(A, B, torus, jnp.nan), "expected finite numbers"),
        (lambda: rc.PointOnSurface(A, B, lambda x: x), "f returned the shape (3,), expected ()"),
        (
            lambda: rc.PointOnCurve(A, B, lambda s: jnp.zeros(2), TABLE),
            "c returned the shape (2,), expected (3,)",
        ),
    ],
)
def test_refused(make, said):
    with pytest.raises(rb.InputError) as refused:
        model = tree().with_constraints(make())
        constrained_motion(model, 0.0, model.default_state(), jnp.zeros(model.nv), {})
    assert said in str(refused.value)
