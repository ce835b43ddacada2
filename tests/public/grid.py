"""One public function on the whole grid: f32 and f64, batches of 0, 1 and 3, every transformation.

Files named test_composes or test_registry compare derivatives with differences in f64. Here the
same functions must keep the dtype of their arguments, agree with f64 in f32, and work for a batch
of no sample and of one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tests.tolerances import F64_IDENTITY, F64_TRANSFORM, relative_error

BATCHES = (0, 1, 3)
# f32 against f64: rounding of 6e-8 times a condition number of up to 1e4, as for mass matrices of
# the tests' robots. A constant in f32, or TF32, would give 1e-3 and more.
F32 = 1e-3
# An inner product by the forward and by the reverse mode in f32.
F32_ADJOINT = 2e-3


@dataclass(frozen=True)
class Case:
    """A function of arrays.

    make: dtype -> the function. Models that it closes over have this dtype.
    arrays: three samples of each argument, stacked along the first axis.
    f32: tolerance of f32 results relative to f64.
    derivatives: whether the function is differentiable at the samples.
    dtypes: f64 only if the function closes over other arrays in f64, whose dtype wins.
    """

    make: Callable[[Any], Callable[..., Any]]
    arrays: Sequence[np.ndarray]
    f32: float = F32
    derivatives: bool = True
    dtypes: tuple[Any, ...] = (np.float64, np.float32)


def floats(tree: Any) -> list[jax.Array]:
    """The floating arrays of a result. A Python number has no dtype."""
    arrays = (x for x in jax.tree.leaves(tree) if not isinstance(x, (bool, int, float)))
    return [x for x in map(jnp.asarray, arrays) if jnp.issubdtype(x.dtype, jnp.floating)]


def check_types(case: Case) -> None:
    """Dtypes and shapes in f32, JAX's default, by tracing a batch of no sample."""
    dtype = case.dtypes[-1]
    f = case.make(dtype)

    def traced(*arrays: Any) -> list[jax.Array]:
        return floats(f(*arrays))

    none = [jax.ShapeDtypeStruct((0, *np.shape(x)[1:]), dtype) for x in case.arrays]
    results = jax.eval_shape(jax.vmap(traced), *none)
    assert results, "no floating result"
    wrong = [x.dtype for x in results if x.dtype != dtype]
    assert not wrong, f"arguments in {np.dtype(dtype)} give {wrong}"
    assert all(x.shape[0] == 0 for x in results)


def check_grid(case: Case) -> None:
    """f32 and f64; batches of 0, 1 and 3 within jit; both modes of differentiation."""
    results = {}
    last = case.dtypes[-1]
    outside = floats(case.make(last)(*(np.asarray(x[0], last) for x in case.arrays)))
    assert all(x.dtype == last for x in outside), "one sample outside of jit"
    assert all(np.isfinite(x).all() for x in outside), "one sample outside of jit is not finite"
    for dtype in case.dtypes:
        xs = [np.asarray(x, dtype) for x in case.arrays]
        for n in BATCHES:
            f = case.make(dtype)
            many = jax.jit(jax.vmap(lambda *x, f=f: floats(f(*x))))(*(x[:n] for x in xs))
            results[dtype, n] = many
            assert all(x.dtype == dtype for x in many), f"batch of {n}: dtype"
        three = results[dtype, 3]
        for n in BATCHES:
            assert [x.shape for x in results[dtype, n]] == [(n, *x.shape[1:]) for x in three]
        tolerance = F64_TRANSFORM if dtype == np.float64 else case.f32
        for got, want in zip(results[dtype, 1], three, strict=True):
            assert relative_error(got[0], want[0], floor=1.0) <= tolerance, "batches of 1 and 3"
        if case.derivatives:
            check_derivatives(case, dtype)
    if np.float32 not in case.dtypes:
        return
    for got, want in zip(results[np.float32, 3], results[np.float64, 3], strict=True):
        error = relative_error(got, want, batch_dims=1, floor=1.0)
        assert error.max() <= case.f32, f"f32 beside f64: {error}"


def check_derivatives(case: Case, dtype: Any) -> None:
    """<w, J t> is the same by both modes, in the dtype of the arguments, for a batch of 3."""
    f = case.make(dtype)
    xs = tuple(jnp.asarray(x, dtype) for x in case.arrays)
    rng = np.random.default_rng(2)
    ts = tuple(jnp.asarray(rng.normal(size=x.shape), dtype) for x in xs)

    def flat(*x):
        return jnp.concatenate([jnp.ravel(y) for y in floats(f(*x))])

    @jax.jit
    def both(xs, ts):
        values, rates = jax.vmap(lambda x, t: jax.jvp(flat, x, t))(xs, ts)
        weights = jnp.sin(1.0 + jnp.arange(values.size, dtype=dtype)).reshape(values.shape)
        return rates, weights, jax.vmap(lambda x, w: jax.vjp(flat, *x)[1](w))(xs, weights)

    rates, weights, back = both(xs, ts)
    assert rates.dtype == dtype and all(b.dtype == dtype for b in back)
    for k in range(3):
        forward = np.asarray(weights[k], float) * np.asarray(rates[k], float)
        pairs = zip(back, ts, strict=True)
        reverse = [np.asarray(b[k], float) * np.asarray(t[k], float) for b, t in pairs]
        total = sum(x.sum() for x in reverse)
        scale = 1.0 + np.abs(forward).sum() + sum(np.abs(x).sum() for x in reverse)
        tolerance = F64_IDENTITY if dtype == np.float64 else F32_ADJOINT
        assert np.isfinite(total), "the gradient is not finite"
        assert abs(forward.sum() - total) <= tolerance * scale, (forward.sum(), total)


def same(f: Callable) -> Callable[[Any], Callable]:
    """make of a function that closes over no array."""
    return lambda dtype: f
