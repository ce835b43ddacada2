"""The multibody model of wheeled robots against the reduced equations, which it shares no dynamics
with, and against momentum and the book's separation of wrenches."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import wheeled
from rbjax.constraints import KKT, Formulation, jacobian, mobility
from rbjax.errors import InputError, UnknownName
from rbjax.model import State
from rbjax.wheeled.kinematics.context import coordinate_rates
from rbjax.wheeled.kinematics.parameters import parameters_of
from rbjax.wheeled.kinematics.planar import Dual, rate_of
from rbjax.wheeled.kinematics.velocities import constraint_rates, rolling_velocities
from rbjax.wheeled.models.constrained import Constrained, full_state
from rbjax.wheeled.models.equations import kinetic_energy, projected_equations
from rbjax.wheeled.multibody.full_model import full_model, model_of
from rbjax.wheeled.multibody.wheel_rows import SteeringRate
from tests.tolerances import F64_IDENTITY, GRADIENT, relative_error

KINDS = wheeled.kinds()
QUICK = ("differential_drive", "mecanum", "tricycle", "skid_steer")
SAMPLES = 5
every_kind = pytest.mark.parametrize(
    "name", [k if k in QUICK else pytest.param(k, marks=pytest.mark.slow) for k in KINDS]
)


def rates(lanes):
    return [rate_of(x) for x in lanes]


def on_a_slope(name, behind=0.0):
    """Of casters, the centre of mass is a part `behind` of the trail behind the pivot."""
    robot = KINDS[name].make().replace(slope=jnp.array([0.1, -0.05]))
    return robot.replace(wheels=tuple(w.replace(behind=behind * w.trail) for w in robot.wheels))


def stacked(lanes):
    return jnp.stack([jnp.asarray(x, float) for x in lanes])


def samples(fidelity, seed=0):
    """Random coordinates, free velocities and controls."""
    rng = np.random.default_rng(seed)
    for _ in range(SAMPLES):
        q = rng.uniform(-0.6, 0.6, fidelity.nq)
        yield q, 2 * rng.normal(size=fidelity.nv), rng.normal(size=fidelity.nu)


def full_rates(n, context, w, change):
    """w' by that of the free velocities."""
    shape = context.shape_with_rate(w)
    return rates(
        rolling_velocities(n, shape, [Dual(a, b) for a, b in zip(context.v, change, strict=True)])
    )


@every_kind
def test_accelerations_and_energy(name):
    robot = on_a_slope(name, behind=0.6)
    reduced, full = wheeled.at(robot, "reduced"), Constrained(robot)
    eliminated = wheeled.at(robot, "dynamical")

    def found(q, v, u):
        context = reduced.context(State(q, v), u)
        n = context.n
        w = reduced.full_velocities(context)
        then = replace(context, v=w)
        resting = replace(context, u=context.u[: len(robot.drives)] + [0.0] * len(robot.steerings))
        model, state = full_state(resting, w)
        T = rb.kinetic_energy(model, state.q, state.v)
        return {
            "w": stacked(w),
            "on rows": stacked(full.full_velocities(then)),
            "by twists": stacked(full_rates(n, context, w, reduced.accelerations(context))),
            "by multipliers": stacked(full_rates(n, context, w, eliminated.accelerations(context))),
            "constrained": stacked(full.accelerations(then)),
            "T": jnp.stack([T, kinetic_energy(n, context.shape, w)]),
        }

    run = jax.jit(found)
    for q, v, u in samples(reduced):
        x = run(q, v, u)
        assert relative_error(x["on rows"], x["w"]) < 1e-13
        assert relative_error(x["constrained"], x["by twists"]) < F64_IDENTITY
        assert relative_error(x["constrained"], x["by multipliers"]) < F64_IDENTITY
        np.testing.assert_allclose(*x["T"], rtol=1e-13)


@pytest.mark.parametrize("name", ["differential_drive", "omni_3"])
def test_separation_of_wrenches_term_by_term(name):
    """S^T M S and S^T (f - M S' nu) of the reduction are those of the multibody model's own mass
    matrix and bias forces, on the null space of its own rows."""
    robot = on_a_slope(name, behind=0.6)
    reduced = wheeled.at(robot, "reduced")

    def found(q, nu, u):
        context = reduced.context(State(q, nu), u)
        n = context.n

        def lifted(nu):
            moved = replace(context, v=[nu[i] for i in range(reduced.nv)])
            return full_state(moved, reduced.full_velocities(moved))[1].v

        model, state = full_state(context, reduced.full_velocities(context))
        S = jax.jacfwd(lifted)(nu)
        M = rb.mass_matrix(model, state.q)
        # S' nu: how velocities change as q moves on and nu does not

        def ahead(s):
            w = reduced.full_velocities(context)
            dq = stacked(coordinate_rates(context, w))
            there = replace(context, q=[a + s * b for a, b in zip(context.q, dq, strict=True)])
            return full_state(there, reduced.full_velocities(there))[1].v

        bias = rb.bias_forces(model, state.q, state.v)
        _, dS = jax.jvp(ahead, (0.0,), (1.0,))
        rows = jacobian(model, state.q)
        w = reduced.full_velocities(context)
        no_torques = [0.0] * len(n.shafts)
        book = projected_equations(context, w, rolling_velocities, context.v, no_torques)
        return {
            "rows": rows @ S,
            "M": (S.T @ M @ S, jnp.stack([stacked(row) for row in book.M])),
            "f": (-S.T @ (bias + M @ dS), stacked(book.f)),
        }

    run = jax.jit(found)
    for q, v, u in samples(reduced):
        x = run(q, v, u)
        np.testing.assert_allclose(x["rows"], 0.0, atol=1e-14)
        assert relative_error(*x["M"]) < 1e-13
        assert relative_error(*x["f"]) < 1e-13


def test_forces_of_the_ground_and_weight_move_the_centre_of_mass():
    robot = on_a_slope("differential_drive")
    full, reduced = Constrained(robot), wheeled.at(robot, "reduced")

    def found(q, nu, u):
        context = reduced.context(State(q, nu), u)
        n = context.n
        w = reduced.full_velocities(context)
        context = replace(context, v=w)
        model, state = full_state(context, w)
        a = full.accelerations(context)
        # p' in the chassis' axes, from V and V'
        M, (cx, cy) = model.bodies.mass.sum(), rb.center_of_mass(model, state.q)[:2]
        c, s = jnp.cos(q[2]), jnp.sin(q[2])
        dx, dy = cx - q[0], cy - q[1]
        x, y = c * dx + s * dy, c * dy - s * dx
        ax = a[0] - w[2] * w[1] - a[2] * y - w[2] ** 2 * x
        ay = a[1] + w[2] * w[0] + a[2] * x - w[2] ** 2 * y
        fx, fy = 0.0, 0.0
        shape = context.shape
        for (ahead, left), way in zip(full.axle_forces(context), shape.wheels, strict=True):
            fx, fy = fx + ahead * way[0] - left * way[1], fy + ahead * way[1] + left * way[0]
        gx, gy = n.downhill
        weight = M * (c * gx + s * gy), M * (c * gy - s * gx)
        return stacked([M * ax, M * ay]), stacked([fx + weight[0], fy + weight[1]])

    run = jax.jit(found)
    for q, v, u in samples(reduced):
        assert relative_error(*run(q, v, u)) < F64_IDENTITY


def test_formulations_agree_and_velocities_off_the_rows_are_put_on_them():
    robot = on_a_slope("differential_drive")

    def found(q, w, u):
        context = Constrained(robot).context(State(q, w), u)
        model, state = full_state(context, Constrained(robot).full_velocities(context))
        rows = jacobian(model, state.q) @ state.v
        laws = Constrained(robot), Constrained(robot, Formulation(KKT()))
        return rows, *(stacked(law.accelerations(context)) for law in laws)

    one, rng = Constrained(robot), np.random.default_rng(1)
    given = [rng.normal(size=size) for size in (one.nq, one.nv, one.nu)]
    rows, a, b = jax.jit(found)(*given)
    np.testing.assert_allclose(rows, 0.0, atol=1e-12)
    assert relative_error(a, b) < F64_IDENTITY


@pytest.mark.slow
def test_derivatives_by_the_robots_numbers():
    robot = on_a_slope("differential_drive")
    first = Constrained(robot)
    q, w, u = (np.full(size, 0.3) for size in (first.nq, first.nv, first.nu))

    def speeding(mass, track):
        wheels = [
            wheel.replace(position=wheel.position * jnp.stack([jnp.ones(()), track]))
            for wheel in robot.wheels
        ]
        chassis = robot.bodies[0].replace(mass=mass)
        one = Constrained(robot.replace(bodies=(chassis,), wheels=tuple(wheels)))
        context = one.context(State(jnp.asarray(q), jnp.asarray(w)), u)
        return stacked(one.accelerations(context))

    both = jax.jit(lambda x: jax.jvp(speeding, (x[0], x[1]), (jnp.ones(()), jnp.full((), 0.1))))
    h = 1e-5
    _, slope = both(jnp.array([10.0, 1.0]))
    further, _ = both(jnp.array([10.0 + h, 1.0 + 0.1 * h]))
    nearer, _ = both(jnp.array([10.0 - h, 1.0 - 0.1 * h]))
    assert relative_error(slope, (further - nearer) / (2 * h)) < GRADIENT


@pytest.mark.slow
def test_a_free_base_keeps_the_freedoms_and_its_loads_are_the_weight():
    robot = KINDS["differential_drive"].make()
    planar, free = full_model(robot), full_model(robot, "free")
    for model in (planar, free):
        assert mobility(model, model.default_state().q).freedoms == robot.arrangement.mobility
    l = rb.constraints.multipliers(free, free.default_state())
    loads = l[jnp.array([0, 3, 6])]
    np.testing.assert_allclose(loads.sum(), 9.81 * free.bodies.mass.sum(), rtol=1e-12)
    # about the axle of the driven wheels
    moment = 9.81 * (10.0 * 0.07 + 0.1 * 0.2)
    np.testing.assert_allclose(loads[2] * (0.2 - robot.wheels[2].trail), moment, rtol=1e-9)


def test_what_is_refused():
    robot = KINDS["differential_drive"].make()
    with pytest.raises(UnknownName, match="base"):
        full_model(robot, "flying")
    light = robot.replace(wheels=(robot.wheels[0].replace(inertia=0.0), *robot.wheels[1:]))
    with pytest.raises(InputError, match=r"wheels\[0\]\.inertia"):
        full_model(light)
    with pytest.raises(InputError, match="formulation"):
        Constrained(robot, "kkt")


@pytest.mark.slow
def test_rows_hold_over_a_long_rollout() -> None:
    """The full model's velocities are put back on the rows: 20,000 steps leave them at rounding,
    and the motion stays that of the reduced model to the order of the method."""
    robot = wheeled.kinds()["differential_drive"].make(caster=None)
    u = jnp.array([0.02, -0.02])
    full, reduced = (wheeled.at(robot, f) for f in ("constrained", "reduced"))
    ends = []
    for vehicle in (full, reduced):
        start = wheeled.start(vehicle, twist=[0.5, 0.0, 0.4])
        path = wheeled.rollout(vehicle, start, lambda t, s: u, 0.001, steps=20_000, save_every=2000)
        assert path.success
        ends.append(path)
    context = full.context(State(ends[0].q[-1], ends[0].v[-1]))
    n = context.n
    found = constraint_rates(n, context.shape, context.v)
    np.testing.assert_allclose(np.array(found, float), 0.0, atol=1e-12)
    np.testing.assert_allclose(ends[0].q[-1], ends[1].q[-1], rtol=0, atol=1e-8)


@pytest.mark.parametrize("given", [(), (0.3,)])
def test_the_rate_of_a_steering_is_zero_or_as_given(given):
    n = parameters_of(wheeled.kinds()["tricycle"].make(), jnp.float64)
    rates = [
        float(row.rate)
        for row in model_of(n, steering_rates=given).constraints
        if isinstance(row, SteeringRate)
    ]
    assert rates == [*(given or (0.0,))]
