"""Algorithms that run as several kernels: what each emits, run thread by thread on the host."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.compiler.cuda.kernels import kernel
from rbjax.compiler.ir.program import BatchLayout
from rbjax.compiler.jax.primitive import on_gpu
from rbjax.compiler.lower.write import write_program
from rbjax.dynamics.algorithms import columns
from rbjax.dynamics.algorithms.regressor import regressor_by_columns
from rbjax.dynamics.drivers.choice import KERNELS_ABOVE
from tests.compiler.block import emulated
from tests.compiler.host import COMPILER
from tests.compiler.test_algorithms import switch  # noqa: F401 (a fixture)
from tests.dynamics.test_limbs import CART, walker
from tests.tolerances import F64_PARITY, relative_error

BATCH = 5
PUBLIC = {
    "forward": (rb.forward_dynamics_derivatives, columns.forward_by_columns, 3),
    "inverse": (rb.inverse_dynamics_derivatives, columns.inverse_by_columns, 2),
    "mass": (lambda m, q, v, a: rb.inverse_mass_matrix(m, q),
             lambda m, q, v, a: columns.inverse_mass_by_columns(m, q), 2),
    "regressor": (rb.inertial_regressor, regressor_by_columns, 2),
}  # fmt: skip


@functools.cache
def given() -> tuple[rb.Model, list[jax.Array]]:
    """A tree with limbs, a free base, balls and slides."""
    sample = walker(text=CART)
    q, v = sample.states(BATCH)
    a = np.random.default_rng(0).normal(size=v.shape)
    assert sample.model.nv > KERNELS_ABOVE
    return sample.model.replace(driver="auto"), [jnp.asarray(x) for x in (q, v, a)]


@functools.cache
def wanted(name: str) -> list[np.ndarray]:
    model, args = given()
    f = jax.vmap(functools.partial(PUBLIC[name][0], model.replace(driver="rolled")))
    return [np.asarray(x) for x in jax.tree.leaves(jax.jit(f)(*args))]


def agree(got: Any, name: str) -> None:
    for g, w in zip(jax.tree.leaves(got), wanted(name), strict=True):
        assert relative_error(g, w, batch_dims=1, floor=1.0).max() <= F64_PARITY


def layouts(atoms: list, axes: tuple) -> list[BatchLayout]:
    return [BatchLayout(x.aval.shape, own) for x, own in zip(atoms, axes, strict=True)]


def by_kernels(f: Any, *args: Any) -> tuple[list[np.ndarray], list[str]]:
    """f's results with each kernel run on the host, and the sources of the kernels."""
    closed = jax.make_jaxpr(f)(*args)
    known = dict(zip(closed.jaxpr.constvars, closed.consts, strict=True))
    known |= dict(zip(closed.jaxpr.invars, args, strict=True))
    sources = []

    def read(atom: Any) -> Any:
        return atom.val if isinstance(atom, jax.extend.core.Literal) else known[atom]

    for eqn in closed.jaxpr.eqns:
        ins = [read(x) for x in eqn.invars]
        if eqn.primitive.name == "threads":
            how = eqn.params
            places = layouts(eqn.invars, how["ins"]), layouts(eqn.outvars, how["outs"])
            code = kernel(write_program(how["program"].closed, how["batch"], *places))
            sources.append(code.source)
            outs = emulated(code, ins, [v.aval for v in eqn.outvars])
        else:
            outs = eqn.primitive.bind(*ins, **eqn.params)
            outs = outs if eqn.primitive.multiple_results else [outs]
        known |= dict(zip(eqn.outvars, outs, strict=True))
    return [np.asarray(read(x)) for x in closed.jaxpr.outvars], sources


@pytest.mark.parametrize("driver", ["limbs", pytest.param("rolled", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if name == "forward" else ()) for name in PUBLIC],
)
def test_by_columns(name, driver):
    model, args = given()
    f = jax.vmap(functools.partial(PUBLIC[name][1], model.replace(driver=driver)))
    agree(jax.jit(f)(*args), name)


@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("name", ["inverse", *(pytest.param(n, marks=pytest.mark.slow)
                                               for n in ("forward", "mass"))])  # fmt: skip
def test_a_batch_on_a_gpu_is_several_kernels(name, switch):  # noqa: F811
    """The public function within a program is one; by itself on a GPU it goes apart."""
    want, (public, _, count) = wanted(name), PUBLIC[name]
    switch(True)
    model, args = given()
    closed = jax.make_jaxpr(jax.vmap(functools.partial(public, model)))(*args)
    (eqn,) = closed.jaxpr.eqns
    known = dict(zip(closed.jaxpr.invars, args, strict=True))
    operands = [known[x] for x in eqn.invars]
    got, sources = by_kernels(functools.partial(on_gpu, **eqn.params), *operands)
    assert len(sources) == count and len(got) == len(want)
    assert "flush<" in sources[-2].split("QUALIFIED T over_warp")[1]  # whole lines are written
    agree(got, name)
