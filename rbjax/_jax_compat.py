"""All private or unstable names of JAX and its libraries that this package uses.

Each has a function here, which says what it is for. If a version of JAX lacks a name, only this
file changes. `pyproject.toml` bounds the versions from above by those that were tested.

Not private, but without JAX's promise of stability, and used elsewhere: `jax.extend.core`
(jaxprs, their equations and primitives) and `jax.interpreters` (rules of primitives). The layout of
XLA's foreign function interface is in `threads.llvm_xla`, that of numpy's arrays in
`threads.numpy_abi`; both are checked before use.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Primitive
from jax.interpreters import xla

# ------------------------------------------------------------------- names of primitives

#: primitives that evaluate a jaxpr once, and the parameters that may hold it
CALLS = {
    "jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint", "custom_jvp_call",
    "custom_vjp_call", "custom_vjp_call_jaxpr", "custom_vmap_call", "eval_jaxpr",
}  # fmt: skip
JAXPRS = "jaxpr", "call_jaxpr", "call", "fun_jaxpr"
#: Equinox' combinations over a batch, and the operations that they are
UNVMAP = {"unvmap_any": "or", "unvmap_all": "and", "unvmap_max": "max"}
#: the custom call by which XLA loads PTX
GPU_KERNEL = "__gpu$xla.gpu.ptx"
#: the module of the callback by which `equinox.error_if` raises
ERRORS_OF_EQUINOX = "equinox._errors"


def expanded(eqn: JaxprEqn) -> Callable | None:
    """The function of flat arrays that an equation of JAX's high-level primitives stands for
    (`searchsorted`, `nonzero`, `einsum` and others, since jax 0.12); None for other equations."""
    high = eqn.params.get("_prim")
    if eqn.primitive.name != "call_hi_primitive" or high is None:
        return None
    return lambda *xs: jax.tree.leaves(high.expand(*jax.tree.unflatten(high.in_tree, xs)))


def is_error(eqn: JaxprEqn) -> bool:
    """Whether an equation raises an error of `equinox.error_if`."""
    if eqn.primitive.name != "pure_callback":
        return False
    callback = getattr(eqn.params["callback"], "callback_func", None)
    return getattr(callback, "__module__", "") == ERRORS_OF_EQUINOX


# ------------------------------------------------------------------- primitives


def needs_devices(primitive: Primitive) -> None:
    """Makes JAX pass the devices of the program to the lowering of a primitive. Without it, a batch
    that is sharded is gathered on each device."""
    try:
        from jax._src.dispatch import prim_requires_devices_during_lowering

        prim_requires_devices_during_lowering.add(primitive)
    except ImportError:  # the batch is gathered: slower, and right
        pass


def apply_primitive(primitive: Primitive, *args: Any, **params: Any) -> Any:
    """Compiles and runs one primitive, outside of any trace."""
    return xla.apply_primitive(primitive, *args, **params)


def device_count(ctx: Any) -> int:
    """The devices of the program that is being lowered."""
    return getattr(ctx.module_context.axis_context, "num_devices", None) or 1


def is_manual(ctx: Any) -> bool:
    """Whether each device already runs its own program, as in `shard_map`."""
    return bool(getattr(ctx.module_context.axis_context, "manual_axes", ()))


# ------------------------------------------------------------------- types


def varying_axes(aval: Any) -> frozenset:
    """The axes of a mesh along which an array varies, if `shard_map` tracks them."""
    return getattr(getattr(aval, "manual_axis_type", None), "varying", frozenset())


def like(aval: Any, shape: tuple[int, ...], dtype: Any) -> ShapedArray:
    """The type of an array that varies over the devices as another does."""
    mesh = aval.sharding.mesh
    whole = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec(*[None] * len(shape)))
    return aval.update(shape=shape, dtype=dtype, weak_type=False, sharding=whole)


def key_implementation(dtype: Any) -> Any:
    """The functions of a kind of random keys: seed, split, fold_in and random_bits of raw keys."""
    return dtype._impl


# ------------------------------------------------------------------- jaxprs


def without_names(jaxpr: Jaxpr) -> Any:
    """The debug info of a jaxpr without names of arguments, for a jaxpr derived from it."""
    return jaxpr.debug_info._replace(arg_names=None, result_paths=None)


def equation(eqn: JaxprEqn, ins: list, outs: list, at: JaxprEqn) -> JaxprEqn:
    """An equation with other variables, at the place of another in the source."""
    return JaxprEqn(ins, outs, eqn.primitive, eqn.params, eqn.effects, at.source_info, at.ctx)


def custom_rule(
    eqn: JaxprEqn, moving: tuple[bool, ...]
) -> tuple[ClosedJaxpr, list[bool]] | None:
    """The rule of a `custom_jvp` for arguments that move, and which of its rates are not zero; None
    if JAX keeps it in another form."""
    rule = eqn.params.get("jvp_jaxpr_fun")
    if rule is None or not eqn.params.get("symbolic_zeros"):
        return None
    jaxpr, consts, zeros = rule.call_wrapped(*(not m for m in moving[eqn.params["num_consts"] :]))
    return ClosedJaxpr(jaxpr, consts), [not z for z in zeros]


def inside(x: Any) -> Any:
    """The value under the batch and tangent tracers around it."""
    while isinstance(x, jax.core.Tracer):
        x = getattr(x, "val", getattr(x, "primal", None))
    return x


# ------------------------------------------------------------------- compilers


def typed(attributes: Any, version: Any) -> None:
    """Marks a custom call as typed in StableHLO's words. JAX writes an attribute of its own, which
    XLA of jax 0.11 loses when it writes a call again."""
    if "mhlo.backend_config" in attributes:
        attributes["backend_config"] = attributes["mhlo.backend_config"]
        attributes["api_version"] = version
        del attributes["mhlo.backend_config"]


# ------------------------------------------------------------------- diffrax, optimistix, Equinox


def any_of_batch(x: jax.Array) -> jax.Array:
    """Whether x holds for some sample of a batch that `vmap` adds."""
    from equinox.internal import unvmap_any

    return unvmap_any(x)


#: the option in which diffrax passes the state of an iteration from stage to stage
FIRST_STATE = "init_state"


def correction(state: Any) -> Any:
    """The last correction of a root finder of optimistix (Newton, Chord)."""
    return state.diff


def corrections(state: Any) -> Any:
    """How many corrections a root finder of optimistix has made."""
    return state.step


def scan_kind(solver: Any) -> Any:
    """How a Runge-Kutta method of diffrax loops over its stages ("lax", "checkpointed", ...).

    None is diffrax's choice, "" a solver without one."""
    return getattr(solver, "scan_kind", "")
