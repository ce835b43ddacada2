"""Lagrange's equations of the first kind: Andrews' mechanism as published, a sleigh, a pendulum."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc
from tests.oracles import load

LAWS = load("constraint_identities")
PENDULUM = LAWS["pendulum_kkt"]
ANDREWS = load("loops")["andrews"]
SLEIGH = load("nonholonomic")["chaplygin_sleigh"]


def solved(system: rc.LagrangeSystem, y, ts, args=None, **feedback):
    return diffrax.diffeqsolve(
        system.term(**feedback), diffrax.Dopri8(), 0.0, ts[-1], None, y, args,
        saveat=diffrax.SaveAt(ts=jnp.asarray(ts)), max_steps=20_000,
        stepsize_controller=diffrax.PIDController(rtol=1e-11, atol=1e-11),
    ).ys  # fmt: skip


# ------------------------------------------------------------------------ Andrews' mechanism


def andrews_mass(t, q, p):
    _, th, _, phi, _, om, _ = q
    e, f = p["e"] - p["ea"], p["zf"] - p["fa"]
    da, rr, zt, u, m2, m4, m6 = (p[k] for k in ("da", "rr", "zt", "u", "m2", "m4", "m6"))
    i4, i6 = p["i4"], p["i6"]
    m11 = p["m1"] * p["ra"] ** 2 + m2 * (rr**2 - 2 * da * rr * jnp.cos(th) + da**2)
    m55 = m4 * (zt**2 + 2 * zt * e * jnp.sin(phi) + e**2) + p["m5"] * (p["ta"] ** 2 + p["tb"] ** 2)
    m77 = m6 * (f**2 - 2 * u * f * jnp.sin(om) + u**2) + p["m7"] * (p["ua"] ** 2 + p["ub"] ** 2)
    entries = {
        (0, 0): m11 + p["i1"] + p["i2"],
        (0, 1): m2 * (da**2 - da * rr * jnp.cos(th)) + p["i2"],
        (1, 1): m2 * da**2 + p["i2"],
        (2, 2): p["m3"] * (p["sa"] ** 2 + p["sb"] ** 2) + p["i3"],
        (3, 3): m4 * e**2 + i4,
        (3, 4): m4 * (e**2 + zt * e * jnp.sin(phi)) + i4,
        (4, 4): m55 + i4 + p["i5"],
        (5, 5): m6 * f**2 + i6,
        (5, 6): m6 * (f**2 - u * f * jnp.sin(om)) + i6,
        (6, 6): m77 + i6 + p["i7"],
    }
    M = jnp.zeros((7, 7))
    for (i, j), x in entries.items():
        M = M.at[i, j].set(x).at[j, i].set(x)
    return M


def andrews_force(t, q, v, p):
    _, th, ga, phi, _, om, _ = q
    db, dth, _, dphi, dde, dom, dep = v
    e, f = p["e"] - p["ea"], p["zf"] - p["fa"]
    s, c = jnp.sin(ga), jnp.cos(ga)
    x = p["sd"] * c + p["sc"] * s + p["xb"] - p["xc"]
    y = p["sd"] * s - p["sc"] * c + p["yb"] - p["yc"]
    length = jnp.sqrt(x * x + y * y)
    pull = -p["c0"] * (length - p["l0"]) / length
    arm = p["m2"] * p["da"] * p["rr"] * jnp.sin(th)
    hub, rod = p["m4"] * p["zt"] * e * jnp.cos(phi), p["m6"] * p["u"] * f * jnp.cos(om)
    return jnp.stack([
        p["mom"] - arm * dth * (dth + 2 * db),
        arm * db**2,
        pull * (x * (p["sc"] * c - p["sd"] * s) + y * (p["sd"] * c + p["sc"] * s)),
        hub * dde**2,
        -hub * dphi * (dphi + 2 * dde),
        -rod * dep**2,
        rod * dom * (dom + 2 * dep),
    ])  # fmt: skip


def andrews_rows(t, q, p):
    be, th, ga, phi, de, om, ep = q
    x = p["rr"] * jnp.cos(be) - p["d"] * jnp.cos(be + th)
    y = p["rr"] * jnp.sin(be) - p["d"] * jnp.sin(be + th)
    return jnp.stack([
        x - p["ss"] * jnp.sin(ga) - p["xb"],
        y + p["ss"] * jnp.cos(ga) - p["yb"],
        x - p["e"] * jnp.sin(phi + de) - p["zt"] * jnp.cos(de) - p["xa"],
        y + p["e"] * jnp.cos(phi + de) - p["zt"] * jnp.sin(de) - p["ya"],
        x - p["zf"] * jnp.cos(om + ep) - p["u"] * jnp.sin(ep) - p["xa"],
        y - p["zf"] * jnp.sin(om + ep) + p["u"] * jnp.cos(ep) - p["ya"],
    ])  # fmt: skip


ANDREWS_SYSTEM = rc.LagrangeSystem(andrews_mass, andrews_force, andrews_rows)


def test_multipliers_of_andrews_mechanism() -> None:
    """At the states of the published solution; the test set's multipliers have the other sign."""
    solve = jax.jit(lambda q, v: ANDREWS_SYSTEM.solve(0.0, q, v, ANDREWS["parameters"]))
    for sample in ANDREWS["samples"].values():
        _, l = solve(jnp.array(sample["q"]), jnp.array(sample["v"]))
        np.testing.assert_allclose(-l, sample["lam"], rtol=1e-8)


@pytest.mark.slow
def test_motion_of_andrews_mechanism() -> None:
    samples = ANDREWS["samples"]
    y = jnp.array(ANDREWS["q0"]), jnp.zeros(7)
    q, v = solved(ANDREWS_SYSTEM, y, [*map(float, samples)], ANDREWS["parameters"])
    for i, want in enumerate(samples.values()):
        np.testing.assert_allclose(q[i], want["q"], rtol=1e-6)
        np.testing.assert_allclose(v[i], want["v"], rtol=1e-5)


# ------------------------------------------------------------------------ a blade


def sleigh() -> rc.LagrangeSystem:
    m, inertia, a = (SLEIGH["params"][k] for k in ("m", "I_com", "a"))
    return rc.LagrangeSystem.energies(
        lambda q, v: (m * (v[0] ** 2 + v[1] ** 2) + inertia * v[2] ** 2) / 2,
        pfaffian=lambda t, q: jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2]), -a + 0 * q[2]])[None],
    )


def test_chaplygin_sleigh() -> None:
    """Centre of mass, heading, speed and turning beside the closed form."""
    p, samples = SLEIGH["params"], SLEIGH["samples"]
    w, a = p["omega0"], p["a"]
    y = jnp.zeros(3), jnp.array([p["v0"], a * w, w])
    q, v = solved(sleigh(), y, [*map(float, samples)])
    for i, want in enumerate(samples.values()):
        np.testing.assert_allclose(q[i], [*want["com"], want["theta"]], rtol=0, atol=1e-8)
        heading = np.array([np.cos(q[i, 2]), np.sin(q[i, 2])])
        assert abs(heading @ v[i, :2] - want["v"]) < 1e-8
        assert abs(v[i, 2] - want["omega"]) < 1e-8


# ------------------------------------------------------------------------ a pendulum


def pendulum(copies: int = 1, **given) -> rc.LagrangeSystem:
    """args: mass, gravity, length. The row is said `copies` times."""
    return rc.LagrangeSystem.energies(
        lambda q, v, p: p[0] * (v @ v) / 2,
        lambda q, p: p[0] * p[1] * q[1],
        holonomic=lambda t, q, p: jnp.tile(q @ q - p[2] ** 2, copies),
        **given,
    )


NUMBERS = jnp.array([1.0, 9.81, 1.0])
STATE = jnp.array(PENDULUM["x"]), jnp.array(PENDULUM["v"])


def test_pendulum_and_redundant_rows() -> None:
    """Of rows that are said twice each has half the multiplier."""
    for copies in (1, 2):
        a, l = pendulum(copies).solve(0.0, *STATE, NUMBERS)
        np.testing.assert_allclose(a, PENDULUM["a"], rtol=0, atol=1e-12)
        np.testing.assert_allclose(l, np.array(PENDULUM["lam"]) / copies * np.ones(copies),
                                   rtol=0, atol=1e-10)  # fmt: skip


def test_a_mass_matrix_that_only_the_rows_make_regular() -> None:
    """No mass moves where x and y part, which x = y forbids."""
    system = rc.LagrangeSystem(
        lambda t, q: jnp.ones((2, 2)),
        lambda t, q, v: jnp.array([2.0, 0.0]),
        holonomic=lambda t, q: q[:1] - q[1:],
    )
    a, l = system.solve(0.0, jnp.zeros(2), jnp.zeros(2))
    np.testing.assert_allclose([*a, *l], [0.5, 0.5, -1.0], rtol=0, atol=1e-14)


def test_time_in_the_lagrangian_and_in_the_rows() -> None:
    """L = e^(3 t) v^2 / 2 is friction; a bead on a line that turns at w feels w^2 r."""
    free = rc.LagrangeSystem.lagrangian(
        lambda t, q, v: jnp.exp(3 * t) * (v @ v) / 2,
        lambda t, q, v: jnp.exp(3 * t) * jnp.array([0.0, 1.0]),
        pfaffian=lambda t, q: jnp.array([[0.0, 1.0]]),
        rate=lambda t, q: jnp.sin(t)[None],
    )
    a, l = free.solve(0.4, jnp.zeros(2), jnp.array([2.0, np.sin(0.4)]))
    np.testing.assert_allclose(a, [-6.0, np.cos(0.4)], rtol=1e-13)
    by_hand = np.exp(1.2) * (np.cos(0.4) + 3 * np.sin(0.4) - 1)
    np.testing.assert_allclose(l, [by_hand], rtol=1e-12)

    w, t, r, speed = 1.3, 0.7, 0.5, 0.2
    bead = rc.LagrangeSystem.energies(
        lambda q, v: v @ v / 2,
        holonomic=lambda t, q: (q[1] * jnp.cos(w * t) - q[0] * jnp.sin(w * t))[None],
    )
    e, n = np.array([np.cos(w * t), np.sin(w * t)]), np.array([-np.sin(w * t), np.cos(w * t)])
    a, l = bead.solve(t, r * e, speed * e + r * w * n)
    np.testing.assert_allclose(a @ e, 0.0, atol=1e-13)  # no force along the line
    np.testing.assert_allclose(a @ n, 2 * w * speed, rtol=1e-12)
    np.testing.assert_allclose(l, [2 * w * speed], rtol=1e-12)
    assert np.abs(bead.residual(t, r * e, speed * e + r * w * n)).max() < 1e-15


def test_states_are_put_on_the_constraints() -> None:
    system = pendulum(2)
    q, v = system.project(0.0, 1.1 * STATE[0], STATE[1] + 0.1, NUMBERS, iterations=5)
    assert np.abs(system.residual(0.0, q, v, NUMBERS)).max() < 1e-14
    np.testing.assert_allclose(q, STATE[0], atol=1e-14)


def test_derivatives() -> None:
    """Forward against differences, reverse against forward, by state and numbers, rows redundant;
    and through diffrax."""
    system, w = pendulum(2), jnp.array([0.3, -0.7])
    at = *STATE, NUMBERS
    along = jnp.array([0.3, -0.2]), jnp.array([1.0, 0.4]), jnp.array([0.2, 0.5, -0.1])

    def a(q, v, p):
        return system.solve(0.1, q, v, p, alpha=2.0, beta=3.0).acceleration

    _, slope = jax.jvp(a, at, along)
    h = 1e-5
    ends = [a(*(x + s * dx for x, dx in zip(at, along, strict=True))) for s in (h, -h)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * h), rtol=1e-7, atol=1e-7)
    pulled = jax.vjp(a, *at)[1](w)
    np.testing.assert_allclose(
        sum(x @ dx for x, dx in zip(pulled, along, strict=True)), w @ slope, rtol=1e-12
    )


@pytest.mark.slow
def test_gradient_through_diffrax() -> None:
    def height(gravity):
        p = NUMBERS.at[1].set(gravity)
        return solved(pendulum(), STATE, [0.3], p)[0][-1, 1]

    h = 1e-4
    quotient = (height(9.81 + h) - height(9.81 - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(height)(9.81), quotient, rtol=1e-6)


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: rc.LagrangeSystem(3, len), "mass=.*got int, expected a function"),
        (lambda: rc.LagrangeSystem(len, len), "got no constraint, expected holonomic="),
        (lambda: rc.LagrangeSystem(len, len, holonomic=len, rate=len), "a rate b without pfaffian"),
        (lambda: rc.LagrangeSystem(len, len, len, formulation=rc.Baumgarte()), "method on arrays"),
        (lambda: pendulum().solve(0.0, jnp.zeros(2), jnp.zeros(3), NUMBERS), "expected .n,. each"),
        (
            lambda: rc.LagrangeSystem.energies(
                lambda q, v: v, holonomic=lambda t, q: q[:1]
            ).solve(0.0, jnp.ones(2), jnp.ones(2)),
            r"L returned the shape \(2,\), expected \(\)",
        ),
        (
            lambda: rc.LagrangeSystem.energies(
                lambda q, v: v @ v, holonomic=lambda t, q: q @ q
            ).solve(0.0, jnp.ones(2), jnp.ones(2)),
            r"holonomic returned the shape \(\), expected \(m,\)",
        ),
        (
            lambda: rc.LagrangeSystem.energies(
                lambda q, v: v @ v, pfaffian=lambda t, q: q
            ).solve(0.0, jnp.ones(2), jnp.ones(2)),
            r"pfaffian returned the shape \(2,\), expected \(k, 2\)",
        ),
    ],
)  # fmt: skip
def test_wrong_inputs(make, words: str) -> None:
    with pytest.raises(rb.InputError, match=words):
        make()
