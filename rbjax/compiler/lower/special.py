"""Lowering rules for special functions that C lacks, by polynomials and series."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.compiler.lower.lowering import Equation, Lowering, rule

#: Giles, *Approximating the erfinv function*, 2010: single precision, central and tail
SINGLE = (
    (2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087,
     -0.00125372503, -0.00417768164, 0.246640727, 1.50140941),
    (-0.000200214257, 0.000100950558, 0.00134934322, -0.00367342844, 0.00573950773,
     -0.0076224613, 0.00943887047, 1.00167406, 2.83297682),
)  # fmt: skip
#: double precision: central, middle and tail
DOUBLE = (
    (-3.6444120640178196996e-21, -1.685059138182016589e-19, 1.2858480715256400167e-18,
     1.115787767802518096e-17, -1.333171662854620906e-16, 2.0972767875968561637e-17,
     6.6376381343583238325e-15, -4.0545662729752068639e-14, -8.1519341976054721522e-14,
     2.6335093153082322977e-12, -1.2975133253453532498e-11, -5.4154120542946279317e-11,
     1.051212273321532285e-09, -4.1126339803469836976e-09, -2.9070369957882005086e-08,
     4.2347877827932403518e-07, -1.3654692000834678645e-06, -1.3882523362786468719e-05,
     0.0001867342080340571352, -0.00074070253416626697512, -0.0060336708714301490533,
     0.24015818242558961693, 1.6536545626831027356),
    (2.2137376921775787049e-09, 9.0756561938885390979e-08, -2.7517406297064545428e-07,
     1.8239629214389227755e-08, 1.5027403968909827627e-06, -4.013867526981545969e-06,
     2.9234449089955446044e-06, 1.2475304481671778723e-05, -4.7318229009055733981e-05,
     6.8284851459573175448e-05, 2.4031110387097893999e-05, -0.0003550375203628474796,
     0.00095328937973738049703, -0.0016882755560235047313, 0.0024914420961078508066,
     -0.0037512085075692412107, 0.005370914553590063617, 1.0052589676941592334,
     3.0838856104922207635),
    (-2.7109920616438573243e-11, -2.5556418169965252055e-10, 1.5076572693500548083e-09,
     -3.7894654401267369937e-09, 7.6157012080783393804e-09, -1.4960026627149240478e-08,
     2.9147953450901080826e-08, -6.7711997758452339498e-08, 2.2900482228026654717e-07,
     -9.9298272942317002539e-07, 4.5260625972231537039e-06, -1.9681778105531670567e-05,
     7.5995277030017761139e-05, -0.00021503011930044477347, -0.00013871931833623122026,
     1.0103004648645343977, 4.8499064014085844221),
)  # fmt: skip


def erf_inv(x: jax.Array) -> jax.Array:
    """Compute the inverse error function by the polynomials of Giles (2010)."""
    w = -jnp.log1p(-x * x)
    if x.dtype == jnp.float64:
        root = jnp.sqrt(w)
        far = jnp.where(
            w < 16, _polynomial(DOUBLE[1], root - 3.25), _polynomial(DOUBLE[2], root - 5)
        )
        p = jnp.where(w < 6.25, _polynomial(DOUBLE[0], w - 3.125), far)
    else:
        far = _polynomial(SINGLE[1], jnp.sqrt(w) - 3)
        p = jnp.where(w < 5, _polynomial(SINGLE[0], w - 2.5), far)
    return jnp.where(jnp.abs(x) == 1, x * jnp.inf, p * x)


def _polynomial(coefficients: tuple[float, ...], x: jax.Array) -> jax.Array:
    """Evaluate a polynomial by Horner's rule, the highest power first."""
    out = jnp.full_like(x, coefficients[0])
    for c in coefficients[1:]:
        out = out * x + c
    return out


def digamma(x: jax.Array) -> jax.Array:
    """Compute the digamma function, the derivative of log Gamma.
    Method: reflection for x < 0.5, recurrence up to 10, then Stirling's series."""
    reflected = x < 0.5
    y = jnp.where(reflected, 1 - x, x)
    shift = jnp.zeros_like(x)
    for _ in range(10):
        low = y < 10
        shift = shift + jnp.where(low, 1 / y, 0)
        y = jnp.where(low, y + 1, y)
    z = 1 / (y * y)
    series = z * (1 / 12 - z * (1 / 120 - z * (1 / 252 - z * (1 / 240 - z * (1 / 132)))))
    out = jnp.log(y) - 0.5 / y - series - shift
    fraction = x - jnp.floor(x)  # tan has period pi
    turned = jnp.where(fraction > 0.5, fraction - 1, fraction)
    out = jnp.where(reflected, out - jnp.pi / jnp.tan(jnp.pi * turned), out)
    out = jnp.where((x < 0) & (x == jnp.floor(x)), jnp.nan, out)
    return jnp.where(x == 0, -jnp.inf, out)


def cumlogsumexp(x: jax.Array, *, axis: int, reverse: bool) -> jax.Array:
    """Compute the logarithm of the cumulative sum of exp(x) along an axis."""
    rows = jnp.moveaxis(x, axis, 0)
    out = list(rows[::-1] if reverse else rows)
    for k in range(1, len(out)):
        out[k] = jnp.logaddexp(out[k - 1], out[k])
    return jnp.moveaxis(jnp.stack(out[::-1] if reverse else out), 0, axis)


FUNCTIONS = {"erf_inv": erf_inv, "digamma": digamma}


def _special(low: Lowering, eqn: Equation, ins: list) -> list:
    return low.evaluate(FUNCTIONS[eqn.primitive.name], *ins, avals=[eqn.invars[0].aval])


rule(*FUNCTIONS)(_special)


@rule("cumlogsumexp")
def _cumlogsumexp(low: Lowering, eqn: Equation, ins: list) -> list:
    f = lambda x: cumlogsumexp(x, **eqn.params)  # noqa: E731
    return low.evaluate(f, *ins, avals=[eqn.invars[0].aval])
