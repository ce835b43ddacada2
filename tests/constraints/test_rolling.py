"""Rolling and sliding on a plane: rows by differentiation, motions against oracles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc
from rbjax.constraints.equations.constrained_motion import constrained_motion
from tests.constraints.rows import check, rows_at, tree
from tests.oracles import load

ORACLE = load("nonholonomic")
R = 0.3
PLANE = rc.Place.on(body="leg", point=[0.1, -0.2, 0.05], axis=[1.0, 0.4, 2.0])
WHEEL = rc.Place.on(body="hand", point=[0.05, 0.1, -0.1], axis=[0.3, 1.0, 0.2])


def test_rows():
    """Of a plane that moves with one body and a wheel on another; all kinds in one program."""
    wheels = rc.RollingDisc(PLANE, WHEEL, R), rc.RollingSphere(PLANE, WHEEL, R)
    check(tree(floating=False).with_constraints(*wheels, rc.KnifeEdge(PLANE, WHEEL)))


def contact(kind, R_wheel, c):
    """The lowest point in the world, for z upwards."""
    if kind is rc.RollingSphere:
        return c - R * jnp.array([0.0, 0.0, 1.0])
    x, y = R_wheel[2, 0], R_wheel[2, 1]  # heights of the disc's own axes
    return c - R * (R_wheel[:, 0] * x + R_wheel[:, 1] * y) / jnp.hypot(x, y)


@pytest.mark.parametrize("kind", [rc.RollingDisc, rc.RollingSphere])
def test_the_touching_point_stands_still(kind):
    """Height and slip of the lowest point of a free body, as kinematics has them."""
    model = free_disc(1.0, 1.0, 1.0).with_constraints(
        kind(rc.Place.on(point=[0, 0, 0.2]), rc.Place.on(body="disc"), R)
    )
    state = model.random_state(jax.random.key(0))

    @jax.jit
    def found():
        turn, at = rb.forward_kinematics(model, state.q)
        k = model.body("disc")
        p = contact(kind, turn[k], at[k])
        own = turn[k].T @ (p - at[k])

        def material(s):
            turn, at = rb.forward_kinematics(model, rb.integrate(model, state.q, s * state.v))
            return turn[k] @ own + at[k]

        _, u = jax.jvp(material, (0.0,), (1.0,))
        _, rows = rows_at(model, state.q, state.v)
        return p[2] - 0.2 - rows[0].value, u - jnp.stack([rows[i].rate for i in (1, 2, 0)])

    for off in found():
        np.testing.assert_allclose(off, 0.0, rtol=0, atol=1e-14)


def free_disc(m, across, along):
    return rb.load(f"""<mujoco><worldbody><body name="disc"><freejoint/>
      <inertial pos="0 0 0" mass="{m}" diaginertia="{across} {across} {along}"/>
      </body></worldbody></mujoco>""")


def rolled(model, state, dt, steps):
    """q, v after so many steps of the classical Runge-Kutta method."""

    def rate(y):
        q, v = y
        a, _ = constrained_motion(model, 0.0, rb.State(q, v), jnp.zeros(model.nv), {})
        _, dq = jax.jvp(lambda s: rb.integrate(model, q, s * v), (0.0,), (1.0,))
        return dq, a

    def step(_, y):
        on = lambda k, h: jax.tree.map(lambda y, k: y + h * k, y, k)  # noqa: E731

        def stage(carry, weights):  # a loop: the rate is compiled once
            k, total = carry
            ahead, share = weights
            k = rate(on(k, ahead * dt))
            return (k, jax.tree.map(lambda s, k: s + share * dt * k, total, k)), None

        tableau = jnp.array([[0.0, 0.5, 0.5, 1.0], [1 / 6, 1 / 3, 1 / 3, 1 / 6]]).T
        still = jax.tree.map(jnp.zeros_like, y)
        return jax.lax.scan(stage, (still, y), tableau)[0][1]

    return jax.lax.fori_loop(0, steps, step, (state.q, state.v))


def energy(model, q, v):
    return rb.kinetic_energy(model, q, v) + rb.potential_energy(model, q)


def test_chaplygin_sleigh():
    oracle = ORACLE["chaplygin_sleigh"]
    m, a, inertia = (oracle["params"][k] for k in ("m", "a", "I_com"))
    v0, w0 = oracle["params"]["v0"], oracle["params"]["omega0"]
    blade = rc.Place.on(body="sleigh", axis=[1.0, 0.0, 0.0])
    model = rb.load(f"""<mujoco><worldbody><body name="sleigh">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint axis="0 0 1"/>
      <inertial pos="{a} 0 0" mass="{m}" diaginertia="{inertia} {inertia} {inertia}"/>
      </body></worldbody></mujoco>""").with_constraints(rc.KnifeEdge(rc.Place.on(), blade))
    start = rb.State(jnp.array([-a, 0.0, 0.0]), jnp.array([v0, 0.0, w0]))
    run = jax.jit(lambda steps: rolled(model, start, 0.01, steps))
    for t, want in oracle["samples"].items():
        (x, y, theta), (vx, vy, w) = run(round(float(t) / 0.01))
        speed = vx * np.cos(theta) + vy * np.sin(theta)
        com = [x + a * np.cos(theta), y + a * np.sin(theta)]
        got = [speed, w, theta, x, y, *com]
        due = [want["v"], want["omega"], want["theta"], *want["blade"], *want["com"]]
        np.testing.assert_allclose(got, due, rtol=0, atol=1e-8)
        np.testing.assert_allclose(
            m * v0**2 + (inertia + m * a**2) * w0**2, m * speed**2 + (inertia + m * a**2) * w**2,
            rtol=0, atol=1e-8,
        )  # fmt: skip


def disc():
    p = ORACLE["rolling_disc"]["params"]
    rim = rc.RollingDisc(rc.Place.on(), rc.Place.on(body="disc"), p["r"])
    return free_disc(p["m"], p["It"], p["Ia"]).with_constraints(rim)


@jax.jit
def rolled_disc(start, dt, steps):
    return rolled(disc(), start, dt, steps)


def on_the_plane(turn, omega, com):
    """The state of the disc that rolls with this angular velocity in the world."""
    down = -np.array([0.0, 0.0, 1.0]) + turn[2, 2] * turn[:, 2]
    arm = ORACLE["rolling_disc"]["params"]["r"] * down / np.linalg.norm(down)
    v = [*-np.cross(omega, arm), *turn.T @ omega]
    q = [*com, *rb.rotations.quaternion.from_matrix(jnp.asarray(turn))]
    return rb.State(jnp.array(q), jnp.array(v))


@pytest.mark.slow
def test_rolling_disc():
    model, oracle = disc(), ORACLE["rolling_disc"]["generic"]
    turn = np.array(oracle["R0"]).reshape(3, 3)
    start = on_the_plane(turn, np.array(oracle["omega0"]), oracle["com0"])
    at, t0, dt = start, 0.0, 1e-3
    for t, want in oracle["samples"].items():
        q, v = rolled_disc(at, dt, round((float(t) - t0) / dt))
        at, t0 = rb.State(q, v), float(t)
        turn = np.asarray(rb.rotations.quaternion.to_matrix(q[3:]))
        got = [*q[:3], *turn[:, 2], *turn @ v[3:]]
        due = [*want["com"], *want["axis"], *want["omega"]]
        np.testing.assert_allclose(got, due, rtol=0, atol=1e-8)
        np.testing.assert_allclose(
            energy(model, q, v), energy(model, start.q, start.v), rtol=0, atol=1e-8
        )


@pytest.mark.slow
def test_steady_turn():
    """On a circle the disc keeps its lean, and comes back after a period."""
    steady = ORACLE["rolling_disc"]["steady"]
    lean = np.radians(steady["theta_deg"])
    c, s, r = np.cos(lean), np.sin(lean), ORACLE["rolling_disc"]["params"]["r"]
    turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    start = on_the_plane(turn, np.array(steady["omega0"]), [steady["radius"], 0.0, r * s])
    q, v = rolled_disc(start, steady["period"] / 3000, 3000)
    spun = rb.rotations.quaternion.to_matrix(q[3:])
    np.testing.assert_allclose(q[:3], start.q[:3], rtol=0, atol=1e-8)
    np.testing.assert_allclose(spun @ v[3:], steady["omega0"], rtol=0, atol=1e-8)
    np.testing.assert_allclose(spun[:, 2], turn[:, 2], rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("radius", "said"),
    [
        (0.0, "got 0.0, expected a number above zero"),
        (jnp.ones(2), "got the shape (2,), expected a number"),
        (jnp.inf, "expected finite numbers"),
    ],
)
def test_refused(radius, said):
    with pytest.raises(rb.InputError) as refused:
        rc.RollingSphere(PLANE, WHEEL, radius)
    assert said in str(refused.value)
