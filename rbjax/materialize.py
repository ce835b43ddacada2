"""`materialize`: a point in the program where XLA's CPU compiler computes values and keeps them.

XLA's CPU fusion copies a producer into every consumer; in a long recursion on lanes each link's
arithmetic is then evaluated again for every use, exponentially often. A variadic `reduce` over an
axis of two equal rows survives the simplifier, fuses with what feeds it into one vectorised loop
with many results, and is not itself copied. Measured on a prototype: a 7-link ABA at
batch 1,024 takes 0.4 us with it and 5 us to minutes without. On other platforms: the identity.

What passes is written and read again, and each array costs a call of the compiled program 0.1 us
more, whatever the batch: the runtime makes anew a buffer for every parameter of every reducer
(humanoid: 1,000 arrays, 150 us a call; a loop inside the program pays it once). So pass what is
dear to compute again, and no more.

`sincos` beside it: XLA's own sine and cosine are scalar calls on the CPU and cost there three times
as much in f32, ten in f64 (benchmarks/cpu_sincos.py). Where XLA's fusion emitters leave a loop of
many results scalar, f32 algorithms of an arm take 1.2 times as long with it, those of G1 0.6 to 0.8
(cpu_algorithms); without the emitters all are faster.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_materialize = Primitive("materialize")
_materialize.multiple_results = True


def materialize(tree: Any, known: Any = ()) -> Any:
    """The same pytree; its arrays are computed once, here. Literals stay literals.

    Arrays that are also in `known` are passed by. (They must be: what goes through together is
    transposed together, so constants of a linear solve must not go with its unknowns.)
    """
    leaves, treedef = jax.tree.flatten(tree)
    passed = {id(x) for x in jax.tree.leaves(known)}
    fresh = {
        id(x): x for x in leaves if isinstance(x, jax.Array) and id(x) not in passed
    }  # each array once, so that equal lanes stay one lane
    if fresh:
        kept = dict(zip(fresh, _materialize.bind(*fresh.values()), strict=True))
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
        if not jnp.issubdtype(dtype, jnp.floating):
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
        for i, y in zip(where, _materialize.bind(*[values[i] for i in where]), strict=True):
            out[i] = y
    return out


_materialize.def_impl(_identity)
_materialize.def_abstract_eval(_identity)
mlir.register_lowering(_materialize, mlir.lower_fun(_identity, multiple_results=True))
mlir.register_lowering(_materialize, mlir.lower_fun(_on_cpu, multiple_results=True), platform="cpu")
ad.primitive_jvps[_materialize] = lambda xs, ts: (_materialize.bind(*xs), _bind_nonzero(ts))
ad.primitive_transposes[_materialize] = lambda cts, *xs: _bind_nonzero(cts)
batching.primitive_batchers[_materialize] = lambda xs, dims: (_materialize.bind(*xs), dims)


_batch_first, _batch_last = Primitive("batch_first"), Primitive("batch_last")


def batch_first(tree: Any) -> Any:
    """The same pytree; under `vmap` its arrays have the batch first.

    What a function with a custom rule returns, and what the rule returns, must have it in one
    place: JAX mixes the two up where `vmap` meets the function inside a `jit`.
    """
    return jax.tree.map(_batch_first.bind, tree)


def batch_last(tree: Any) -> Any:
    """The same pytree; under `vmap` its arrays have the batch last, as GPU threads then leave their
    results: a warp writes whole lines."""
    return jax.tree.map(_batch_last.bind, tree)


def _placed_by(primitive, last):
    def moved(xs, dims):
        at = xs[0].ndim - 1 if last else 0
        return primitive.bind(jnp.moveaxis(xs[0], dims[0], at)), at

    primitive.def_impl(lambda x: x)
    primitive.def_abstract_eval(lambda x: x)
    mlir.register_lowering(primitive, lambda ctx, x: [x])
    ad.deflinear2(primitive, lambda t, x: [t])
    batching.primitive_batchers[primitive] = moved


_placed_by(_batch_first, last=False)
_placed_by(_batch_last, last=True)


_sincos = Primitive("sincos")
_sincos.multiple_results = True


def sincos(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """cos x and sin x. On the CPU and in GPU threads to 1.2e-16 for |x| <= 1e6 (f64) and to 8e-8
    for |x| <= 1e4 (f32), beyond to the spacing of x; elsewhere XLA's own."""
    c, s = _sincos.bind(x)
    return c, s


def _native(x):
    return [jnp.cos(x), jnp.sin(x)]


# Pi / 2 in parts whose multiples are exact, and minimax polynomials on |r| <= pi / 4, of
# (sin r - r) / r^3 and (cos r - 1 + r^2 / 2) / r^4 in r^2: fdlibm's, and Remez' to 0.06 ulp of f32.
_SERIES = {
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
    """cos x and sin x by polynomials of the angle reduced to |r| <= pi / 4."""
    if x.dtype not in _SERIES:
        return _native(x)
    (first, second, third), sines, cosines = _SERIES[x.dtype]
    turns = jnp.floor(x * (2 / jnp.pi) + 0.5)
    r = ((x - turns * first) - turns * second) - turns * third
    r = jnp.clip(r, -0.8, 0.8)  # of an x so large that its neighbours are turns away
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


def horner(coefficients, z):
    """sum_k coefficients_k z^k."""
    out = coefficients[-1]
    for a in coefficients[-2::-1]:
        out = out * z + a
    return out


def _jvp(f, xs, ts):
    (x,), (t,) = xs, ts
    c, s = f(x)
    return [c, s], [-s * t, c * t]


_sincos.def_impl(_native)
_sincos.def_abstract_eval(lambda x: [x, x])
mlir.register_lowering(_sincos, mlir.lower_fun(_native, multiple_results=True))
mlir.register_lowering(
    _sincos, mlir.lower_fun(polynomial_sincos, multiple_results=True), platform="cpu"
)
ad.primitive_jvps[_sincos] = functools.partial(_jvp, _sincos.bind)
batching.primitive_batchers[_sincos] = lambda xs, dims: (_sincos.bind(*xs), [dims[0], dims[0]])
