"""JAX primitives on lanes: fusion barrier, position of a batch, inverse, cosine and sine.

XLA's CPU fusion copies a producer into every consumer. In a long recursion on lanes the arithmetic
of each link is then evaluated again for every use, exponentially often. A variadic `reduce` over an
axis of two equal rows survives the simplifier, fuses with its producers into one vectorised loop
with many results, and is not itself copied. `fusion_barrier` is this reduction on the CPU, and the
identity on other platforms. Each array in a barrier has a cost at run time, so pass only values
that are expensive to recompute.

On the CPU, XLA's own cosine and sine are scalar calls, and `sincos` uses polynomials instead.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_fusion_barrier = Primitive("fusion_barrier")
_fusion_barrier.multiple_results = True


def fusion_barrier(tree: Any, known: Any = ()) -> Any:
    """Return a pytree whose arrays are computed once, at this point. Literals stay literals.

    Arrays that are also in `known` bypass the barrier. Use it for the constants of a linear solve:
    arrays in one barrier are transposed together, so constants must not share it with unknowns.
    """
    leaves, treedef = jax.tree.flatten(tree)
    passed = {id(x) for x in jax.tree.leaves(known)}
    fresh = {
        id(x): x for x in leaves if isinstance(x, jax.Array) and id(x) not in passed
    }  # equal lanes stay one lane
    if fresh:
        kept = dict(zip(fresh, _fusion_barrier.bind(*fresh.values()), strict=True))
        leaves = [kept.get(id(x), x) for x in leaves]
    return jax.tree.unflatten(treedef, leaves)


def _identity(*xs):
    return list(xs)


def _on_cpu(*xs):
    groups: dict = {}
    for i, x in enumerate(xs):
        groups.setdefault((x.shape, x.dtype), []).append(i)
    out = list(xs)
    for (shape, dtype), where in groups.items():
        if not jnp.issubdtype(dtype, jnp.inexact):
            continue
        twice = tuple(jnp.broadcast_to(xs[i][None], (2, *shape)) for i in where)
        start = (jnp.zeros((), dtype),) * len(where)
        for i, y in zip(where, lax.reduce(twice, start, lambda a, b: b, (0,)), strict=True):
            out[i] = y
    return out


def _bind_nonzero(values):
    out = list(values)
    where = [i for i, t in enumerate(values) if type(t) is not ad.Zero]
    if where:
        for i, y in zip(where, _fusion_barrier.bind(*[values[i] for i in where]), strict=True):
            out[i] = y
    return out


def whole_cotangent(x: jax.Array) -> jax.Array:
    """Return x, and replace a symbolic zero cotangent by an array of zeros.
    The transpose of a `scan` does not accept symbolic zeros for its columns (jax 0.10.2)."""
    return _whole.bind(x)[0]


_whole = Primitive("fusion_barrier")  # a name that `rbjax.compiler` treats as an identity
_whole.multiple_results = True
_whole.def_impl(_identity)
_whole.def_abstract_eval(_identity)
mlir.register_lowering(_whole, mlir.lower_fun(_identity, multiple_results=True))
ad.primitive_jvps[_whole] = lambda xs, ts: (
    _whole.bind(*xs), [t if type(t) is ad.Zero else _whole.bind(t)[0] for t in ts]
)  # fmt: skip
ad.primitive_transposes[_whole] = lambda cts, *xs: [ad.instantiate_zeros(ct) for ct in cts]
batching.primitive_batchers[_whole] = lambda xs, dims: (_whole.bind(*xs), dims)

_fusion_barrier.def_impl(_identity)
_fusion_barrier.def_abstract_eval(_identity)
mlir.register_lowering(_fusion_barrier, mlir.lower_fun(_identity, multiple_results=True))
mlir.register_lowering(
    _fusion_barrier, mlir.lower_fun(_on_cpu, multiple_results=True), platform="cpu"
)
ad.primitive_jvps[_fusion_barrier] = lambda xs, ts: (_fusion_barrier.bind(*xs), _bind_nonzero(ts))
ad.primitive_transposes[_fusion_barrier] = lambda cts, *xs: _bind_nonzero(cts)
batching.primitive_batchers[_fusion_barrier] = lambda xs, dims: (_fusion_barrier.bind(*xs), dims)


_batch_first, _batch_last = Primitive("batch_first"), Primitive("batch_last")


def batch_first(tree: Any, like: Any = ()) -> Any:
    """Move the batch axis of `vmap` to the front of all arrays.

    If an array of `like` is batched, all results are batched. Use it in functions with a custom
    derivative rule: the function and its rule must return the batch at the same axis. JAX confuses
    the two if `vmap` transforms the function inside a `jit`, and loses the batch of a constant.
    """
    arrays = jax.tree.leaves(like)
    return jax.tree.map(lambda x: _batch_first.bind(x, *arrays), tree)


def batch_last(tree: Any) -> Any:
    """Move the `vmap` axis to the end, so that GPU warps write whole cache lines."""
    return jax.tree.map(_batch_last.bind, tree)


def _placed_by(primitive, last):
    def moved(xs, dims):
        x, dim = xs[0], dims[0]
        if dim is None:
            size = next(y.shape[d] for y, d in zip(xs, dims, strict=True) if d is not None)
            x, dim = jnp.broadcast_to(x, (size, *x.shape)), 0
        at = x.ndim - 1 if last else 0
        return primitive.bind(jnp.moveaxis(x, dim, at), *xs[1:]), at

    def jvp(primals, tangents):
        rate = tangents[0]
        if not isinstance(rate, ad.Zero):
            rate = primitive.bind(rate, *primals[1:])
        return primitive.bind(*primals), rate

    primitive.def_impl(lambda x, *like: x)
    primitive.def_abstract_eval(lambda x, *like: x)
    mlir.register_lowering(primitive, lambda ctx, x, *like: [x])
    ad.primitive_jvps[primitive] = jvp
    ad.primitive_transposes[primitive] = lambda t, x, *like: [t, *[None] * len(like)]
    batching.primitive_batchers[primitive] = moved


_placed_by(_batch_first, last=False)
_placed_by(_batch_last, last=True)


_inverse = Primitive("inverse")
_inverse.multiple_results = True


def inverse(*parts: jax.Array) -> list[jax.Array]:
    """Invert a matrix (n, n), given as a real array or as its real and imaginary part.

    The derivative is dX = -X dA X. Use the inverse for many solves with one matrix: a product is
    faster than two triangular solves. GPU threads (`rbjax.compiler`) have no complex numbers.
    """
    return _inverse.bind(*parts)


def _native_inverse(*parts):
    if len(parts) == 1:
        return [jnp.linalg.inv(parts[0])]
    found = jnp.linalg.inv(jax.lax.complex(*parts))
    return [found.real, found.imag]


def _inverse_jvp(parts, changes):
    found = _inverse.bind(*parts)
    changes = [ad.instantiate_zeros(x) for x in changes]
    moved = _product(_product(found, changes), found)
    return found, [-x for x in moved]


def _product(a, b):
    """Multiply two matrices, each given as [real] or as [real, imaginary]."""
    precision = jax.lax.Precision.HIGHEST
    of = [[jnp.matmul(x, y, precision=precision) for y in b] for x in a]
    return of[0] if len(a) == 1 else [of[0][0] - of[1][1], of[0][1] + of[1][0]]


def _batched(parts, dims):
    size = next(x.shape[d] for x, d in zip(parts, dims, strict=True) if d is not None)
    front = [batching.bdim_at_front(x, d, size) for x, d in zip(parts, dims, strict=True)]
    return _inverse.bind(*front), [0] * len(parts)


_inverse.def_impl(lambda *parts: jax.jit(_native_inverse)(*parts))
_inverse.def_abstract_eval(lambda *parts: list(parts))
mlir.register_lowering(_inverse, mlir.lower_fun(_native_inverse, multiple_results=True))
ad.primitive_jvps[_inverse] = _inverse_jvp
batching.primitive_batchers[_inverse] = _batched


_sincos = Primitive("sincos")
_sincos.multiple_results = True


def sincos(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute cos x and sin x.

    On the CPU and in GPU threads the error is at most 1.2e-16 for |x| <= 1e6 in float64, 8e-8 for
    |x| <= 1e4 in float32, and the spacing of floating-point numbers at x for larger |x|.
    """
    c, s = _sincos.bind(x)
    return c, s


def _native_sincos(x):
    return [jnp.cos(x), jnp.sin(x)]


# dtype -> pi / 2 as a sum of parts whose multiples are exact, and the coefficients of
# (sin r - r) / r^3 and (cos r - 1 + r^2 / 2) / r^4 in r^2: minimax polynomials on |r| <= pi / 4,
# from fdlibm for float64, and by the Remez algorithm for float32.
SERIES = {
    jnp.dtype(jnp.float64): (
        (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21),
        (
            -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04,
            2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10,
        ),
        (
            4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05,
            -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11,
        ),
    ),
    jnp.dtype(jnp.float32): (
        (1.5703125, 4.837512969970703e-4, 7.549790126404332e-8),
        (-1.6666655242443085e-1, 8.332177996635437e-3, -1.9517214968800545e-4),
        (4.166664555668831e-2, -1.3887366512790322e-3, 2.443835728627164e-5),
    ),
}  # fmt: skip


def polynomial_sincos(x: jax.Array) -> list:
    """Compute [cos x, sin x] by polynomials, after reduction of the angle to |r| <= pi / 4."""
    if x.dtype not in SERIES:
        return _native_sincos(x)
    (first, second, third), sines, cosines = SERIES[x.dtype]
    turns = jnp.floor(x * (2 / jnp.pi) + 0.5)
    r = ((x - turns * first) - turns * second) - turns * third
    r = jnp.clip(r, -0.8, 0.8)  # for x whose spacing is more than a turn
    z = r * r
    sine = r + r * z * horner(sines, z)
    cosine = 1.0 - z * (0.5 - z * horner(cosines, z))
    quarter = turns - 4.0 * jnp.floor(turns * 0.25)
    odd = (quarter == 1.0) | (quarter == 3.0)
    s, c = jnp.where(odd, cosine, sine), jnp.where(odd, sine, cosine)
    return [
        jnp.where((quarter == 1.0) | (quarter == 2.0), -c, c),
        jnp.where(quarter >= 2.0, -s, s),
    ]


def horner(coefficients: Any, z: Any) -> Any:
    """Evaluate the polynomial sum_k coefficients_k z^k."""
    out = coefficients[-1]
    for a in coefficients[-2::-1]:
        out = out * z + a
    return out


def _sincos_jvp(f, xs, ts):
    (x,), (t,) = xs, ts
    c, s = f(x)
    return [c, s], [-s * t, c * t]


_sincos.def_impl(_native_sincos)
_sincos.def_abstract_eval(lambda x: [x, x])
mlir.register_lowering(_sincos, mlir.lower_fun(_native_sincos, multiple_results=True))
mlir.register_lowering(
    _sincos, mlir.lower_fun(polynomial_sincos, multiple_results=True), platform="cpu"
)
ad.primitive_jvps[_sincos] = functools.partial(_sincos_jvp, _sincos.bind)
batching.primitive_batchers[_sincos] = lambda xs, dims: (_sincos.bind(*xs), [dims[0], dims[0]])
