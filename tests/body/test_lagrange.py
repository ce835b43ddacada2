"""Lagrange's equations from energies: the textbooks' systems, double pendulum, our own arm."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.body import hamel_acceleration, lagrange, particles, virtual_work
from rbjax.body.lagrange import System
from rbjax.rotations import se3
from tests.oracles import load
from tests.tolerances import F64_ROUNDING, relative_error

RNG = np.random.default_rng(6)
G = 9.81


def test_cart_spring_damper_pair() -> None:
    """Cai, fig. 4.1: two masses one above the other, a spring and a damper between them.

    M1 x1'' + c (x1' - x0') + k (x1 - x0) - M1 g = F,  M0 x0'' - c (..) - k (..) - M0 g = -F
    """
    M0, M1, c, k, F = 3.0, 2.0, 0.7, 50.0, 4.0
    pair = System(
        lambda q, v: (M0 * v[0] ** 2 + M1 * v[1] ** 2) / 2,
        lambda q: k * (q[1] - q[0]) ** 2 / 2 - G * (M0 * q[0] + M1 * q[1]),
        lambda q, v: c * (v[1] - v[0]) ** 2 / 2,
    )
    (x0, x1), (v0, v1) = q, v = RNG.normal(size=(2, 2))
    got = jax.jit(lambda q, v, Q: lagrange.acceleration(pair, q, v, Q))(q, v, np.array([-F, F]))
    inner = c * (v1 - v0) + k * (x1 - x0)
    assert relative_error(got, [(-F + inner) / M0 + G, (F - inner) / M1 + G]) < F64_ROUNDING


def arm(m1, m2, d1=1.0, d2=1.0) -> System:
    """Point masses at the ends of two links, the first angle from the downward vertical."""

    def tips(q):
        a, b = q[0], q[0] + q[1]
        elbow = d1 * jnp.stack([jnp.sin(a), -jnp.cos(a)])
        return jnp.stack([elbow, elbow + d2 * jnp.stack([jnp.sin(b), -jnp.cos(b)])])

    masses = jnp.array([m1, m2])

    def kinetic(q, v):
        _, velocity = jax.jvp(tips, (q,), (v,))
        return (masses[:, None] * velocity**2).sum() / 2

    return System(kinetic, lambda q: G * (masses * tips(q)[:, 1]).sum())


def test_two_link_arm_as_in_the_table() -> None:
    """Cai, table 4.1, and the Coriolis and gravity terms next to it."""
    table = load("two_link_table41")

    @jax.jit
    def terms(m2, q, v):
        system = arm(2.0, m2)
        M, dM = jax.jvp(lambda q: lagrange.mass_matrix(system, q), (q,), (v,))
        C = lagrange.coriolis_matrix(system, q, v)
        left = lagrange.generalized_forces(system, q, v, jnp.zeros(2))
        return M, dM - 2 * C, C @ v, lagrange.gravity_forces(system, q), left

    for m2, degrees, *want in table["rows"]:
        q, v = np.array([0.4, np.deg2rad(degrees)]), RNG.normal(size=2)
        M, skew, Cv, g, left = terms(m2, q, v)
        locked, free = M[0, 0], M[0, 0] - M[0, 1] ** 2 / M[1, 1]
        assert relative_error([M[0, 0], M[0, 1], M[1, 1], locked, free], want) < F64_ROUNDING
        s = m2 * np.sin(q[1])  # D122 = -s, D211 = s, D112 + D121 = -2 s
        coriolis = [-s * v[1] ** 2 - 2 * s * v[0] * v[1], s * v[0] ** 2]
        assert relative_error(Cv, coriolis, floor=m2) < F64_ROUNDING  # zero at 180 degrees
        tip = m2 * G * np.sin(q.sum())
        assert (
            relative_error(g, [(2 + m2) * G * np.sin(q[0]) + tip, tip], floor=G * m2) < F64_ROUNDING
        )
        assert relative_error(skew, -skew.T, floor=m2) < F64_ROUNDING
        assert relative_error(left, Cv + g, floor=m2) < F64_ROUNDING


def test_two_link_arm_as_the_robot_dynamics_have_it() -> None:
    """The same arm as a model, by the articulated-body algorithm, with a force at its tip."""
    model = rb.load("""<mujoco><option gravity="0 0 -9.81"/><compiler angle="radian"/><worldbody>
      <body><joint type="hinge" axis="0 -1 0"/>
        <inertial pos="0 0 -1" mass="2" diaginertia="1e-12 1e-12 1e-12"/>
        <body name="forearm" pos="0 0 -1"><joint type="hinge" axis="0 -1 0"/>
          <inertial pos="0 0 -1" mass="3" diaginertia="1e-12 1e-12 1e-12"/></body></body>
    </worldbody></mujoco>""")
    system, (q, v, tau) = arm(2.0, 3.0), RNG.normal(size=(3, 2))

    def tip(q):
        a, b = q[0], q[0] + q[1]
        return jnp.stack([jnp.sin(a) + jnp.sin(b), 0.0 * a, -jnp.cos(a) - jnp.cos(b)])

    f = np.array([1.5, 0.0, -0.5])
    work = jax.jit(lambda q: virtual_work.of_forces(tip, f, q))(q)
    J = rb.jacobian(model, q, "forearm", point=np.array([0.0, 0.0, -1.0]))
    assert relative_error(work, J[3:].T @ f) < 1e-13
    got = jax.jit(lambda q, v, Q: lagrange.acceleration(system, q, v, Q))(q, v, tau + work)
    want = rb.forward_dynamics(model, q, v, tau + work)
    assert relative_error(got, want) < 1e-10  # the model's links have a little inertia of their own
    M = jax.jit(lambda q: lagrange.mass_matrix(system, q))(q)
    assert relative_error(M, rb.mass_matrix(model, q)) < 1e-11

    # and the wrench of that force, on the moving tip's frame
    def pose(q):
        turn = se3.exp(-(q[0] + q[1]) * jnp.array([0.0, 1, 0, 0, 0, 0]))
        return turn.at[:3, 3].set(tip(q))

    R = np.asarray(pose(q))[:3, :3]
    by_wrench = jax.jit(lambda q: virtual_work.of_wrench(pose, np.r_[0, 0, 0, R.T @ f], q))(q)
    assert relative_error(by_wrench, work) < 1e-13


# ------------------------------------------------------------------- double pendulum


def tips(q):
    first = jnp.stack([jnp.sin(q[0]), -jnp.cos(q[0])])
    return jnp.stack([first, first + jnp.stack([jnp.sin(q[1]), -jnp.cos(q[1])])])


WEIGHTS = np.array([[0.0, -G], [0.0, -G]])


def rods(t, x):
    return jnp.stack([(x[0] ** 2).sum() - 1, ((x[1] - x[0]) ** 2).sum() - 1]) / 2


def by_energies(t, y, args):
    def kinetic(q, v):
        _, velocity = jax.jvp(tips, (q,), (v,))
        return (velocity**2).sum() / 2

    system = System(kinetic, lambda q: G * tips(q)[:, 1].sum())
    return lagrange.term(system).vf(t, y, None)


def by_virtual_work(t, y, args):
    q, v = y
    points = lambda t, q: tips(q)  # noqa: E731
    return v, particles.reduced_acceleration(jnp.ones(2), points, WEIGHTS, q, v)


def by_hamel(t, y, args):
    """Quasi-velocities: the rates of the first angle and of the angle between the two."""
    q, nu = y
    to = jnp.array([[1.0, 0.0], [-1.0, 1.0]])
    back = jnp.array([[1.0, 0.0], [1.0, 1.0]])

    def kinetic(q, nu):
        _, velocity = jax.jvp(tips, (q,), (back @ nu,))
        return (velocity**2).sum() / 2

    slope = jax.grad(lambda q: G * tips(q)[:, 1].sum())(q)
    nud = hamel_acceleration(
        kinetic, lambda q, v: to @ v, lambda q, nu: back @ nu, q, nu, -back.T @ slope
    )
    return back @ nu, nud


by_multipliers = particles.term(jnp.ones(2), lambda t, x, v: WEIGHTS, rods).vf


@functools.partial(jax.jit, static_argnums=0)
def swing(rate, y, ts):
    return diffrax.diffeqsolve(
        diffrax.ODETerm(rate), diffrax.Dopri8(), ts[0], ts[-1], None, y,
        saveat=diffrax.SaveAt(ts=ts), max_steps=100_000, adjoint=diffrax.ForwardMode(),
        stepsize_controller=diffrax.ClipStepSizeController(
            diffrax.PIDController(rtol=1e-14, atol=1e-14), step_ts=ts
        ),
    ).ys  # fmt: skip


@pytest.mark.parametrize("start", ["horizontal_rest", "generic"])
@pytest.mark.parametrize("how", [by_energies, by_virtual_work, by_hamel, by_multipliers])
def test_double_pendulum(how, start: str) -> None:
    case = load("double_pendulum")["samples"][f"point/{start}"]
    samples = {t: s for t, s in case["samples"].items() if float(t) <= 5}
    ts = np.array([0.0, *map(float, samples)])
    q, v = np.array(case["theta0"]), np.array(case["omega0"])
    y = (q, v)
    if how is by_multipliers:
        y = jax.jvp(tips, (q,), (v,))
    elif how is by_hamel:
        y = (q, np.array([v[0], v[1] - v[0]]))
    got = swing(how, y, ts)
    for k, (t, sample) in enumerate(samples.items(), 1):
        want = np.array([sample["theta"], sample["omega"]], float)
        tolerance = 1e-10 if float(t) <= 3 else 1e-8
        if how is by_hamel:
            want[1, 1] -= want[1, 0]
        if how is by_multipliers:
            want = jax.jvp(tips, (want[0],), (want[1],))
        for a, b in zip(got, want, strict=True):
            assert np.abs(a[k] - b).max() <= tolerance, t
    if how is by_multipliers:  # nothing corrects the drift; at these tolerances there is none
        drift = particles.constraint_error(rods, 0.0, got[0][-1], got[1][-1])
        assert np.abs(drift).max() < 1e-11


def test_gyroscopic_and_rheonomic_energies() -> None:
    """A charge in a magnetic field: T linear in q' as well, circles at the cyclotron frequency."""
    B = 3.0
    charge = System(lambda q, v: v @ v / 2 + B / 2 * (q[0] * v[1] - q[1] * v[0]))
    q, v = RNG.normal(size=(2, 2))
    got = jax.jit(lambda q, v: lagrange.acceleration(charge, q, v))(q, v)
    assert relative_error(got, B * np.array([v[1], -v[0]])) < F64_ROUNDING
    energy = jax.jit(lambda q, v: lagrange.energy(charge, q, v))(q, v)
    assert relative_error(energy, v @ v / 2) < F64_ROUNDING


def test_christoffel_symbols_of_the_sphere() -> None:
    """In (latitude angle from the pole, longitude): Gamma_1,22 = -sin cos, Gamma_2,12 = sin cos."""
    sphere = System(lambda q, v: (v[0] ** 2 + jnp.sin(q[0]) ** 2 * v[1] ** 2) / 2)
    got = jax.jit(lambda q: lagrange.christoffel_symbols(sphere, q))(np.array([0.8, 0.3]))
    sc = np.sin(0.8) * np.cos(0.8)
    want = [[[0, 0], [0, -sc]], [[0, sc], [sc, 0]]]
    assert relative_error(got, want) < F64_ROUNDING


def test_a_bead_on_a_turning_hoop() -> None:
    """A moving constraint: D'Alembert with multipliers, in one coordinate, and by hand."""
    w, t, q, qd = 1.3, 0.4, np.array([0.7]), np.array([-0.6])
    mass, weight = np.array([2.0]), np.array([[0.0, 0.0, -2 * G]])

    def bead(t, q):
        c, s = jnp.cos(q[0]), jnp.sin(q[0])
        return jnp.stack([s * jnp.cos(w * t), s * jnp.sin(w * t), -c])[None]

    def hoop(t, x):
        return jnp.stack(
            [(x[0] ** 2).sum() - 1, x[0, 1] * jnp.cos(w * t) - x[0, 0] * jnp.sin(w * t)]
        )

    @jax.jit
    def both():
        qdd = particles.reduced_acceleration(mass, bead, weight, q, qd, t)
        x, v = jax.jvp(bead, (t, q), (1.0, qd))
        forced = particles.constrained_acceleration(mass, x, v, weight, hoop, t)

        def rate(t, q):
            return jax.jvp(bead, (t, q), (1.0, qd))[1]

        swept = jax.jvp(rate, (t, q), (1.0, qd))[1] + jax.jacobian(bead, 1)(t, q) @ qdd
        return qdd, forced.acceleration, swept, particles.constraint_error(hoop, t, x, v)

    qdd, forced, swept, off = both()
    want = (w**2 * np.cos(q) - G) * np.sin(q)
    assert relative_error(qdd, want) < 1e-13
    assert relative_error(forced, swept) < 1e-13
    assert np.abs(off).max() < 1e-15


def test_reactions_do_no_work_and_repeat_constraints_are_flagged() -> None:
    x, v = RNG.normal(size=(2, 3, 3))
    masses, forces = RNG.uniform(1, 2, 3), RNG.normal(size=(3, 3))

    def triangle(t, x):
        d = jnp.stack([x[0] - x[1], x[1] - x[2], x[2] - x[0]])
        return (d**2).sum(-1) / 2 - 1

    run = jax.jit(lambda c, *a: particles.constrained_acceleration(*a, c), static_argnums=0)
    moved = run(triangle, masses, x, v, forces)
    rigid = np.cross(np.array([1.0, -2, 0.5]), x) + np.array([0.3, 0.2, 0.1])  # allowed
    assert abs((np.asarray(moved.reactions) * rigid).sum()) < 1e-12
    assert relative_error(np.asarray(moved.reactions).sum(0), np.zeros(3)) < 1e-10
    assert moved.margin > 1e-4

    def twice(t, x):
        return jnp.concatenate([triangle(t, x), triangle(t, x)])

    assert run(twice, masses, x, v, forces).margin < 1e-14  # in traced code a value
    with pytest.raises(rb.InputError, match=r"6 constraints depend on each other"):
        particles.constrained_acceleration(masses, x, v, forces, twice)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda s: lagrange.mass_matrix(s, np.zeros((2, 2))), ["(2, 2)", "jax.vmap"]),
        (lambda s: lagrange.acceleration(s, np.zeros(2), np.zeros(3)), ["v has shape (3,)"]),
        (
            lambda s: lagrange.gravity_forces(System(s.kinetic, lambda q: q), np.zeros(2)),
            ["expected a scalar"],
        ),
        (lambda s: virtual_work.of_forces(lambda q: q, np.zeros(3), np.zeros(2)), ["(3,)", "(2,)"]),
        (lambda s: virtual_work.of_wrench(lambda q: q, np.zeros(6), np.zeros(2)), ["(4, 4)"]),
        (
            lambda s: particles.constrained_acceleration(
                np.ones(2), np.ones((3, 3)), np.ones((3, 3)), np.ones((3, 3)), rods
            ),
            ["masses (2,)", "(n, d)"],
        ),
    ],
    ids=range(6),
)
def test_wrong_arguments_are_refused_in_a_sentence(call, words) -> None:
    with pytest.raises(rb.InputError) as caught:
        call(System(lambda q, v: v @ v))
    for word in words:
        assert word in str(caught.value)


def test_an_integer_state_is_one_of_floats() -> None:
    assert lagrange.acceleration(
        System(lambda q, v: v @ v / 2, lambda q: q @ q), [1, 2], [0, 0]
    ).tolist() == [-2, -4]
