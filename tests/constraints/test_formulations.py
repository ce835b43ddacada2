"""Formulations against each other on small mechanisms, and against the laws that they obey."""

import functools
from dataclasses import dataclass
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.mechanisms import QUIET, tilted_four_bar
from rbjax import constraints as rc
from rbjax.constraints import Constraint, Row, coordinate
from rbjax.constraints.equations.constrained_motion import constrained_motion, solve_least_norm
from rbjax.constraints.equations.projection import project_state
from rbjax.constraints.formulation import METHODS, as_formulation
from rbjax.constraints.methods.dense import Dense
from rbjax.constraints.methods.recursive import cluster_problem
from tests.oracles import load
from tests.tolerances import GRADIENT

LAWS = load("constraint_identities")
DENSE = {name: one for name, one in rc.formulations().items() if isinstance(one.method, Dense)}


def of_xml(bodies: str) -> rb.Model:
    return rb.load(f"<mujoco>{QUIET}<worldbody>{bodies}</worldbody></mujoco>")


def hung_twice() -> rb.Model:
    """A free body on a ball joint, and on the same one again: six rows of rank three, and equal
    singular values."""
    model = of_xml('<body name="top"><freejoint/><geom type="box" size="0.1 0.2 0.3"/></body>')
    joint = rc.Spherical.between(model, "top", None, point=[0.1, 0.2, 0.3])
    return model.with_constraints(joint, joint)


def rate(row: Row) -> Row:
    return Row(None, row.rate, row.gradient, row.acceleration)


class KnifeEdge(Constraint):
    """No motion across the blade: a non-holonomic row."""

    size = 1

    def rows(self, context):
        turn = coordinate(context, "turn")
        across = rate(coordinate(context, "y")) * turn.apply(jnp.cos)
        return [across - rate(coordinate(context, "x")) * turn.apply(jnp.sin)]


def skate() -> rb.Model:
    return of_xml(
        '<body><joint name="x" type="slide" axis="1 0 0"/>'
        '<joint name="y" type="slide" axis="0 1 0"/><joint name="turn" axis="0 0 1"/>'
        '<geom type="box" size="0.3 0.1 0.1" pos="0.1 0 0"/></body>'
    ).with_constraints(KnifeEdge())


class Circle(Constraint):
    size = 1

    def rows(self, context):
        x, y = coordinate(context, "x"), coordinate(context, "y")
        return [x * x + y * y - 1.0]


def pendulum() -> rb.Model:
    """A point of 1 kg on a circle of 1 m, in Cartesian coordinates."""
    return rb.load(
        '<mujoco><option gravity="0 -9.81 0"/><worldbody><body>'
        '<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>'
        '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>'
    ).with_constraints(Circle())


MECHANISMS = {
    "four_bar": lambda: tilted_four_bar("1 0 0 0"),
    "four_bar_tilted": lambda: tilted_four_bar("0.8 0.3 -0.2 0.4"),
    "hung_twice": hung_twice,
    "skate": skate,
}


@dataclass(frozen=True)
class Chosen(Dense):
    """One of the formulations on arrays, by a number: one program for all."""

    which: Any

    def solution(self, M, G, f, c):
        solutions = [one.method.solution for one in DENSE.values()]
        return jax.lax.switch(self.which, solutions, M, G, f, c)


@functools.cache
def accelerations(mechanism: str) -> tuple[dict, list[dict], tuple]:
    """On a consistent state: accelerations, and the gradients of a sum of them by displacement,
    velocity, force and masses; those of `Multipliers`, and of the others in the order of DENSE; and
    the slope of the sum along a direction of them all, by differences."""
    model = MECHANISMS[mechanism]()
    k1, k2, k3 = jax.random.split(jax.random.key(5), 3)
    tau, weights = jax.random.normal(k2, (model.nv,)), jax.random.normal(k3, (model.nv,))
    q, v = model.default_state().q, jax.random.normal(k1, (model.nv,))
    if mechanism == "skate":
        q = q + 0.4
    v = jax.jit(lambda v: project_state(model, 0.0, rb.State(q, v), positions=False).v)(v)

    def of(one: rc.Formulation, dq, v, tau, mass) -> tuple:
        heavy = model.replace(bodies=model.bodies.replace(mass=mass))
        a = one(heavy, 0.0, rb.State(rb.integrate(model, q, dq), v), tau, {})
        return jnp.vdot(weights, a), a

    def found(one: rc.Formulation, at: tuple) -> dict:
        slopes = jax.value_and_grad(functools.partial(of, one), (0, 1, 2, 3), has_aux=True)
        (_, a), gradients = slopes(*at)
        return {"a": a} | dict(zip(("dq", "v", "tau", "mass"), gradients, strict=True))

    at = jnp.zeros(model.nv), v, tau, model.bodies.mass
    each = jax.jit(lambda which, at: found(Chosen(which), at))
    h, along = 6e-6, jax.tree.map(lambda x: jnp.cos(jnp.arange(x.size, dtype=float)), at)
    beside = [each(0, jax.tree.map(lambda x, dx, s=s: x + s * dx, at, along))["a"] for s in (h, -h)]
    slope = weights @ (beside[0] - beside[1]) / (2 * h)
    want = jax.jit(functools.partial(found, rc.Multipliers()))(at)
    return want, [each(k, at) for k in range(len(DENSE))], (along, slope)


@pytest.mark.parametrize(
    "mechanism",
    [pytest.param(x, marks=pytest.mark.slow if x != "hung_twice" else ()) for x in MECHANISMS],
)
@pytest.mark.parametrize("name", DENSE)
def test_one_motion(name: str, mechanism: str) -> None:
    want, found, (along, slope) = accelerations(mechanism)
    own = found[list(DENSE).index(name)]
    for key in want:
        assert np.abs(want[key]).max() > 1e-3
        np.testing.assert_allclose(own[key], want[key], rtol=0, atol=1e-10, err_msg=key)
    gradients = own["dq"], own["v"], own["tau"], own["mass"]
    total = sum(jnp.vdot(x, dx) for x, dx in zip(gradients, along, strict=True))
    np.testing.assert_allclose(total, slope, rtol=GRADIENT)


def test_a_projection_combines_with_any_method() -> None:
    """In `rollout`, the state is projected after each step, by any method."""
    one = rc.Formulation(rc.NullSpaceQR(), projection=rc.Projection())
    assert (one.family, one.index) == ("minimal", 0)
    model = pendulum()
    start = rb.State(jnp.array([0.6, -0.8]), jnp.array([1.04, 0.78]))
    ends = [
        rb.rollout(model, start, None, 0.01, steps=20, constraints=given).q[-1]
        for given in (one, rc.Projection(), "null_space_qr")
    ]
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-12)
    off = [abs(float(q @ q) - 1.0) for q in ends]
    assert off[0] < 1e-12 < 1e-4 < off[2]


@pytest.mark.slow
def test_derivatives_at_equal_singular_values() -> None:
    """First and second, where those of singular vectors do not exist, against the formula."""
    M, f, c = jnp.diag(jnp.array([2.0, 2.0, 3.0])), jnp.arange(3.0), jnp.array([0.7, -0.4])
    G, turn = jnp.eye(3)[:2], jnp.array([[0.3, -0.2, 0.5], [0.1, 0.4, -0.6]])

    def formula(x):
        A = G + x * turn
        inverse = jnp.linalg.inv(M)
        free = inverse @ f
        return free + inverse @ A.T @ jnp.linalg.inv(A @ inverse @ A.T) @ (c - A @ free)

    def twice(g):
        return jax.jacfwd(jax.jacrev(g))(0.0), jax.jacrev(g)(0.0)

    def others(which):
        return twice(lambda x: Chosen(which).scaled_solution(M, G + x * turn, f, c)[0])

    want, each = twice(formula), jax.jit(others)
    for k, name in enumerate(DENSE):
        for got, expected in zip(each(k), want, strict=True):
            np.testing.assert_allclose(got, expected, rtol=0, atol=1e-10, err_msg=name)


@pytest.mark.parametrize("name", DENSE)
def test_udwadia_kalaba_with_redundant_rows(name: str) -> None:
    law = LAWS["udwadia_kalaba_redundant"]
    M, G, c, free = (jnp.array(law[x], float) for x in ("M_diag", "A", "b", "a_unconstrained"))
    a, l = DENSE[name].method.scaled_solution(jnp.diag(M), G, M * free, c)
    np.testing.assert_allclose(a, law["a"], rtol=0, atol=1e-13)
    np.testing.assert_allclose(M * a, M * free + G.T @ l, rtol=0, atol=1e-12)


def test_rows_that_are_zero_but_for_rounding() -> None:
    """They do not hold the motion, whatever they ask; rows in other units do as well as ever."""
    G = jnp.array([[1.0, 0.5, 0.0], [1e-17, -2e-17, 1e-17], [0.0, 3e-4, 1e-4]])
    f, c = jnp.array([0.2, -0.1, 0.4]), jnp.array([1.0, 3e-16, 2e-4])
    A = G[jnp.array([0, 2])]
    want = f + A.T @ jnp.linalg.solve(A @ A.T, c[jnp.array([0, 2])] - A @ f)
    M = jnp.eye(3)
    found = {name: one.method.scaled_solution(M, G, f, c)[0] for name, one in DENSE.items()}
    found["multipliers"] = f + G.T @ solve_least_norm(G @ G.T, c - G @ f)
    for name, a in found.items():
        np.testing.assert_allclose(a, want, rtol=0, atol=1e-10, err_msg=name)


def test_pendulum_accelerations_and_multiplier() -> None:
    law, model = LAWS["pendulum_kkt"], pendulum()
    state = rb.State(jnp.array(law["x"]), jnp.array(law["v"]))

    def found(method):
        given = {} if method is None else {"method": method}
        return constrained_motion(model, 0.0, state, jnp.zeros(2), {}, **given)

    ways = [None, cluster_problem, *(one.method._method for one in DENSE.values())]
    for a, l in jax.jit(lambda: [found(method) for method in ways])():
        np.testing.assert_allclose(a, law["a"], rtol=0, atol=1e-12)
        np.testing.assert_allclose(l, law["lam"], rtol=0, atol=1e-10)


def test_augmented_lagrangian_contracts() -> None:
    """The residual of the rows falls by (1 + alpha G M^-1 G^T)^-1 with each iteration."""
    law, at = LAWS["augmented_lagrangian"], LAWS["pendulum_kkt"]
    G, f = 2.0 * jnp.array([at["x"]]), jnp.array([0.0, -9.81])
    c = -2.0 * jnp.dot(jnp.array(at["v"]), jnp.array(at["v"]))[None]
    off = []
    for k in range(1, 7):
        a, l = rc.AugmentedLagrangian(law["alpha"], k).solution(jnp.eye(2), G, f, c)
        np.testing.assert_allclose(a, f + G.T @ l, rtol=0, atol=1e-13)
        off.append(float((G @ a - c)[0]))
    np.testing.assert_allclose(np.divide(off[1:5], off[:4]), law["factor"], rtol=1e-7)
    a, l = rc.AugmentedLagrangian(law["alpha"], 12).solution(jnp.eye(2), G, f, c)
    np.testing.assert_allclose(a, law["limit_acceleration"], rtol=0, atol=1e-13)
    np.testing.assert_allclose(l, law["lambda_"], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_baumgarte_residual() -> None:
    """g'' + 2 alpha g' + beta^2 g = 0, whatever the motion."""
    example = LAWS["baumgarte_residual"]["example"]
    model, state = pendulum(), rb.State(jnp.array(example["x0"]), jnp.array(example["v0"]))
    cases = example["cases"]
    ts = jnp.array([0.0, *map(float, cases["none"]["samples"])])

    def residuals(one: rc.Formulation) -> jax.Array:
        path = rb.simulate(
            model, state, ts, solver=diffrax.Dopri8(), dt=0.01, constraints=one, max_steps=1000,
            stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12),
        )  # fmt: skip
        return (path.q**2).sum(1)[1:] - 1.0

    ways = [rc.Baumgarte(case["alpha"], case["beta"]) for case in cases.values()]
    for case, g in zip(cases.values(), [residuals(one) for one in ways], strict=True):
        want = [sample["g_exact"] for sample in case["samples"].values()]
        np.testing.assert_allclose(g, want, rtol=0, atol=1e-10)


@pytest.mark.parametrize("method", [x for x in METHODS if x.has_feedback] + [rc.Compliant()],
                         ids=lambda x: x.name)  # fmt: skip
def test_feedback_combines_with_any_method(method: rc.Method) -> None:
    """Off the constraint g = q q - 1, at g' != 0: g'' = -2 alpha g' - beta^2 g, of every method."""
    model, alpha, beta = pendulum(), 3.0, 5.0
    q, v = jnp.array([0.7, -0.9]), jnp.array([0.4, 0.3])
    form = rc.Formulation(method, rc.Baumgarte(alpha, beta))
    a = jax.jit(lambda q, v: form(model, 0.0, rb.State(q, v), 0 * v, {}))(q, v)
    second = 2 * (v @ v + q @ a)
    want = -2 * alpha * 2 * (q @ v) - beta**2 * (q @ q - 1.0)
    np.testing.assert_allclose(second, want, rtol=1e-9)
    assert form.name == f"{method.name}+baumgarte" and form.family == method.family


def test_names_of_the_registry() -> None:
    """Each entry is the product that its name says; a factor stands for itself."""
    for name, one in rc.formulations().items():
        assert one.name in (name, f"{name}+projected", f"{name}+independent_coordinates")
    for factor in (rc.KKT(), rc.Baumgarte(1.0, 2.0), rc.Projection(3), rc.TangentSpace()):
        one = as_formulation(factor)
        assert factor in (one.method, one.feedback, one.projection) and one.name == factor.name
    assert as_formulation("kkt") is None


def test_penalty_is_a_singular_perturbation() -> None:
    """It hangs where springs carry its weight; in motion the residual falls as 1 / k."""
    model = pendulum()
    hanging = jnp.array([0.0, -1.1])
    k = 9.81 / (2.0 * 1.1 * (1.1**2 - 1.0))
    a = rc.Penalty(k, 3.0)(model, 0.0, rb.State(hanging, jnp.zeros(2)), jnp.zeros(2), {})
    np.testing.assert_allclose(a, 0.0, atol=1e-13)

    def worst(k, steps=4000, dt=2e-4):
        def acceleration(q, v):
            one = rc.Penalty(k, jnp.sqrt(k))  # critical: k (dg/dr)^2 = 4 k
            return one(model, 0.0, rb.State(q, v), jnp.zeros(2), {})

        def step(x, _):
            q, v = x
            v = v + dt * acceleration(q, v)
            q = q + dt * v
            return (q, v), jnp.abs(q @ q - 1.0)

        start = jnp.array([0.6, -0.8]), jnp.array([1.04, 0.78])
        return jax.lax.scan(step, start, None, length=steps)[1].max()

    ks = jnp.array([1e3, 1e4, 1e5])
    off = jax.jit(jax.vmap(worst))(ks)
    scaled = np.asarray(off * ks)
    np.testing.assert_allclose(scaled[1:], scaled[:-1], rtol=0.1)
    assert scaled[-1] > 1.0


def test_baumgarte_for_the_steps_of_semi_implicit_euler() -> None:
    """Of a row that is linear in q a step leaves 1 - 0.09 of the residual, whatever the step."""
    for dt in (0.01, 0.002):
        model = rb.load("cart_pole").with_constraints(rc.JointPolynomial("slider", None, [0.25]))
        path = rb.rollout(
            model, model.default_state(), None, dt, steps=4,
            integrator="semi_implicit_euler", constraints=rc.Baumgarte.for_step(dt),
        )  # fmt: skip
        left = path.q[1:, 0] - 0.25
        np.testing.assert_allclose(left, -0.25 * 0.91 ** np.arange(1, 5), rtol=1e-10)
