"""Tendons along beams, against closed forms, lengths of curves in space, and virtual work."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rbjax as rb
from rbjax.errors import InputError, UnknownName
from rbjax.forces.context import Context

EI, EA, LENGTH = 5.0, 800.0, 1.3


def rod(degrees, **given) -> rb.Model:
    beam = rb.flexible.beam(LENGTH, [3.0, EI, EI, EA, EA, EA], degrees, mass=0.4, **given)
    return rb.load('<mujoco><option gravity="0 0 0"/></mujoco>').with_beam("rod", beam)


def context(model, q, v=None):
    return Context.of(model, 0.0, rb.State(q, 0 * q if v is None else v), None)


def balance(model, tendon, q):
    """The generalized forces of elasticity and tendon at rest."""
    return rb.applied_forces(model.with_forces(tendon), rb.State(q, 0 * q))


def test_a_parallel_tendon_bends_a_cantilever_to_an_arc() -> None:
    """The moment T d is constant along the beam: k = T d / EI, and the axial strain is -T / EA.
    dk/dT and dk/dd follow from K dq = dtau."""
    model, T, d = rod({"k_z": 2, "e_x": 1}), 40.0, 0.05
    q = jnp.array([T * d / EI, 0.0, 0.0, -T / EA, 0.0])
    tendon = rb.flexible.BeamTendon.of(model, "rod", [d, 0.0], tension=T)
    np.testing.assert_allclose(balance(model, tendon, q), 0.0, atol=1e-13)
    by_tension = jax.jacfwd(lambda T: balance(model, tendon.replace(tension=T), q))(tendon.tension)
    np.testing.assert_allclose(by_tension[0] / (EI * LENGTH), d / EI, rtol=1e-13)

    def with_offset(d):
        path = tendon.path.replace(offset=tendon.path.offset.at[:, 0].set(d))
        return balance(model, tendon.replace(path=path), q)

    np.testing.assert_allclose(jax.jacfwd(with_offset)(d)[0] / (EI * LENGTH), T / EI, rtol=1e-13)


def test_a_short_tendon_bends_only_the_part_that_it_spans() -> None:
    """The force on P_j is T d int P_j ds: (b - a) L of P_0, (b^2 - b - a^2 + a) L of P_1."""
    model, T, d, a, b = rod({"k_z": 1}), 7.0, 0.03, 0.2, 0.7
    tendon = rb.flexible.BeamTendon.of(model, "rod", [d, 0.0], tension=T, start=a, end=b)
    want = T * d * LENGTH * np.array([b - a, b * b - b - a * a + a])
    np.testing.assert_allclose(balance(model, tendon, jnp.zeros(2)), want, rtol=1e-13)


def helix(x):
    """A path that winds around the line by half a turn, wider towards the tip."""
    return (0.02 + 0.03 * x) * jnp.stack([jnp.cos(np.pi * x), jnp.sin(np.pi * x)])


DEGREES = {"k_x": 1, "k_y": 2, "k_z": 2, "e_x": 1, "g_y": 0}
Q = jnp.array([0.7, -0.4, 1.1, 0.5, -0.3, -0.8, 0.6, 0.2, 0.05, -0.02, 0.03])


def length_in_space(model, path) -> float:
    """The length of the tendon from its points in space: integrated poses, then chords whose
    lengths are extrapolated."""
    kind = model.topology.joints[0]
    given = kind.named(np.asarray(model.joints.params).tolist())

    def rate(s, g):
        x = s / LENGTH
        P = np.polynomial.legendre.legvander([2 * x - 1], 2)[0]
        k, gamma = ([float(y) for y in z] for z in kind.strain(np.asarray(Q).tolist(), given, P))
        R = g[:9].reshape(3, 3)
        W = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
        return np.concatenate([(R @ W).ravel(), R @ gamma])

    def chords(n):
        s = np.linspace(0, LENGTH, n + 1)
        g = solve_ivp(rate, (0, LENGTH), [*np.eye(3).ravel(), 0, 0, 0], "DOP853", s, rtol=1e-12,
                      atol=1e-13).y.T  # fmt: skip
        place = np.array([[0.0, *path(x)] for x in s / LENGTH])
        points = g[:, 9:] + np.einsum("nij,nj->ni", g[:, :9].reshape(-1, 3, 3), place)
        return np.linalg.norm(np.diff(points, axis=0), axis=1).sum()

    return (4 * chords(400) - chords(200)) / 3


def test_length_of_a_winding_tendon_and_its_moment_arms() -> None:
    """The chord error after extrapolation is of order 4, below 1e-9 at 400 chords."""
    model = rod(DEGREES, natural={"k_z": [0.3, 0.1]})
    path = rb.flexible.BeamPath.of(model, "rod", helix, points=14)
    reach = path.reach(context(model, Q))
    np.testing.assert_allclose(reach.length, length_in_space(model, helix), rtol=1e-9)
    arms = jax.grad(lambda q: path.reach(context(model, q)).length)(Q)
    got = np.array([reach.arms[n] for n in range(model.nv)])
    np.testing.assert_allclose(got, arms, rtol=1e-12, atol=1e-14)


def test_legendre_coefficients_are_the_same_path_as_a_function() -> None:
    model = rod({"k_y": 1, "k_z": 1})
    a = rb.flexible.BeamPath.of(model, "rod", [[0.02, 0.01], [0.005, 0.0], [0.0, 0.004]])
    straight = lambda x: jnp.stack(  # noqa: E731
        [0.02 + 0.005 * (2 * x - 1), 0.01 + 0.004 * (6 * x * x - 6 * x + 1)]
    )
    b = rb.flexible.BeamPath.of(model, "rod", straight)
    for name in ("offset", "slope"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-12, atol=1e-15)


def test_energy_spring_and_damper() -> None:
    """tau = -dU/dq without damping; the damper takes power; a slack spring is no force."""
    model = rod({"k_y": 1, "k_z": 1, "e_x": 0})
    q, v = jnp.array([0.3, 0.1, -0.8, 0.2, 0.06]), jnp.array([0.1, -0.2, -0.4, 0.3, 0.5])
    own = {"tension": 2.0, "stiffness": 300.0, "rest_length": LENGTH}
    tendon = rb.flexible.BeamTendon.of(model, "rod", [0.04, -0.02], **own)
    bare = balance(model, tendon.replace(tension=0 * q[0], stiffness=0 * q[0]), q)
    want = -jax.grad(lambda q: tendon.energy(context(model, q)))(q)
    np.testing.assert_allclose(balance(model, tendon, q) - bare, want, rtol=1e-11, atol=1e-13)
    damped = rb.flexible.BeamTendon.of(model, "rod", [0.04, -0.02], damping=5.0, **own)
    (slope,) = damped.slopes(context(model, q, v))
    tau = [sum(x.loads(context(model, q, v)).tau[n] * v[n] for n in range(5))
           for x in (damped, tendon)]  # fmt: skip
    speed = sum(slope.arms[n] * v[n] for n in range(5))
    np.testing.assert_allclose(tau[0] - tau[1], -5.0 * speed**2, rtol=1e-12)
    slack = rb.flexible.BeamTendon.of(model, "rod", [0.04, 0.0], stiffness=300.0, rest_length=2.0)
    np.testing.assert_array_equal(balance(model, slack, q), bare)


def test_a_tension_by_the_jacobian_is_the_tendon() -> None:
    model = rod({"k_z": 1})
    tendon = rb.flexible.BeamTendon.of(model, "rod", [0.1, 0.0], tension=3.0)
    state = rb.State(jnp.array([0.4, -0.2]), jnp.zeros(2))
    tau = -3.0 * tendon.path.jacobian(model, state.q)
    want = rb.acceleration(model.with_forces(tendon), state)
    np.testing.assert_allclose(rb.acceleration(model, state, tau=tau), want, rtol=1e-12)


def test_wrong_tendons() -> None:
    model = rod({"k_z": 1})
    of = rb.flexible.BeamTendon.of
    with pytest.raises(UnknownName):
        of(model, "rope", [0.1, 0.0])
    with pytest.raises(InputError, match="expected \\(2,\\), y and z"):
        of(model, "rod", [0.1, 0.0, 0.0])
    with pytest.raises(InputError, match="returns the shape"):
        of(model, "rod", lambda x: x)
    with pytest.raises(InputError, match="0 <= start < end <= 1"):
        of(model, "rod", [0.1, 0.0], start=0.6, end=0.5)
    with pytest.raises(InputError, match="tension is -1"):
        of(model, "rod", [0.1, 0.0], tension=-1.0)
    with pytest.raises(InputError, match="expected a beam"):
        of(rb.load("pendulum"), rb.load("pendulum").joint_names[0], [0.1, 0.0])
