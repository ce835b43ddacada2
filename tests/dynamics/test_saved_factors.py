"""The gradient of flexible robots: from the acceleration and the factors of the forward pass, as on
a GPU, against the gradient that computes them again; with the motions of the links of ABA, against
the gradient of inverse dynamics, which has none; in float32."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.compiler.jax.programs import Program
from rbjax.dynamics.algorithms import aba
from tests.flexible.beams import ARM
from tests.tolerances import F32_MAX, F64_IDENTITY, F64_TRANSFORM, relative_error

TOLERANCE = {np.float64: F64_TRANSFORM, np.float32: F32_MAX}


@pytest.fixture
def on_gpu(monkeypatch: pytest.MonkeyPatch):
    """Return a function that sets whether derivatives are those of a GPU."""

    def set_gpu(gpu: bool) -> None:
        monkeypatch.setattr(aba, "has_gpu", lambda: gpu)

    return set_gpu


def robot(name: str) -> rb.Model:
    """A planar beam on a hinge; or three in series, which the driver by limbs loops over."""
    one = rb.flexible.beam(0.5, [0, 0, 2.0, 0, 0, 0], {"k_z": 1}, mass=0.5, points=2)
    if name == "hinge":
        return rb.load(ARM).with_beam("rod", one, "upper")
    return in_series(one, 3)


def in_series(one, count: int) -> rb.Model:
    """Return equal beams, the first clamped to the world."""
    model, parent = rb.load("<mujoco/>"), "world"
    for k in range(count):
        model, parent = model.with_beam(f"beam{k}", one, parent), f"beam{k}"
    return model.replace(driver="limbs")


def inputs(model: rb.Model, batch: int, dtype: type = np.float64) -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    return [0.3 * rng.normal(size=(batch, model.nv)).astype(dtype) for _ in range(4)]


def gradient(model: rb.Model, *, inner: bool):
    """Return (q, v, tau, w) -> values and cotangents; inner: whether `vmap` is outside of `vjp`."""
    forward = functools.partial(rb.forward_dynamics, model)

    def pulled(f, q, v, tau, w):
        a, back = jax.vjp(f, q, v, tau)
        return a, back(w)

    if inner:
        return jax.vmap(functools.partial(pulled, forward))
    return functools.partial(pulled, jax.vmap(forward))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "dtype", "inner", "batches"),
    [
        ("hinge", np.float32, True, (3,)), ("hinge", np.float64, True, (0, 1)),
        ("chain", np.float64, False, (0, 3)), ("chain", np.float32, False, (1,)),
    ],
)  # fmt: skip
def test_gradient(name: str, dtype: type, inner: bool, batches: tuple, on_gpu) -> None:
    model = robot(name).astype(dtype)
    for batch in batches:
        given = inputs(model, batch, dtype)
        found = []
        for gpu in (False, True):
            on_gpu(gpu)
            found.append(jax.jit(gradient(model, inner=inner))(*given))
        for x, y in zip(*map(jax.tree.leaves, found), strict=True):
            assert x.shape == y.shape and x.dtype == y.dtype == dtype
            assert not batch or relative_error(x, y) < TOLERANCE[dtype]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hinge", "chain"])
def test_second_derivative_and_derivative_by_the_model(name: str, on_gpu) -> None:
    model = robot(name)
    given, along = inputs(model, 2), inputs(model, 2)[::-1]

    def loss(model, q, v, tau, w):
        return (w * jax.vmap(functools.partial(rb.forward_dynamics, model))(q, v, tau)).sum()

    def second(model, given, along):
        own = jax.grad(loss, (1, 2, 3, 4))
        by_mass = jax.grad(lambda m: loss(with_mass(model, m), *given))
        return jax.jvp(functools.partial(own, model), given, along)[1], by_mass(model.bodies.mass)

    found = []
    for gpu in (False, True):
        on_gpu(gpu)
        found.append(jax.jit(second)(model, tuple(given), tuple(along)))
    for x, y in zip(*map(jax.tree.leaves, found), strict=True):
        assert relative_error(x, y) < F64_TRANSFORM


def with_mass(model: rb.Model, mass: jax.Array) -> rb.Model:
    return model.replace(bodies=model.bodies.replace(mass=mass))


def test_the_forward_pass_has_the_only_factorization(on_gpu) -> None:
    """The divisions of the pivots 1 / D: one for each coordinate, none in the reverse pass."""
    model = robot("hinge")
    given = [jax.ShapeDtypeStruct((5, model.nv), jnp.float64)] * 4
    on_gpu(True)
    forward, back = programs(jax.make_jaxpr(gradient(model, inner=False))(*given).jaxpr)
    assert divisions(forward.closed.jaxpr) == model.nv and divisions(back.closed.jaxpr) == 0
    on_gpu(False)
    _, back = programs(jax.make_jaxpr(gradient(model, inner=False))(*given).jaxpr)
    assert divisions(back.closed.jaxpr) == model.nv


def programs(jaxpr) -> list[Program]:
    """Return the programs of a jaxpr, in order."""
    found = []
    for eqn in jaxpr.eqns:
        if eqn.primitive.name == "threads":
            found.append(eqn.params["program"])
        elif "jaxpr" in eqn.params:
            found += programs(eqn.params["jaxpr"].jaxpr)
    return found


def divisions(jaxpr) -> int:
    """Return the number of divisions of a jaxpr and of the programs that it calls."""
    total = 0
    for eqn in jaxpr.eqns:
        total += eqn.primitive.name == "div"
        inner = [x for x in eqn.params.values() if isinstance(x, Program)]
        total += sum(divisions(x.closed.jaxpr) for x in inner)
    return total


@pytest.mark.slow
def test_motions_of_the_links_change_no_derivative() -> None:
    """dFD = M^-1 (dtau - dID) with the gradient of inverse dynamics at the acceleration, and the
    derivative of both along all arguments."""
    model = robot("chain")
    given, along = inputs(model, 2), inputs(model, 2)[::-1]
    forward, inverse = (
        jax.vmap(functools.partial(f, model)) for f in (rb.forward_dynamics, rb.inverse_dynamics)
    )

    def want(q, v, tau, w):
        a = forward(q, v, tau)
        (rates,) = jax.vjp(lambda tau: forward(q, v, tau), tau)[1](w)
        return *jax.vjp(lambda q, v: inverse(q, v, a), q, v)[1](-rates), rates

    def own(q, v, tau, w):
        return jax.vjp(forward, q, v, tau)[1](w)

    found = [
        jax.jit(functools.partial(jax.jvp, f))(tuple(given), tuple(along)) for f in (own, want)
    ]
    for x, y in zip(*map(jax.tree.leaves, found), strict=True):
        assert relative_error(x, y) < F64_IDENTITY


@pytest.mark.slow
def test_float32() -> None:
    """26 beams in series. From rates alone the motion of the last beams would be a difference of
    large terms: the gradient by q would err by 3e-4 here."""
    inertia = (2e-4, 1e-4, 1e-4)
    one = rb.flexible.beam(
        1 / 26, [1.0, 2.0, 2.0, 0, 0, 0], {"k_y": 0, "k_z": 0}, mass=0.5, inertia=inertia, points=2
    )
    model = in_series(one, 26)
    given = inputs(model, 4)
    exact = jax.jit(gradient(model, inner=False))(*given)
    model = model.astype(jnp.float32)
    found = jax.jit(gradient(model, inner=False))(*(x.astype(np.float32) for x in given))
    for x, y in zip(*map(jax.tree.leaves, (found, exact)), strict=True):
        assert relative_error(x, y) < 3e-5
