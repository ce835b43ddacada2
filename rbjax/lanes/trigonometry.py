"""Cosine and sine by polynomials.

On the CPU, XLA's own sine and cosine are scalar calls and cost three times as much in f32, ten
times in f64 (benchmarks/cpu/sincos.py). If XLA's fusion emitters leave a loop of many results
scalar, f32 algorithms take 1.2 times as long with the polynomials for an arm, 0.6 to 0.8 for G1
(cpu_algorithms). Without the emitters all are faster.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_sincos = Primitive("sincos")
_sincos.multiple_results = True


def sincos(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """cos x and sin x. On the CPU and in GPU threads the error is 1.2e-16 for |x| <= 1e6 (f64) and
    8e-8 for |x| <= 1e4 (f32), and for larger x the spacing of x. Elsewhere XLA's own."""
    c, s = _sincos.bind(x)
    return c, s


def _native(x):
    return [jnp.cos(x), jnp.sin(x)]


# Pi / 2 in parts whose multiples are exact, and minimax polynomials on |r| <= pi / 4, of
# (sin r - r) / r^3 and (cos r - 1 + r^2 / 2) / r^4 in r^2: fdlibm's, and Remez' to 0.06 ulp of f32.
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
    """cos x and sin x by polynomials of the angle reduced to |r| <= pi / 4."""
    if x.dtype not in SERIES:
        return _native(x)
    (first, second, third), sines, cosines = SERIES[x.dtype]
    turns = jnp.floor(x * (2 / jnp.pi) + 0.5)
    r = ((x - turns * first) - turns * second) - turns * third
    r = jnp.clip(r, -0.8, 0.8)  # for an x so large that its neighbours are turns away
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
