"""Tyre laws against the curves of the textbooks, and what every law must be."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.wheeled import Coulomb, Fiala, LinearTyre, Pacejka, TMeasy
from tests.tolerances import F64_ROUNDING
from tests.wheeled.laws import EVERY, LAWS, limits, numbers, slopes_agree

ALIKE = {n: law for n, law in LAWS.items() if all(np.ndim(x) == 0 for x in jax.tree.leaves(law))}
S = np.concatenate([[0.0], np.geomspace(1e-9, 1e4, 300), [0.1, 0.2, 0.25, 0.4]])


def pure(law, s, axis=0):
    """The force against a slip along one axis."""
    s = jnp.asarray(s)
    pair = (s, jnp.zeros_like(s))
    return -np.asarray(law.traction(*(pair if axis == 0 else pair[::-1]))[axis])


def close(got, want):
    np.testing.assert_allclose(got, want, rtol=F64_ROUNDING, atol=1e-15)


def test_linear_and_coulomb():
    close(pure(LAWS["linear, two"], S, 1), 9.0 * S)
    close(pure(LAWS["saturated, two"], S, 1), 9 * S / np.sqrt(1 + (9 * S / 0.7) ** 2))
    close(pure(LAWS["coulomb, two"], S), 0.8 * S / np.hypot(S, 0.02))
    # the force of friction itself, of any direction, where nothing is smoothed
    x, y = Coulomb(0.7, 1e-9).traction(*(jnp.asarray(v) for v in (-3.0, 4.0)))
    np.testing.assert_allclose([x, y], [0.42, -0.56], rtol=1e-15)


def test_fiala():
    """Pacejka's eq. 3.7 and 3.10, with his theta = c / (3 mu): 3 mu theta s (...), and mu."""
    for axis, (c, mu) in enumerate([(12.0, 0.8), (9.0, 0.7)]):
        y = c / (3 * mu) * S
        want = np.where(y < 1, 3 * mu * y * (1 - y + y * y / 3), mu)
        close(pure(LAWS["fiala, two"], S, axis), want)


def test_magic_formula():
    for axis, (B, C, D, E) in enumerate([(10, 1.65, 1.0, 0.6), (8, 1.3, 0.9, -0.5)]):
        x = B * S
        want = D * np.sin(C * np.arctan(x - E * (x - np.arctan(x))))
        np.testing.assert_allclose(
            pure(LAWS["pacejka, two"], S, axis), want, rtol=1e-12, atol=1e-15
        )
        np.testing.assert_allclose(
            pure(LAWS["pacejka, two"], 1e12, axis), D * np.sin(C * np.pi / 2), rtol=1e-9
        )
    # without curvature the peak is at tan(pi / 2C) / B
    plain = Pacejka(10.0, 1.6, 1.1)
    peak = np.tan(np.pi / 3.2) / 10
    np.testing.assert_allclose(pure(plain, peak), 1.1, rtol=1e-15)
    assert abs(jax.grad(lambda s: plain.traction(s, 0.0)[0])(peak)) < 1e-13


def test_where_the_magic_formula_becomes_its_series():
    """The value and two derivatives go on, within rounding and what they change by themselves."""
    law = LAWS["pacejka, two"]
    s = jnp.sqrt(jnp.sqrt(jnp.finfo(float).eps)) / 10 * jnp.array([1 - 1e-9, 1 + 1e-9])

    def f(s):
        return law.traction(s, 0.0)[0]

    @jax.jit
    @jax.vmap
    def found(s):
        return f(s) / s, jax.grad(f)(s), jax.grad(jax.grad(f))(s) / s

    for value, limit in zip(found(s), (1e-14, 1e-10, 1e-4), strict=True):
        assert abs(value[1] / value[0] - 1) < limit


def test_tmeasy():
    """The numbers that the curve is made from, and Rill's first branch in his own letters."""
    law = LAWS["tmeasy, two"]
    rows = zip(*(np.asarray(x) for x in jax.tree.leaves(law)[:5]), strict=True)
    for axis, (dF0, sM, FM, sS, FS) in enumerate(rows):
        x = np.linspace(0, 1, 50)
        want = dF0 * sM * x / (1 + x * (x + dF0 * sM / FM - 2))
        close(pure(law, x * sM, axis), want)
        points = [sM, (sM + sS) / 2, sS, 3 * sS, 1e9]
        close(pure(law, points, axis), [FM, (FM + FS) / 2, FS, FS, FS])
        ends = jax.jit(jax.vmap(jax.grad(lambda s, axis=axis: pure_traced(law, s, axis))))
        np.testing.assert_allclose(
            ends(jnp.array([0.0, sM, sM * (1 - 1e-12), sS, 2 * sS])), [dF0, 0, 0, 0, 0], atol=1e-9
        )


def pure_traced(law, s, axis):
    return -law.traction(*((s, 0.0 * s) if axis == 0 else (0.0 * s, s)))[axis]


@EVERY
def test_slopes_at_no_slip(law):
    jac = jax.jacfwd(lambda s: jnp.stack(law.traction(s[0], s[1])))(jnp.zeros(2))
    np.testing.assert_allclose(jac, -np.diag([float(x) for x in law.slopes]), rtol=F64_ROUNDING)


def some_slips(n):
    """Slips of every size and direction."""
    rng = np.random.default_rng(1)
    size, angle = 10 ** rng.uniform(-14, 8, n), rng.uniform(0, 2 * np.pi, n)
    return jnp.asarray(size * np.cos(angle)), jnp.asarray(size * np.sin(angle))


@EVERY
def test_traction_opposes_sliding_within_the_ellipse(law):
    sx, sy = some_slips(3000)
    mu = law.traction(sx, sy)
    assert np.all(mu[0] * sx < 0) and np.all(mu[1] * sy < 0)
    back = law.traction(-sx, -sy)
    np.testing.assert_array_equal(np.negative(mu), back)
    assert np.all(np.isinf(law.limits)) == (limits(law) is None)
    if limits(law) is not None:
        np.testing.assert_array_equal(law.limits, limits(law))
        (a, b), (x, y) = limits(law), mu
        assert np.max((x / a) ** 2 + (y / b) ** 2) <= 1 + 1e-12


@pytest.mark.parametrize("law", ALIKE.values(), ids=ALIKE.keys())
def test_alike_along_and_across_means_alike_in_all_directions(law):
    """The force is then along the slip, and as large as that of a pure one."""
    sx, sy = some_slips(100)
    x, y = law.traction(sx, sy)
    size = np.hypot(sx, sy)
    np.testing.assert_allclose(np.hypot(x, y), pure(law, size), rtol=1e-12)
    np.testing.assert_allclose(x * sy, y * sx, rtol=1e-12)


@EVERY
def test_derivatives_by_every_coefficient_and_slip(law):
    row, back = numbers(law)
    points = [(0.0, 0.0), (0.03, 0.0), (0.0, -0.04), (-0.11, 0.07), (0.3, 0.2), (2.0, -5.0)]
    points += [(1e-5, 2e-6)]

    def f(x):
        known, slips = back(x[: row.size]), x[row.size :].reshape(-1, 2)
        found = [jnp.stack(known.traction(*s)) for s in slips]
        return jnp.concatenate(found)

    assert slopes_agree(f, jnp.concatenate([row, jnp.ravel(jnp.array(points))])) < 1e-10


@EVERY
def test_second_derivatives_are_finite_everywhere(law):
    hessian = jax.jit(jax.vmap(jax.hessian(lambda s: jnp.stack(law.traction(s[0], s[1])))))
    sM = 0.1
    places = [[0.0, 0.0], [1e-300, 0.0], [0.0, 1e-160], [1e-13, -1e-12], [sM, 0.0], [0.2, 0.0]]
    found = hessian(jnp.array([*places, [0.4, 0.0], [1e6, 1e6]]))
    assert np.isfinite(found).all()
    assert np.abs(found[0]).max() == 0  # the mean over all directions
    assert np.abs(found[:4]).max() < 1e3


@EVERY
def test_in_single_precision(law):
    """Right to rounding, of whatever slip, and without a number of double precision."""
    light = jax.tree.map(lambda x: x.astype(jnp.float32), law)
    sx, sy = some_slips(500)
    keep = np.hypot(sx, sy) < 1e4
    sx, sy = sx[keep], sy[keep]
    got = light.traction(sx.astype(jnp.float32), sy.astype(jnp.float32))
    assert got[0].dtype == jnp.float32
    scale = np.hypot(*law.traction(sx, sy))
    off = np.hypot(*(np.subtract(a, b) for a, b in zip(got, law.traction(sx, sy), strict=True)))
    assert np.max(off / scale) < 3e-6
    slopes = jax.jit(jax.vmap(jax.jacfwd(lambda s: jnp.stack(light.traction(s[0], s[1])))))
    assert np.isfinite(slopes(jnp.stack([sx, sy], -1).astype(jnp.float32))).all()


@EVERY
def test_as_a_thread(law):
    def f(law, u):
        return law.response(u[0], u[1], u[2])[0]

    assert rb.compiler.explain(f, law, jnp.ones(3)).operations < 90


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (
            lambda: LinearTyre(-1.0),
            r"LinearTyre\(stiffness=...\): got -1.0, expected numbers above 0",
        ),
        (lambda: Fiala(10.0, [1, 2, 3.0]), r"Fiala\(friction=...\): got the shape \(3,\), expect"),
        (lambda: Pacejka(10.0, 2.5, 1.0), r"Pacejka\(shape=...\): got 2.5, expected numbers of at"),
        (lambda: Pacejka(10.0, 1.5, 1.0, 1.2), r"curvature=...\): got 1.2, expected .* at most 1"),
        (lambda: TMeasy(25.0, 0.4, 1.0, 0.1, 0.8), "sliding_slip=.* above 0.4"),
        (lambda: TMeasy(25.0, 0.1, 1.0, 0.4, 1.8), "sliding=.* at most 1.0"),
        (lambda: Coulomb(0.8, smooth_speed=0.0), "smooth_speed=.* above 0"),
        (lambda: Coulomb(np.nan), "expected finite numbers"),
        (lambda: Coulomb("wet"), "got str, expected an array of numbers"),
        (lambda: LinearTyre(9.0, "wet"), r"LinearTyre\(friction=...\): got str, expected an array"),
        (lambda: LinearTyre(9.0, np.inf), "got inf at"),
        (lambda: Coulomb(0.8, smooth_speed=[0.1, 0.1]), r"got the shape \(2,\), expected a number"),
    ],
)
def test_bad_numbers(make, said):
    with pytest.raises(rb.InputError, match=said):
        make()
