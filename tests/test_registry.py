"""Every public function of a model and arrays, under jit, vmap, jvp and vjp, on one small robot.

The model is closed over (`check_composes`). A public function that is missing here fails a test.
"""

import functools
import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import sensors
from tests.composing import STEP, check_axes, check_composes
from tests.robots import robot
from tests.tolerances import F64_IDENTITY, F64_TRANSFORM, GRADIENT, relative_error

# public functions that are not functions of a model and arrays: files of their own test them
ELSEWHERE = {
    "compile",
    "compiler_options",
    "load",
    "on_each",
    "operation_count",
    "rollout",
    "scenes",
    "simulate",
    "simulate_impacts",
    "tendon_reach",
    "threads",
    "write_back",
    "write_mjcf",
}


@dataclass(frozen=True)
class Entry:
    """What a function takes after the model: names of arrays, then values that stay."""

    function: Callable[..., Any]
    arrays: tuple[str, ...]
    rest: dict[str, Any] = field(default_factory=dict)
    robot: str = "small"  # a smaller one for what differentiates by itself: a program of a minute


def _with_state(model, q, v, ctrl):
    return rb.applied_forces(model, rb.State(q, v), ctrl)


def _step(model, q, v, ctrl):
    after = rb.step(model, rb.State(q, v), ctrl, 0.01)
    return after.q, after.v


def _acceleration(model, q, v, ctrl):
    return rb.acceleration(model, rb.State(q, v), ctrl)


def _sense(model, q, v, ctrl):
    site, body = model.site_names[-1], model.body_names[-1]
    kinds = (sensors.Accelerometer(site), sensors.ForceSensor(body), sensors.Attitude(site))
    model = model.replace(sensors=tuple(sensors.NamedSensor(f"{x}", x) for x in kinds))
    return rb.sense(model, rb.State(q, v), ctrl)


def _linearise(model, q, v, ctrl):
    return rb.linearise(model, rb.State(q, v), ctrl)


def _parameters(model, mass, com):
    return rb.inertial_parameters(model.replace(bodies=model.bodies.replace(mass=mass, com=com)))


def _at_a_point(function):
    return lambda model, *x, body: function(model, *x[:-1], body, x[-1])


REGISTRY = {
    "acceleration": Entry(_acceleration, ("q", "v", "ctrl")),
    "applied_forces": Entry(_with_state, ("q", "v", "ctrl")),
    "bias_forces": Entry(rb.bias_forces, ("q", "v")),
    "body_velocities": Entry(rb.body_velocities, ("q", "v")),
    "center_of_mass": Entry(rb.center_of_mass, ("q",)),
    "centroidal_momentum": Entry(rb.centroidal_momentum, ("q", "v")),
    "coriolis_matrix": Entry(rb.coriolis_matrix, ("q", "v")),
    "difference": Entry(rb.difference, ("q", "q1")),
    "elastic_energy": Entry(rb.forces.elastic_energy, ("q",)),
    "forward_dynamics": Entry(rb.forward_dynamics, ("q", "v", "a", "wrenches")),
    "forward_dynamics_derivatives": Entry(
        rb.forward_dynamics_derivatives, ("q", "v", "a"), robot="cart_pole"
    ),
    "forward_kinematics": Entry(rb.forward_kinematics, ("q",)),
    "frame_bias_acceleration": Entry(
        _at_a_point(rb.frame_bias_acceleration), ("q", "v", "point"), {"body": "hand"}
    ),
    "frame_pose": Entry(_at_a_point(rb.frame_pose), ("q", "point"), {"body": "hand"}),
    "frame_velocity": Entry(rb.frame_velocity, ("q", "v"), {"site": "tip"}),
    "generalized_forces": Entry(rb.dynamics.generalized_forces, ("q", "wrenches")),
    "gravity_forces": Entry(rb.gravity_forces, ("q",)),
    "inertial_parameters": Entry(_parameters, ("mass", "com")),
    "inertial_regressor": Entry(rb.inertial_regressor, ("q", "v", "a"), robot="cart_pole"),
    "integrate": Entry(rb.integrate, ("q", "v")),
    "inverse_dynamics": Entry(rb.inverse_dynamics, ("q", "v", "a", "wrenches")),
    "inverse_dynamics_derivatives": Entry(
        rb.inverse_dynamics_derivatives, ("q", "v", "a"), robot="cart_pole"
    ),
    "inverse_mass_matrix": Entry(rb.inverse_mass_matrix, ("q",)),
    "jacobian": Entry(_at_a_point(rb.jacobian), ("q", "point"), {"body": "hand"}),
    "jacobian_rate": Entry(rb.jacobian_rate, ("q", "v"), {"site": "tip"}),
    "kinetic_energy": Entry(rb.kinetic_energy, ("q", "v")),
    "linearise": Entry(_linearise, ("q", "v", "ctrl"), robot="cart_pole"),
    "lagrange_coefficients": Entry(rb.lagrange_coefficients, ("q",), robot="cart_pole"),
    "mass_matrix": Entry(rb.mass_matrix, ("q",)),
    "potential_energy": Entry(rb.potential_energy, ("q",)),
    "sense": Entry(_sense, ("q", "v", "ctrl")),
    "step": Entry(_step, ("q", "v", "ctrl")),
    "tendon_jacobian": Entry(rb.tendon_jacobian, ("q",), robot="tendons"),
    "tendon_lengths": Entry(rb.tendon_lengths, ("q",), robot="tendons"),
}

MODEL = robot("small", "rolled").model


def samples(names: tuple[str, ...], of: str = "small", n: int = 3) -> list[np.ndarray]:
    """n of each named array, one behind the other; attitudes of unit length."""
    q, v = robot(of).states(2 * n)
    rng = np.random.default_rng(0)
    model, bodies = robot(of).model, MODEL.bodies
    drawn = {
        "q": q[:n],
        "q1": q[n:],
        "v": v[:n],
        "a": rng.normal(size=(n, model.nv)),
        "ctrl": rng.uniform(-0.4, 0.4, (n, model.nu)),
        "wrenches": rng.normal(size=(n, 4, 6)),
        "mass": np.asarray(bodies.mass) * rng.uniform(0.5, 2, (n, 4)),
        "com": np.asarray(bodies.com) + rng.normal(size=(n, 4, 3)),
        "point": rng.normal(size=(n, 3)),
    }
    return [drawn[name] for name in names]


# of every kind of joint, these are the derivative of a derivative
LARGE = [n for n, entry in REGISTRY.items() if entry.robot != "small"]
CASES = [(n, entry.robot) for n, entry in REGISTRY.items()]
CASES += [pytest.param(n, "small", marks=pytest.mark.slow) for n in LARGE]


@pytest.mark.parametrize(("name", "of"), CASES)
def test_composes(name: str, of: str) -> None:
    check(name, of, "unrolled")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "of"), CASES)
def test_composes_by_loops_over_joints(name: str, of: str) -> None:
    check(name, of, "rolled")


def check(name: str, of: str, driver: str) -> None:
    entry, model = REGISTRY[name], robot(of, driver).model
    function = functools.partial(entry.function, model, **entry.rest)
    check_composes(function, samples(entry.arrays, of))


@pytest.mark.parametrize(("name", "of"), CASES)
def test_a_compiled_function_mapped_and_differentiated(name: str, of: str) -> None:
    """jvp of vmap of jit: results of a custom rule keep their axes (JAX trusts the rule)."""
    entry, model = REGISTRY[name], robot(of, "unrolled").model
    function = functools.partial(entry.function, model, **entry.rest)
    check_axes(function, samples(entry.arrays, of))


def test_a_batch_as_large_as_the_robot() -> None:
    """The same values, where equal sizes would hide mixed-up axes."""
    model = robot("double_pendulum", "unrolled").model
    q, v = np.random.default_rng(3).normal(size=(2, 2, 2))

    def f(q, v):
        return rb.forward_dynamics(model, q, v, -v)

    def both(f, q, v):
        return jax.jvp(f, (q, v), (v, q))

    mapped = jax.jit(lambda q, v: both(jax.vmap(jax.jit(f)), q, v))(q, v)
    looped = [jax.jit(lambda q, v: both(f, q, v))(*x) for x in zip(q, v, strict=True)]
    for got, want in zip(mapped, zip(*looped, strict=True), strict=True):
        assert relative_error(got, np.stack(want)) <= F64_TRANSFORM


def test_derivatives_with_respect_to_the_model() -> None:
    """jvp = central difference = vjp along a direction in which every float leaf moves."""
    q, v, a, w = (x[0] for x in samples(("q", "v", "a", "wrenches")))
    model = robot("small", "unrolled").model
    rng = np.random.default_rng(2)
    weight = rng.normal(size=5)
    direction = jax.tree.map(lambda x: np.asarray(rng.normal(size=x.shape)) / 20, model)
    I = direction.bodies.inertia
    symmetric = (I + I.swapaxes(1, 2)) / 20
    direction = direction.replace(bodies=direction.bodies.replace(inertia=symmetric))

    @jax.jit
    def at_both_ends_and_between(direction):
        def one(side):
            m = jax.tree.map(lambda x, d: x + side * STEP * d, model, direction)
            value, linear = jax.linearize(lambda m: rb.forward_dynamics(m, q, v, a, w), m)
            return value, linear(direction), jax.linear_transpose(linear, m)(weight)[0]

        return jax.vmap(one)(jnp.array([-1.0, 0.0, 1.0]))

    values, rates, gradients = at_both_ends_and_between(direction)
    rate = np.asarray(rates[1])
    difference = (values[2] - values[0]) / (2 * STEP)
    assert relative_error(rate, difference, floor=1.0) <= GRADIENT
    pairs = zip(jax.tree.leaves(gradients), jax.tree.leaves(direction), strict=True)
    by_reverse = sum(float((np.asarray(g)[1] * d).sum()) for g, d in pairs)
    assert abs(by_reverse - weight @ rate) <= F64_IDENTITY * max(1.0, np.abs(rate).max() * 5)


def test_eager_is_jit() -> None:
    """Op by op, with compilation switched off altogether."""
    q, v, a = (x[0] for x in samples(("q", "v", "a")))
    model = robot("double_pendulum", "unrolled").model
    q, v, a = q[:2], v[:2], a[:2]
    for function, args in ((rb.forward_dynamics, (q, v, a)), (rb.inverse_dynamics, (q, v, a))):
        want = function(model, *args)
        with jax.disable_jit():
            got = function(model, *args)
        assert relative_error(got, want) <= F64_TRANSFORM


def is_function(value: object) -> bool:
    return inspect.isroutine(value)


def test_no_public_function_is_missing() -> None:
    public: set[str] = set()
    for room in (rb, rb.dynamics, rb.forces):
        members = {name: getattr(room, name) for name in room.__all__}
        public |= {name for name, value in members.items() if is_function(value)}
    missing = public - REGISTRY.keys() - ELSEWHERE
    assert not missing, f"give {sorted(missing)} an entry in tests/test_registry.py"
    assert REGISTRY.keys() | ELSEWHERE <= public
    here = Path(__file__)
    texts = (path.read_text() for path in here.parent.rglob("test_*.py") if path != here)
    called = {name for text in texts for name in re.findall(r"(\w+)\(", text)}
    assert called >= ELSEWHERE, f"no test calls {sorted(ELSEWHERE - called)}"


# ------------------------------------------------------------------- what the door says


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda m, q, v: rb.bias_forces(m, q[:3], v), ["bias_forces: q", "(3,)", "(6,)"]),
        (lambda m, q, v: rb.bias_forces(m, np.stack([q, q]), v), ["(2, 6)", "jax.vmap"]),
        (lambda m, q, v: rb.bias_forces(m, q * np.nan, v), ["q[0] is nan", "finite"]),
        (lambda m, q, v: rb.bias_forces(m, q, v + np.inf), ["v[0] is inf", "finite"]),
        (lambda m, q, v: rb.bias_forces(m, 0 * q, v), ["q[2:6]", "zero quaternion"]),
        (lambda m, q, v: rb.bias_forces(m, q + 0j, v), ["complex", "float32 or float64"]),
        (lambda m, q, v: rb.bias_forces(m, q, "fast"), ["v is str", "array"]),
        (lambda m, q, v: rb.bias_forces("robot", q, v), ["'robot'", "Model"]),
        (lambda m, q, v: rb.applied_forces(m, q), ["state", "State(q, v)"]),
        (lambda m, q, v: rb.applied_forces(m, rb.State(q, v), v[:1]), ["ctrl", "(5,)"]),
        (lambda m, q, v: rb.jacobian(m, q, "hand", point=v), ["point", "(3,)"]),
        (lambda m, q, v: rb.dynamics.generalized_forces(m, q, v), ["wrenches", "(4, 6)"]),
    ],
    ids=range(12),
)
def test_wrong_arguments_are_refused_in_a_sentence(call, words: list[str]) -> None:
    q, v = (x[0] for x in samples(("q", "v")))
    with pytest.raises(rb.InputError) as caught:
        call(MODEL, q, v)
    for word in words:
        assert word in str(caught.value)


def test_unknown_names_list_the_names() -> None:
    (q,) = (x[0] for x in samples(("q",)))
    with pytest.raises(rb.UnknownName, match=r"unknown body 'nose'.*'slider', 'swinger', 'hand'"):
        rb.jacobian(MODEL, q, "nose")
    with pytest.raises(rb.UnknownName, match=r"unknown site 'nose'.*'tip'"):
        rb.frame_pose(MODEL, q, site="nose")


def test_dtypes() -> None:
    q, v = (x[0] for x in samples(("q", "v")))
    single = rb.bias_forces(MODEL, q.astype(np.float32), v.astype(np.float32))
    assert single.dtype == jnp.float32
    assert rb.bias_forces(MODEL, q, v.astype(np.float32)).dtype == jnp.float64
    assert rb.bias_forces(MODEL, [0, 0, 1, 0, 0, 0], [0] * 5).dtype == jnp.float64  # integers


def _types(tree: Any) -> list:
    return [(x.shape, x.dtype) for x in jax.tree.leaves(tree)]


@pytest.mark.parametrize("name", REGISTRY)
def test_only_the_dtype_of_q_and_v_counts(name: str) -> None:
    """A control of NumPy's zeros does not turn a motion in f32 into one in f64."""
    entry = REGISTRY[name]
    if entry.function.__name__ == "_parameters":
        return
    function = functools.partial(entry.function, MODEL.astype(jnp.float32), **entry.rest)
    leading = {"q", "q1", "v"} if name != "integrate" else {"q"}
    arrays = [x[0].astype(np.float32 if n in leading else np.float64)
              for n, x in zip(entry.arrays, samples(entry.arrays), strict=True)]  # fmt: skip
    found = {d for _, d in _types(jax.eval_shape(function, *arrays))}
    assert found == {jnp.dtype(jnp.float32)}


def test_a_scan_over_steps_of_f32_with_controls_of_f64() -> None:
    model = rb.load("cart_pole").astype(jnp.float32)
    state = jax.tree.map(lambda x: x.astype(jnp.float32), model.default_state())

    def once(state, _):
        return rb.step(model, state, np.zeros(model.nu)), None

    after = jax.eval_shape(lambda s: jax.lax.scan(once, s, None, length=2)[0], state)
    assert _types(after) == _types(state)
