"""Robots with loops as threads: every formulation's step and gradient, the functions of rows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.mechanisms import four_bars
from rbjax import constraints as rc
from tests.compiler.host import COMPILER, many_on_host
from tests.compiler.test_algorithms import agree, by_xla
from tests.tolerances import F64_PARITY

pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")

DT = 1e-3
slow = pytest.mark.slow
IMPLICIT = [name for name, one in rc.formulations().items() if one.index > 1]
OTHERS = [name for name in rc.formulations() if name not in IMPLICIT]
# one of each kind of algebra
FEW = "projected null_space_qr null_space_svd recursive augmented_lagrangian compliant".split()  # noqa: SIM905


def on_loops(scene: str) -> tuple[rb.Model, rb.State]:
    """Three states of a scene, moving, on its rows."""
    model = rb.load(scene)
    rng = np.random.default_rng(3)
    q = model.default_state().q + 0.1 * rng.normal(size=(3, model.nq))
    state = rb.State(jnp.asarray(q), jnp.asarray(rng.normal(size=(3, model.nv))))
    exact = rc.Projection(iterations=20)
    return model, jax.jit(jax.vmap(lambda s: exact.project(model, 0.0, s)))(state)


def step_of(model: rb.Model, name: str):
    def step(q, v):
        after = rb.step(model, rb.State(q, v), None, DT, constraints=name)
        return after.q, after.v

    return step


def gradient_of(model: rb.Model, name: str):
    step = step_of(model, name)
    return jax.grad(lambda q, v: sum(jnp.sin(x).sum() for x in step(q, v)), argnums=(0, 1))


@pytest.mark.parametrize(
    ("scene", "of", "names"),
    [
        ("four_bar", step_of, FEW),
        pytest.param("four_bar", step_of, [n for n in OTHERS if n not in FEW], marks=slow),
        pytest.param("four_bar", step_of, ["index_2", "index_3"], marks=slow),
        pytest.param("four_bar", step_of, ["ggl"], marks=slow),
        pytest.param("four_bar", gradient_of, OTHERS, marks=slow),
        pytest.param("four_bar", gradient_of, IMPLICIT, marks=slow),
        pytest.param("gripper", step_of, OTHERS, marks=slow),
    ],
)
def test_formulations(scene, of, names):
    model, state = on_loops(scene)
    cases = [(of(model, name), (state.q, state.v)) for name in names]
    for (f, args), got in zip(cases, many_on_host(cases, ("-O0",)), strict=True):
        agree(got, by_xla(f, args), F64_PARITY)


def test_functions_of_rows():
    model, state = on_loops("four_bar")
    functions = [
        lambda q, v: tuple(rc.residual(model, rb.State(q, v))),
        lambda q, v: rc.jacobian(model, q),
        lambda q, v: tuple(rc.constrained_dynamics(model, q, v, jnp.sin(v))),
        lambda q, v: rc.multipliers(model, rb.State(q, v)),
        lambda q, v: rc.joint_wrenches(model, rb.State(q, v)),
    ]
    cases = [(f, (state.q, state.v)) for f in functions]
    for (f, args), got in zip(cases, many_on_host(cases, ("-O0",)), strict=True):
        agree(got, by_xla(f, args), F64_PARITY)


@slow
@pytest.mark.parametrize("name", IMPLICIT)
def test_implicit_steps_across_flat_positions(name):
    """Two parallelograms, 48 unknowns of all stages and more: the second iteration of a thread
    beside that of the CPU, values and gradients. (Of a step that ends on the position, or by GGL
    has a stage next to it, the gradient of a thread is nan.)"""
    model, _ = four_bars(2)
    angles = np.pi / 2 - np.array([0.02, 0.03, 0.06, 0.3])  # two pass, two do not
    signs = np.array([1.0, -1.0, 1.0, -1.0, 1.0])
    q, v = angles[:, None] * signs, np.full((4, 1), 4.9) * signs
    bars = np.random.default_rng(0).normal(size=(2, *q.shape))

    def both(q, v, *bars):
        def step(q, v):
            after = rb.step(model, rb.State(q, v), None, 0.01, constraints=name)
            return after.q, after.v

        out, back = jax.vjp(step, q, v)
        return *out, *back(bars)

    args = q, v, *bars
    (got,) = many_on_host([(both, args)], ("-O0",))
    want = by_xla(both, args)
    # near the position what is solved for is ill-conditioned
    tolerances = 1e-8, 1e-8, *([1e-5, 1e-3] if name == "ggl" else [1e-6, 1e-6])
    for x, y, atol in zip(got, want, tolerances, strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=atol * np.abs(y).max())
