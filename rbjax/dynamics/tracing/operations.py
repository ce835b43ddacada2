"""The number of arithmetic operations of a function, counted in its traced program.

The function is traced to a jaxpr. Only operations that a result needs are counted. An operation on
an array counts once per element, and the body of a loop once per iteration. Data movement (reshape,
slice, gather, select, compare, convert), signs and integer arithmetic are not counted. Textbooks
count by the same rule, e.g. Featherstone, *Rigid Body Dynamics Algorithms*, table 10.1. An unknown
primitive raises an error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.compiler.lower.control import over_time
from rbjax.errors import InputError, UnknownName
from rbjax.model import Model


@dataclass(frozen=True)
class OperationCount:
    """Numbers of floating-point operations.

    additions, multiplications, divisions: as traced.
    roots: square roots.
    trigonometry: transcendental functions.
    """

    additions: int = 0
    multiplications: int = 0
    divisions: int = 0
    roots: int = 0
    trigonometry: int = 0

    @property
    def total(self) -> int:
        """The sum of all kinds."""
        return sum(getattr(self, f.name) for f in fields(self))

    def __add__(self, other: OperationCount) -> OperationCount:
        names = [f.name for f in fields(self)]
        return OperationCount(*(getattr(self, n) + getattr(other, n) for n in names))

    def __rmul__(self, times: int) -> OperationCount:
        return OperationCount(*(times * getattr(self, f.name) for f in fields(self)))


def operation_count(fn: Callable, *args: Any, traced: Sequence[str] = ()) -> OperationCount:
    """Count the arithmetic operations of `fn(*args)`, without operations that no result needs.

    A `Model` among the arguments is closed over: its leaves are compile-time constants, except the
    leaves in `traced`. Structural zeros of constant leaves cost nothing.

    Args:
        fn: any traceable function.
        args: the arguments of fn: arrays, pytrees of arrays, models.
        traced: dotted names of model leaves that stay inputs, such as "bodies.mass".

    Returns:
        `OperationCount` (additions, multiplications, divisions, roots, trigonometry, total).
        A `while` counts one iteration, a `cond` its most expensive branch.

    Raises:
        UnknownName: a name in `traced` is not a leaf of the model.
        InputError: the function computes floating-point numbers with a primitive whose operations
            are not known, such as an FFT or an eigenvalue.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax.dynamics.tracing.operations import operation_count
        >>> operation_count(lambda x: jnp.sin(x) * x + 1.0, 2.0)
        OperationCount(additions=1, multiplications=1, divisions=0, roots=0, trigonometry=1)
    """
    if not callable(fn):
        raise InputError(f"operation_count: fn is {type(fn).__name__}, expected a function")
    models = {i: a for i, a in enumerate(args) if isinstance(a, Model)}
    given = {i: {name: _leaf(m, name) for name in traced} for i, m in models.items()}
    inputs = {i: a for i, a in enumerate(args) if i not in models}

    def closed(inputs: dict[int, Any], given: dict[int, dict[str, Any]]) -> Any:
        filled = dict(inputs)
        for i, model in models.items():
            for name, value in given[i].items():
                model = _with_leaf(model, name, value)
            filled[i] = model
        return fn(*(filled[i] for i in range(len(args))))

    jaxpr = jax.make_jaxpr(closed)(inputs, given).jaxpr
    return _walk(jaxpr, [True] * len(jaxpr.outvars))[0]


def _leaf(model: Model, name: str) -> jax.Array:
    value: Any = model
    for part in name.split("."):
        value = getattr(value, part, None)
    if not eqx.is_array(value):
        raise UnknownName("leaf of Model", name, leaf_names(model))
    return jnp.asarray(value)


def _with_leaf(model: Model, name: str, value: Any) -> Model:
    def where(m: Model) -> Any:
        for part in name.split("."):
            m = getattr(m, part)
        return m

    return eqx.tree_at(where, model, value)


def leaf_names(model: Model) -> tuple[str, ...]:
    """Return the dotted names of the leaves of a model, for `operation_count(traced=...)`.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.dynamics.tracing.operations import leaf_names
        >>> "bodies.mass" in leaf_names(rb.load("pendulum"))
        True
    """
    paths = jax.tree_util.tree_flatten_with_path(model)[0]
    return tuple(jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in paths)


_ADDITIONS = {"add", "sub", "add_any", "scatter-add", "scatter-sub", "cumsum"}
_MULTIPLICATIONS = {"mul", "square", "cumprod", "scatter-mul"}
_ROOTS = {"sqrt", "rsqrt", "cbrt"}
_TRIGONOMETRY = {
    "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "asinh",
    "acosh", "atanh", "exp", "exp2", "expm1", "log", "log1p", "log2", "logistic", "pow", "erf",
    "erfc", "erf_inv", "lgamma", "digamma", "bessel_i0e", "bessel_i1e", "logaddexp",
}  # fmt: skip
_REDUCTIONS = {"reduce_sum": "additions", "reduce_prod": "multiplications"}
#: primitives that cost nothing: data movement, comparisons, conversions, signs
_FREE = {
    "abs", "argsort", "bitcast_convert_type", "broadcast_in_dim", "ceil", "clamp", "complex",
    "concatenate", "conj", "convert_element_type", "copy", "copy_p", "copysign", "cummax", "cummin",
    "device_put", "dynamic_slice", "dynamic_update_slice", "empty", "empty2", "expand_dims",
    "floor", "full", "gather", "imag", "iota", "max", "min", "name", "neg", "nextafter",
    "optimization_barrier", "pad", "pbroadcast", "pvary", "real", "reduce_max", "reduce_min",
    "reduce_precision", "reshape", "reshard", "rev", "round", "scatter", "scatter-max",
    "scatter-min", "scatter_max", "scatter_min", "select_n", "sharding_constraint", "sign", "slice",
    "sort", "split", "squeeze", "stack", "stop_gradient", "tile", "top_k", "transpose", "unstack",
}  # fmt: skip


def _walk(jaxpr: Any, wanted: Sequence[bool]) -> tuple[OperationCount, list[bool]]:
    """Count the operations of a jaxpr for its `wanted` results, and return the inputs they need."""
    live = {v for v, w in zip(jaxpr.outvars, wanted, strict=True) if w and _is_variable(v)}
    count = OperationCount()
    for eqn in reversed(jaxpr.eqns):
        out = [v in live for v in eqn.outvars]
        if not any(out):
            continue
        here, needs = _equation(eqn, out)
        count = count + here
        live.update(v for v, n in zip(eqn.invars, needs, strict=True) if n and _is_variable(v))
    return count, [v in live for v in jaxpr.invars]


def _is_variable(v: Any) -> bool:
    return not hasattr(v, "val")  # a Literal has one


def _equation(eqn: Any, out: list[bool]) -> tuple[OperationCount, list[bool]]:
    """Count the operations of one equation, and return which inputs its wanted results need."""
    name, params = eqn.primitive.name, eqn.params
    if name == "fusion_barrier":
        return OperationCount(), out
    if name == "batch_first":
        return OperationCount(), out + [False] * (len(eqn.invars) - 1)
    if name == "scan":
        return _scan(eqn, out)
    if name == "threads":  # a kernel of a GPU: its program, once a sample
        count, needs = _walk(params["program"].closed.jaxpr, out)
        return math.prod(params["batch"]) * count, needs
    if name == "threads_tangent":  # the derivative of such a kernel
        tangent = params["program"].tangent(params["moving"])
        count, needs = _walk(tangent.closed.jaxpr, out)
        return math.prod(params["batch"]) * count, needs
    if name == "sincos":
        return OperationCount(trigonometry=sum(out) * math.prod(eqn.outvars[0].aval.shape)), [True]
    if name == "while":
        body = _open(params["body_jaxpr"])
        test = _open(params["cond_jaxpr"])
        count = _walk(body, [True] * len(body.outvars))[0] + _walk(test, [True])[0]
        return count, [True] * len(eqn.invars)
    if name == "cond":
        branches = [_walk(_open(b), out) for b in params["branches"]]
        needs = [any(used) for used in zip(*(b[1] for b in branches), strict=True)]
        return max((b[0] for b in branches), key=lambda c: c.total), [True, *needs]
    for key in ("jaxpr", "call_jaxpr", "fun_jaxpr", "call"):
        inner = params.get(key)
        if inner is not None and len(_open(inner).invars) == len(eqn.invars):
            return _walk(_open(inner), out)
    return _primitive(eqn), [True] * len(eqn.invars)


def _open(jaxpr: Any) -> Any:
    return getattr(jaxpr, "jaxpr", jaxpr)


def _scan(eqn: Any, out: list[bool]) -> tuple[OperationCount, list[bool]]:
    """Count the operations of a loop, and which inputs it needs. A carry that one iteration needs
    is needed by all of them."""
    body = _open(eqn.params["jaxpr"])
    n = len(out) - over_time(eqn.outvars, body.outvars)  # jax 0.11 has no parameter for this
    consts = len(body.invars) - n - over_time(eqn.invars, body.invars)
    while True:
        count, needs = _walk(body, out)
        grown = [a or b for a, b in zip(out[:n], needs[consts : consts + n], strict=True)]
        if grown == out[:n]:
            return eqn.params["length"] * count, needs
        out = [*grown, *out[n:]]


def _primitive(eqn: Any) -> OperationCount:
    """Count the operations of an equation that contains no jaxpr."""
    name = eqn.primitive.name
    results = [v.aval for v in eqn.outvars]
    inexact = [jnp.issubdtype(getattr(x, "dtype", jnp.int32), jnp.inexact) for x in results]
    if name in _FREE or not any(inexact):
        return OperationCount()
    size = math.prod(results[0].shape)
    if name in _ADDITIONS:
        if name.startswith("scatter"):
            size = math.prod(eqn.invars[2].aval.shape)
        return OperationCount(additions=size)
    if name in _MULTIPLICATIONS:
        return OperationCount(multiplications=size)
    if name == "one_minus_square":  # (1 + x) (1 - x)
        return OperationCount(additions=2 * size, multiplications=size)
    if name == "integer_pow":
        return _integer_power(eqn.params["y"], size)
    if name in ("div", "rem"):
        return OperationCount(divisions=size)
    if name in _ROOTS:
        return OperationCount(roots=size)
    if name in _TRIGONOMETRY:
        return OperationCount(trigonometry=size)
    if name in _REDUCTIONS:
        return OperationCount(**{_REDUCTIONS[name]: math.prod(eqn.invars[0].aval.shape) - size})
    if name == "dot_general":
        (contracted, _), _ = eqn.params["dimension_numbers"]
        length = math.prod(eqn.invars[0].aval.shape[i] for i in contracted)
        return OperationCount(additions=size * (length - 1), multiplications=size * length)
    if name in _ELIMINATIONS:
        return _elimination(eqn)
    raise InputError(
        f"operation_count: the function has the primitive {name!r}, which returns {results[0]} and "
        "whose operations are not known; expected arithmetic, elementary functions, data movement, "
        "loops and branches, lu, cholesky and triangular_solve; count the function without it"
    )


_ELIMINATIONS = {"lu", "cholesky", "triangular_solve"}


def _elimination(eqn: Any) -> OperationCount:
    """Count the operations of an elimination of matrices (..., n, n) (Golub & Van Loan, 3-4)."""
    name, shape = eqn.primitive.name, eqn.invars[0].aval.shape
    n, many = min(shape[-2:]), math.prod(shape[:-2])
    half = n * (n - 1) // 2
    if name == "triangular_solve":
        of_b = eqn.invars[1].aval.shape[-1 if eqn.params["left_side"] else -2]
        divisions = 0 if eqn.params["unit_diagonal"] else n
        return many * of_b * OperationCount(half, half, divisions)
    if name == "cholesky":
        inner = (n**3 - n) // 6
        return many * OperationCount(inner, inner, half, n)
    inner = sum((shape[-2] - k) * (shape[-1] - k) for k in range(1, n + 1))
    return many * OperationCount(inner, inner, sum(shape[-2] - k for k in range(1, n + 1)))


def _integer_power(y: int, size: int) -> OperationCount:
    """Count the operations of x^y by repeated squaring, with one division for a negative y."""
    n = abs(y)
    products = max(n.bit_length() - 1, 0) + max(n.bit_count() - 1, 0)
    return OperationCount(multiplications=size * products, divisions=size * (y < 0))
