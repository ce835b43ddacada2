"""Implicit steps: roots that fail are values; Newton, chord and GMRES agree; equilibria rest.

And stiff or ill-conditioned ones are found: two point masses on massless rods, in absolute angles.
"""

import diffrax
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from scipy.optimize import root

import rbjax as rb
from tests.solvers.scenes import SCENES

SCENE = SCENES["ode"]


def solved(solver, field, y0, dt=0.1, end=1.0, **options):
    return diffrax.diffeqsolve(
        diffrax.ODETerm(field), solver, 0.0, end, dt, y0, throw=False, max_steps=512, **options
    )


def test_a_root_that_does_not_exist_is_a_result() -> None:
    """y1 = y0 + h y1^2 has no root from 1 at h = 1; another sample of the batch has one."""

    @jax.jit
    @jax.vmap
    def run(y0):
        found = solved(rb.solvers.bdf(1), lambda t, y, _: y * y, y0, dt=1.0)
        return found.result == diffrax.RESULTS.successful

    assert run(jnp.array([1.0, 0.1, 0.2])).tolist() == [False, True, True]


def test_a_failed_root_shortens_an_adaptive_step() -> None:
    """The first step is far too long."""
    found = solved(
        rb.solvers.radau_iia(2), lambda t, y, _: y * y, jnp.array(1.0), dt=5.0, end=0.5,
        stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6),
    )  # fmt: skip
    assert found.result == diffrax.RESULTS.successful
    assert abs(float(found.ys[0]) - 2.0) < 1e-4


def test_root_finders_agree() -> None:
    def end(**options):
        solver = rb.solvers.gauss_legendre(2, **options)
        return solved(solver, lambda t, y, _: SCENE.term.vf(t, y, SCENE.args), SCENE.y0).ys[0]

    gmres = lx.GMRES(rtol=1e-10, atol=1e-12)
    want = end(root_finder=rb.solvers.chord())
    for finder in (rb.solvers.newton(), rb.solvers.newton(gmres)):
        np.testing.assert_allclose(end(root_finder=finder), want, rtol=1e-13)


def linearly_implicit(**options):
    """args -> a number at the end of ten steps."""
    solver = rb.solvers.ros2(**options)

    def end(args):
        found = diffrax.diffeqsolve(SCENE.term, solver, 0.0, 1.0, 0.1, SCENE.y0, args)
        return (found.ys**2).sum()

    return end


@pytest.mark.slow
def test_a_linearly_implicit_step_without_a_matrix() -> None:
    """Its values and its gradients are those with one."""
    (got, slope), (want, exact) = (
        jax.jit(jax.value_and_grad(linearly_implicit(**options)))(SCENE.args)
        for options in ({"linear_solver": lx.GMRES(1e-12, 1e-12)}, {})
    )
    np.testing.assert_allclose(got, want, rtol=1e-11)
    np.testing.assert_allclose(slope, exact, rtol=1e-10)


@pytest.mark.slow
def test_a_linearly_implicit_step_by_bicgstab() -> None:
    """No gradient: lineax' BiCGStab finds no solution of a right-hand side of zero, as the adjoint
    of what is not used has. Compiled: without fused products the second half of a step is exact,
    and lineax then divides zero by zero."""
    got, want = (
        jax.jit(linearly_implicit(**options))(SCENE.args)
        for options in ({"linear_solver": lx.BiCGStab(1e-12, 1e-12)}, {})
    )
    np.testing.assert_allclose(got, want, rtol=1e-11)


@pytest.mark.parametrize("linear", [lx.GMRES(1e-9, 1e-9), lx.BiCGStab(1e-9, 1e-9)])
def test_a_chord_without_a_matrix_is_refused(linear) -> None:
    with pytest.raises(rb.InputError, match=r"chord: got .*, expected .* newton\("):
        rb.solvers.chord(linear)


@pytest.mark.parametrize("make", [rb.solvers.bdf, rb.solvers.radau_iia])
def test_rest_is_rest(make) -> None:
    """A pendulum hanging at q = pi, where sin is rounding and not zero: corrections are noise."""
    field = lambda t, y, _: (y[1], 1e4 * jnp.sin(y[0]) - 3.0 * y[1])  # noqa: E731
    found = solved(make(2), field, (jnp.array(jnp.pi), jnp.array(0.0)))
    assert found.result == diffrax.RESULTS.successful
    np.testing.assert_allclose(found.ys[0], np.pi, atol=1e-12)


@pytest.mark.parametrize(
    "name", ["radau_iia3", pytest.param("adams_moulton3", marks=pytest.mark.slow), "rkmk4"]
)
def test_single_precision_stays_single(name: str) -> None:
    solver = rb.solvers.all()[name].make()
    field = lambda t, y, _: (y[1], -jnp.sin(y[0]) * jnp.float32(2.0))  # noqa: E731
    y0 = (jnp.float32(1.0), jnp.float32(0.0))
    found = diffrax.diffeqsolve(
        diffrax.ODETerm(field), solver, jnp.float32(0), jnp.float32(1), jnp.float32(0.05), y0,
        throw=False,
    )  # fmt: skip
    assert found.result == diffrax.RESULTS.successful
    assert {x.dtype for x in jax.tree.leaves(found.ys)} == {jnp.dtype("float32")}
    want = solved(solver, lambda t, y, _: (y[1], -2 * jnp.sin(y[0])), (1.0, 0.0), dt=0.05)
    np.testing.assert_allclose(found.ys[0], want.ys[0], atol=1e-5)


@pytest.mark.parametrize(
    "name", [pytest.param("bdf2", marks=pytest.mark.slow), "generalized_alpha", "yoshida4"]
)
def test_backwards_in_time_and_back_again(name: str) -> None:
    solver = rb.solvers.all()[name].make()
    field = lambda t, y, _: (y[1], -2 * jnp.sin(y[0]) + jnp.cos(t))  # noqa: E731
    y0 = (jnp.array(1.0), jnp.array(0.2))
    there = diffrax.diffeqsolve(diffrax.ODETerm(field), solver, 0.0, 1.0, 0.002, y0)
    end = jax.tree.map(lambda x: x[0], there.ys)
    back = diffrax.diffeqsolve(diffrax.ODETerm(field), solver, 1.0, 0.0, -0.002, end)
    for got, want in zip(back.ys, y0, strict=True):
        np.testing.assert_allclose(got[0], want, atol=1e-4)


def rods(q, v, args, xp):
    """The mass matrix and the force, of an upper mass, a spring at the shoulder."""
    upper, stiffness = args
    c, s = xp.cos(q[0] - q[1]), xp.sin(q[0] - q[1])
    mass = xp.array([[upper + 1, c], [c, 1.0]])
    weight = -9.81 * xp.array([upper + 1, 1.0]) * xp.sin(q)
    turning = xp.array([-s * v[1] ** 2, s * v[0] ** 2])
    return mass, weight + turning - xp.array([stiffness * q[0], 0.0])


def rates(t, y, args):
    mass, force = rods(*y, args, jnp)
    return y[1], jnp.linalg.solve(mass, force)


RODS = rb.solvers.OnGroup(
    rates, rb.solvers.Vector(), lambda t, y, args: rods(*y, args, jnp)[0] @ y[1]
)


def swung(solver, q, args, dt, steps):
    """States (steps, 2), the last where a root was not found."""
    out = diffrax.diffeqsolve(
        RODS, solver, 0.0, dt * steps, dt * (1 + 1e-12), (jnp.array(q), jnp.zeros(2)),
        tuple(map(jnp.asarray, args)), saveat=diffrax.SaveAt(steps=True), throw=False,
        max_steps=steps,
    )  # fmt: skip
    assert out.result == diffrax.RESULTS.successful
    return np.asarray(out.ys[0]), np.asarray(out.ys[1])


def test_masses_a_million_to_one() -> None:
    """The matrix makes 1e-10 of the state of what is rounding in the residual."""
    q, v = swung(rb.solvers.VariationalMidpoint(), [0.5, 0.5], (1e-6, 0.0), 1e-3, 200)
    mass, height = (np.array([rods(a, b, (1e-6, 0.0), np)[0] for a, b in zip(q, v, strict=True)]),
                    -9.81 * (np.cos(q) @ [1 + 1e-6, 1.0]))  # fmt: skip
    energy = np.einsum("ti,tij,tj->t", v, mass, v) / 2 + height
    assert np.abs(energy + 9.81 * np.cos(0.5) * (2 + 1e-6)).max() < 1e-5


@pytest.mark.parametrize(
    "name", ["newmark", *(pytest.param(n, marks=pytest.mark.slow)
                          for n in ("hht_alpha", "generalized_alpha"))]
)  # fmt: skip
def test_a_stiff_spring_that_shakes_a_heavy_arm(name: str) -> None:
    """h omega = 10 from 0.02 rad, 200 J: each step turns the arm far enough to change its mass."""
    solver, h, args = rb.solvers.all()[name].make(), 1e-2, (1.0, 1e6)
    q, v = swung(solver, [0.02, 1.0], args, h, 40)

    def acceleration(q, v):
        return np.linalg.solve(*rods(q, v, args, np))

    m, f, beta, gamma = solver.alpha_m, solver.alpha_f, solver.beta, solver.gamma
    old = np.array([0.02, 1.0]), np.zeros(2)
    carried = acceleration(*old)
    for step in range(3):
        now, (q0, v0) = acceleration(*old), old

        def after(k, q0=q0, v0=v0, now=now, A0=carried):
            A1 = ((1 - f) * k + f * now - m * A0) / (1 - m)
            q1 = q0 + h * v0 + h * h * ((0.5 - beta) * A0 + beta * A1)
            return q1, v0 + h * ((1 - gamma) * A0 + gamma * A1), A1

        def residual(k, after=after):
            q1, v1, _ = after(k)
            mass, force = rods(q1, v1, args, np)
            return mass @ k - force

        found = root(residual, -now, tol=1e-13)
        *old, carried = after(found.x)
        np.testing.assert_allclose(q[step], old[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(v[step], old[1], rtol=0, atol=1e-7)


@pytest.mark.slow
def test_root_finders_of_a_diagonally_implicit_method_agree() -> None:
    def end(finder):
        solver = rb.solvers.SDIRK2(root_finder=finder)
        return solved(solver, lambda t, y, _: SCENE.term.vf(t, y, SCENE.args), SCENE.y0).ys[0]

    want = end(rb.solvers.very_chord())
    np.testing.assert_allclose(end(rb.solvers.newton()), want, rtol=1e-12)
