"""Formulations of index 2, index 3 and GGL: orders beside those of others, and what they hold."""

import functools
from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

import rbjax as rb
from benchmarks.cases.mechanisms import andrews, four_bars, tilted_four_bar
from rbjax import constraints as rc
from rbjax.constraints.equations.projection import project_state
from rbjax.forces.acting import applied
from rbjax.motion.implicit import BDFSolver, increment, stages
from rbjax.motion.term import make_term
from rbjax.solvers.steps import weighted_sums
from tests.constraints.test_formulations import hung_twice, pendulum, skate
from tests.oracles import load
from tests.tolerances import GRADIENT

ORDERS = load("dae_orders")["errors"]
FORMS = {"index_2": rc.Index2(), "index_3": rc.Index3(), "ggl": rc.GGL()}
RUNGE_KUTTA = {
    "RadauIIA2": rb.solvers.radau_iia(2),
    "RadauIIA3": rb.solvers.radau_iia(3),
    "Gauss2": rb.solvers.gauss_legendre(2),
    "Gauss3": rb.solvers.gauss_legendre(3),
    "LobattoIIIC3": rb.solvers.lobatto_iiic(3),
    "ImplicitEuler": rb.solvers.radau_iia(1),
}
REST = rb.State(jnp.array([-1.0, 0.0]), jnp.zeros(2))
SECONDS = 0.5


def tilted() -> rb.Model:
    return tilted_four_bar("0.8 0.3 -0.2 0.4")


@functools.cache
def exact() -> dict[str, np.ndarray]:
    """The pendulum after 0.5 s: sin(angle / 2) = k cd(w t), by Jacobi's functions."""
    k, w = np.sqrt(0.5), np.sqrt(9.81)
    sn, cn, dn, _ = scipy.special.ellipj(w * SECONDS, k**2)
    half = np.arcsin(k * cn / dn)
    rate = -2 * k * w * (1 - k**2) * sn / (dn**2 * np.cos(half))
    q = -np.array([np.sin(2 * half), np.cos(2 * half)])
    # 2 q . (q'' - gravity) = 2 q . (2 l q),  q . q'' = -v . v
    return {"q": q, "v": rate * np.array([q[1], -q[0]]), "l": (9.81 * q[1] - rate**2) / 2}


def off(q, v, l) -> list[float]:
    found = {"q": q, "v": v, "l": l}
    return [float(np.abs(found[x] - want).max()) for x, want in exact().items()]


def by_stages(solver, law: rc.Formulation) -> Callable:
    """Steps of a Runge-Kutta method, with the multiplier that it carries from step to step."""
    model, tableau = pendulum(), solver.tableau
    to_end = np.linalg.solve(np.array(tableau.a).T, tableau.b)

    @jax.jit
    def run(n):
        h = SECONDS / n

        def forces(t, state):
            return applied(model, t, state)

        def once(i, at):
            state, l = at
            found = stages(law, tableau, model, forces, i * h, state, h)
            u = increment(model, weighted_sums(tableau.b, found.k))
            l = jnp.where(found.ok, l + to_end @ (found.w[:, 0] - l), jnp.nan)
            return rb.State(state.q + u.q, state.v + u.v), l

        return jax.lax.fori_loop(0, n, once, (REST, jnp.zeros(())))

    return lambda n: off((at := run(n))[0].q, at[0].v, at[1])


def by_bdf(k: int, law: rc.Formulation) -> Callable:
    """Steps of a BDF; its multiplier is that of the rate at the end of the last one."""
    model, solver = pendulum(), BDFSolver(law, k)

    @jax.jit
    def run(n):
        h = SECONDS / n
        term, y0 = make_term(model, REST, solver, dynamics=law, start=jnp.zeros(()))

        def once(i, at):
            y, history, _ = at
            t0 = i * h
            y, _, dense, history, _ = solver.step(term, t0, t0 + h, y, model, history, False)
            powers = jnp.arange(1.0, 1 + len(dense["coefficients"].v))
            return y, history, powers @ dense["coefficients"].v / h

        start = solver.init(term, jnp.zeros(()), h, y0, model)
        y, _, a = jax.lax.fori_loop(0, n, once, (y0, start, jnp.zeros(2)))
        return y, y.q @ (a + jnp.array([0.0, 9.81])) / (2 * y.q @ y.q)

    return lambda n: off((at := run(n))[0].q, at[0].v, at[1])


def by_simulate(solver) -> Callable:
    """Steps of accelerations, index 1."""
    model, ts = pendulum(), jnp.array([0.0, SECONDS])

    def run(n):
        path = rb.simulate(
            model, REST, ts, solver=solver, dt=SECONDS / n, constraints="multipliers"
        )
        end = path.state(-1)
        return off(end.q, end.v, rc.multipliers(model, end)[0])

    return run


def runner(name: str, index: int) -> Callable:
    bdf = name.startswith("BDF")
    if index == 1:
        return by_simulate(rb.solvers.bdf(int(name[-1])) if bdf else RUNGE_KUTTA[name])
    law = FORMS[f"index_{index}"]
    return by_bdf(int(name[-1]), law) if bdf else by_stages(RUNGE_KUTTA[name], law)


def errors_of(case: str, steps: list[int]) -> np.ndarray:
    name, index = case.split("/index")
    run = runner(name, int(index))
    return np.array([run(n) for n in steps]).T


@pytest.mark.slow
@pytest.mark.parametrize("case", ORDERS)
def test_orders(case: str) -> None:
    """Of position, velocity and multiplier, beside those that another program measured: with the
    same numbers of steps errors are the same. A BDF of theirs starts from exact states."""
    found, want = errors_of(case, ORDERS[case]["steps"]), [ORDERS[case][x] for x in "qvl"]
    if case in ("Gauss2/index1", "Gauss3/index1"):
        # ours is a function of the state; theirs is carried along, from stages of lower order
        found, want = found[:2], want[:2]
    clear = np.array(want) > 2e-11
    orders, due = (np.log2(x[:, :-1] / x[:, 1:]) for x in (found, np.array(want)))
    clear = clear[:, 1:]
    assert clear.any(1).all()
    if case.startswith("BDF"):
        orders, due, clear = orders[:, -1:], due[:, -1:], clear[:, -1:]
    else:
        np.testing.assert_allclose(found, want, rtol=2e-3, atol=3e-13)
    np.testing.assert_allclose(orders[clear], due[clear], rtol=0, atol=0.15)


@pytest.mark.parametrize("name", FORMS)
def test_pendulum(name: str) -> None:
    """`rollout`: errors as others measured them; what each formulation holds. GGL has the row
    twice: multipliers are open, the motion is not."""
    model, n = pendulum(), 10
    if name == "ggl":
        model = model.with_constraints(*model.constraints, *model.constraints)
    path = rb.rollout(model, REST, None, SECONDS / n, steps=n, constraints=name)
    assert path.success
    r = rc.residual(model, path.state(-1))
    value, rate = float(np.abs(r.value).max()), float(np.abs(r.rate).max())
    if name != "ggl":
        want = ORDERS[f"RadauIIA3/index{name[-1]}"]
        found = off(path.q[-1], path.v[-1], exact()["l"])
        np.testing.assert_allclose(found[:2], [want["q"][0], want["v"][0]], rtol=1e-4)
    held = {"index_2": (1e-6, 1e-13), "index_3": (1e-13, 1e-2), "ggl": (1e-13, 1e-13)}[name]
    assert (value, rate) < held and value < held[0] and rate < held[1]
    if name == "index_2":
        with pytest.warns(UserWarning, match="not finite"):
            wild = rb.rollout(model, REST, None, 3.0, steps=n, constraints=name)
        assert not wild.success


def test_methods_that_do_not_fit() -> None:
    model, ts = pendulum(), jnp.array([0.0, 1.0])
    for given in ("rk4", "semi_implicit_euler", lambda field, t, state, inputs, dt: state):
        with pytest.raises(rb.InputError, match=r"rollout: .*index_3.*radau_iia2, radau_iia3"):
            rb.rollout(model, REST, None, 0.1, steps=1, integrator=given, constraints="index_3")
    for solver in (diffrax.Tsit5(), rb.solvers.trapezoid(), rb.solvers.newmark()):
        with pytest.raises(rb.InputError, match=r"simulate: .*ggl.*radau_iia3.*bdf1 to bdf6"):
            rb.simulate(model, REST, ts, solver=solver, constraints="ggl")


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMS)
def test_four_bar_beside_projection(name: str) -> None:
    model, start = four_bars(1)
    want = rb.rollout(model, start, None, 5e-4, steps=1000, integrator="rk4", save_every=1000)
    path = rb.rollout(model, start, None, 0.01, steps=50, constraints=name, save_every=50)
    np.testing.assert_allclose(path.q[-1], want.q[-1], rtol=0, atol=1e-8)
    atol = 1e-3 if name == "index_3" else 1e-8
    np.testing.assert_allclose(path.v[-1], want.v[-1], rtol=0, atol=atol)
    adaptive = rb.simulate(model, start, jnp.array([0.0, 0.2, 0.5]), constraints=name)
    np.testing.assert_allclose(adaptive.q[-1], want.q[-1], rtol=0, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("mechanism", [hung_twice, tilted, skate])
@pytest.mark.parametrize("name", FORMS)
def test_orders_with_attitudes_and_redundant_rows(name: str, mechanism: Callable) -> None:
    """Order 5 of positions; a free body on a ball joint, six rows of rank three; a plane loop
    closed in space; a non-holonomic row."""
    model = mechanism()
    v = jnp.cos(jnp.arange(model.nv, dtype=float))
    q = model.default_state().q + (0.4 if mechanism is skate else 0.0)
    start = project_state(model, 0.0, rb.State(q, v), positions=False)
    want = rb.rollout(model, start, None, 5e-4, steps=800, integrator="rk4", save_every=800)
    ends = [
        rb.rollout(model, start, None, 0.4 / n, steps=n, constraints=name, save_every=n)
        for n in (16, 32)
    ]
    r = rc.residual(model, ends[-1].state(-1))
    if name != "index_2":
        assert np.abs(r.value).max() < 1e-14
    if name != "index_3" or mechanism is skate:
        assert np.abs(r.rate).max() < 1e-13
    qs, vs = (
        [np.abs(x - y).max() for x in found]
        for found, y in (
            ([e.q[-1] for e in ends], want.q[-1]),
            ([e.v[-1] for e in ends], want.v[-1]),
        )
    )
    assert np.log2(qs[0] / qs[1]) > 4.7 and qs[1] < 1e-7
    least = 2.65 if name == "index_3" and mechanism is not skate else 4.5
    assert np.log2(vs[0] / vs[1]) > least


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMS)
def test_gradients(name: str) -> None:
    """Of a rollout by velocities and masses: reverse against differences, forward, and against
    those of "projected"; a second derivative against differences of the first."""
    model = tilted()
    q, n = model.default_state().q, 10
    v = project_state(model, 0.0, rb.State(q, jnp.array([1.0, -0.4, 0.3])), positions=False).v

    def end(faster, mass, **how):
        heavy = model.replace(bodies=model.bodies.replace(mass=mass))
        start = rb.State(q, v * (1 + faster))
        return rb.rollout(heavy, start, None, 0.01, steps=n, save_every=n, **how).q[-1].sum()

    of = jax.jit(functools.partial(end, constraints=name))
    mass, h = model.bodies.mass, 6e-6
    slope = jax.jit(jax.grad(of, (0, 1)))
    faster, heavier = slope(0.0, mass)
    np.testing.assert_allclose(faster, (of(h, mass) - of(-h, mass)) / (2 * h), rtol=GRADIENT)
    along = jnp.array([0.0, 0.3, -0.5, 0.7])
    difference = (of(0.0, mass + h * along) - of(0.0, mass - h * along)) / (2 * h)
    np.testing.assert_allclose(along @ heavier, difference, rtol=GRADIENT * 10)
    forward = jax.jvp(of, (0.0, mass), (1.0, along))[1]
    np.testing.assert_allclose(forward, faster + along @ heavier, rtol=1e-9)
    others = jax.grad(functools.partial(end, integrator="rk4"), (0, 1))(0.0, mass)
    np.testing.assert_allclose(faster, others[0], rtol=1e-5)
    np.testing.assert_allclose(heavier, others[1], rtol=0, atol=1e-6)
    if name == "index_3":
        twice = jax.jvp(lambda x: slope(x, mass)[0], (0.0,), (1.0,))[1]
        difference = (slope(h, mass)[0] - slope(-h, mass)[0]) / (2 * h)
        np.testing.assert_allclose(twice, difference, rtol=GRADIENT * 10)


class Servo(rb.forces.Element):
    """A torque that follows a swing with a delay: an element with a state."""

    delay: jax.Array

    size = 1

    def loads(self, context):
        return context.joint("a").push(context.x[0])

    def rate(self, context):
        return [
            (3.0 * jnp.sin(4.0 * context.t) - context.joint("a").v[0] - context.x[0]) / self.delay
        ]


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMS)
def test_states_of_elements_inputs_and_batches(name: str) -> None:
    model = tilted_four_bar("1 0 0 0").with_forces(Servo(jnp.array(0.05)))
    start = rb.State(model.default_state().q, jnp.zeros(3), jnp.array([0.2]))
    ts = jnp.array([0.0, 0.15, 0.3])

    def push(t, state):
        return jnp.array([0.0, 1.0, 0.0]) * jnp.cos(5.0 * t) - 0.1 * state.v

    want = rb.simulate(model, start, ts, tau=push)
    path = rb.simulate(model, start, ts, tau=push, constraints=name)
    loose = 1e-5 if name == "index_3" else 1e-7  # at times between steps
    for found, due, atol in (
        (path.q, want.q, 1e-7),
        (path.v, want.v, loose),
        (path.x, want.x, 1e-6),
    ):
        np.testing.assert_allclose(found, due, rtol=0, atol=atol)
    many = jax.tree.map(lambda x: jnp.stack([x, 1.0 * x]), start)
    many = many.replace(x=jnp.array([[0.2], [0.5]]))
    both = rb.rollout(model, many, None, 0.01, steps=5, constraints=name)
    for i in range(2):
        one = rb.rollout(
            model, jax.tree.map(lambda x, i=i: x[i], many), None, 0.01, steps=5, constraints=name
        )
        for a, b in ((both.q[i], one.q), (both.v[i], one.v), (both.x[i], one.x)):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


class Pull(rb.forces.Element):
    """A stiff spring and damper along x."""

    k: jax.Array
    c: jax.Array

    def loads(self, context):
        force = -self.k * (context.q[0] - 0.6) - self.c * context.v[0]
        return context.generalized(jnp.stack([force, 0.0 * force]))


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMS)
def test_stiff_forces(name: str) -> None:
    """A hundred times stiffer than an explicit step can be: at rest after it, or creeping."""
    start = rb.State(jnp.array([0.6, -0.8]), jnp.array([0.008, 0.006]))
    for k, c in ((1e8, 0.0), (0.0, 1e8)):
        model = pendulum().with_forces(Pull(jnp.array(k), jnp.array(c)))
        path = rb.rollout(model, start, None, 0.01, steps=20, constraints=name)
        assert path.success
        np.testing.assert_allclose(path.q[-1], start.q, rtol=0, atol=2e-7)
        # along the circle, weight against c times the velocity
        creep = -9.81 * 0.6 / 0.64 / c * np.array([0.8, 0.6]) if c else np.zeros(2)
        np.testing.assert_allclose(path.v[-1], creep, rtol=0, atol=1e-12)
        if name == "index_3":
            with pytest.warns(UserWarning, match="not finite"):
                path = rb.rollout(model, start, None, 0.01, steps=200, integrator="rk4")
            assert not path.success


@pytest.mark.slow
def test_steps_that_are_not_solved() -> None:
    """A value, not an exception: a fixed step says so, adaptive ones become shorter."""
    model, ts = pendulum(), jnp.array([0.0, 3.0])
    path = rb.simulate(model, REST, ts, dt=3.0, constraints="ggl", throw=False)
    assert not path.success and path.result == diffrax.RESULTS.nonlinear_divergence
    controller = diffrax.PIDController(rtol=1e-8, atol=1e-8)
    path = rb.simulate(model, REST, ts, dt=3.0, stepsize_controller=controller, constraints="ggl")
    assert path.success and path.stats["num_rejected_steps"] > 0


@pytest.mark.slow
def test_projection_after_steps() -> None:
    """Velocities of index 3, put back on the constraints."""
    model, start = four_bars(1)
    both = rc.Formulation(rc.Index3(), projection=rc.Projection())
    path = rb.rollout(model, start, None, 0.01, steps=10, constraints=both)
    adaptive = rb.simulate(model, start, path.ts[::5], constraints=both)
    np.testing.assert_allclose(adaptive.q, path.q[::5], rtol=0, atol=1e-7)
    for end in (path.state(-1), adaptive.state(-1)):
        r = rc.residual(model, end)
        assert max(np.abs(r.value).max(), np.abs(r.rate).max()) < 1e-13
    want = rb.rollout(model, start, None, 1e-3, steps=100, integrator="rk4", save_every=100)
    np.testing.assert_allclose(path.q[-1], want.q[-1], rtol=0, atol=1e-8)
    np.testing.assert_allclose(path.v[-1], want.v[-1], rtol=0, atol=1e-7)


@pytest.mark.slow
def test_gradient_of_simulate() -> None:
    """Through adaptive steps, some of them refused."""
    model, ts = pendulum(), jnp.array([0.0, 0.5])

    def end(speed, name):
        start = rb.State(REST.q, jnp.stack([0.0 * speed, speed]))
        return rb.simulate(model, start, ts, constraints=name).q[-1, 0]

    want = jax.grad(end)(0.3, "projected")
    for name in FORMS:
        np.testing.assert_allclose(jax.grad(end)(0.3, name), want, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMS)
def test_single_precision(name: str) -> None:
    model, start = four_bars(1)
    want = rb.rollout(model, start, None, 0.01, steps=20, constraints=name)
    model, start = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (model, start))
    path = rb.rollout(model, start, None, 0.01, steps=20, constraints=name)
    assert path.success and path.q.dtype == jnp.float32
    np.testing.assert_allclose(path.q, want.q, rtol=0, atol=2e-5)
    np.testing.assert_allclose(path.v, want.v, rtol=0, atol=2e-2 if name == "index_3" else 2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMS)
def test_andrews(name: str) -> None:
    """Seven bodies, three loops in space that move in a plane."""
    figures = load("loops")["andrews"]
    model, start = andrews(figures["parameters"], figures["q0"])
    mom = jnp.zeros(7).at[model.joint("K1")].set(figures["parameters"]["mom"])
    samples = figures["samples"]
    ts = jnp.array([0.0, *map(float, samples)])
    path = rb.simulate(model, start, ts, tau=mom, constraints=name)
    order = np.array([model.joint(f"K{k}") for k in range(1, 8)])
    for i, want in enumerate(samples.values(), 1):
        np.testing.assert_allclose(path.q[i][order], want["q"], rtol=0, atol=5e-8)
        rtol = 1e-3 if name == "index_3" else 1e-6
        np.testing.assert_allclose(path.v[i][order], want["v"], rtol=rtol)
