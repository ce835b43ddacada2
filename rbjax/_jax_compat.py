"""All private or unstable names of JAX and its libraries that this package uses.

Each has a function or a constant with its purpose in this file. If a version of JAX lacks a name,
only this file changes. The upper bounds in `pyproject.toml` are the newest tested versions.

Public, but without JAX's promise of stability, and used elsewhere: `jax.extend.core` (jaxprs, their
equations and primitives) and `jax.interpreters` (rules of primitives). The layout of XLA's foreign
function interface is in `compiler.llvm.xla_handler`, the layout of NumPy arrays in
`compiler.llvm.numpy_call`; both are checked before use.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Primitive
from jax.interpreters import xla

# ------------------------------------------------------------------- names of primitives

#: primitives that evaluate a jaxpr once, and their parameters that may contain it
CALLS = {
    "jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint", "custom_jvp_call",
    "custom_vjp_call", "custom_vjp_call_jaxpr", "custom_vmap_call", "eval_jaxpr",
}  # fmt: skip
#: calls without a derivative rule, which are replaced by the equations of their jaxpr
INLINED = {"jit", "pjit", "closed_call", "core_call", "eval_jaxpr"}
JAXPRS = "jaxpr", "call_jaxpr", "call", "fun_jaxpr"
#: Equinox's reductions over a batch -> the operation
UNVMAP = {"unvmap_any": "or", "unvmap_all": "and", "unvmap_max": "max"}
#: the custom call by which XLA loads PTX
GPU_KERNEL = "__gpu$xla.gpu.ptx"
#: the module of the callback by which `equinox.error_if` raises
ERRORS_OF_EQUINOX = "equinox._errors"


def expanded(eqn: JaxprEqn) -> Callable | None:
    """Return the function of flat arrays that expands a high-level primitive of JAX 0.12
    (`searchsorted`, `nonzero`, `einsum` and others). Return None for other equations."""
    high = eqn.params.get("_prim")
    if eqn.primitive.name != "call_hi_primitive" or high is None:
        return None
    return lambda *xs: jax.tree.leaves(high.expand(*jax.tree.unflatten(high.in_tree, xs)))


def is_error(eqn: JaxprEqn) -> bool:
    """Check whether an equation raises an error of `equinox.error_if`."""
    if eqn.primitive.name != "pure_callback":
        return False
    callback = getattr(eqn.params["callback"], "callback_func", None)
    return getattr(callback, "__module__", "") == ERRORS_OF_EQUINOX


# ------------------------------------------------------------------- primitives


def needs_devices(primitive: Primitive) -> None:
    """Make JAX pass the devices of the program to the lowering of a primitive. Without them, a
    sharded batch is gathered on each device."""
    try:
        from jax._src.dispatch import prim_requires_devices_during_lowering

        prim_requires_devices_during_lowering.add(primitive)
    except ImportError:  # the batch is gathered: slower, but correct
        pass


def apply_primitive(primitive: Primitive, *args: Any, **params: Any) -> Any:
    """Compile and run one primitive, outside any trace."""
    return xla.apply_primitive(primitive, *args, **params)


def device_count(ctx: Any) -> int:
    """Return the number of devices of the program that is being lowered."""
    return getattr(ctx.module_context.axis_context, "num_devices", None) or 1


def is_manual(ctx: Any) -> bool:
    """Check whether each device already runs its own program, as in `shard_map`."""
    return bool(getattr(ctx.module_context.axis_context, "manual_axes", ()))


# ------------------------------------------------------------------- types


def varying_axes(aval: Any) -> frozenset:
    """Return the mesh axes along which an array varies, if `shard_map` tracks them."""
    return getattr(getattr(aval, "manual_axis_type", None), "varying", frozenset())


def like(aval: Any, shape: tuple[int, ...], dtype: Any) -> ShapedArray:
    """Make an abstract value that varies over the devices as `aval` does."""
    mesh = aval.sharding.mesh
    whole = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec(*[None] * len(shape)))
    return aval.update(shape=shape, dtype=dtype, weak_type=False, sharding=whole)


def key_implementation(dtype: Any) -> Any:
    """Return the implementation of a key type: seed, split, fold_in and random_bits of raw keys."""
    return dtype._impl


# ------------------------------------------------------------------- jaxprs


def without_names(jaxpr: Jaxpr) -> Any:
    """Return the debug info of a jaxpr without argument names, for a derived jaxpr."""
    return jaxpr.debug_info._replace(arg_names=None, result_paths=None)


def equation(eqn: JaxprEqn, ins: list, outs: list, at: JaxprEqn) -> JaxprEqn:
    """Copy `eqn` with other variables, and with the source location and the context of `at`."""
    return JaxprEqn(ins, outs, eqn.primitive, eqn.params, eqn.effects, at.source_info, at.ctx)


def custom_rule(eqn: JaxprEqn, moving: tuple[bool, ...]) -> tuple[ClosedJaxpr, list[bool]] | None:
    """Return the rule of a `custom_jvp` for the arguments with tangents (`moving`), and the mask of
    its nonzero output tangents. Return None if JAX stores the rule in another form."""
    rule = eqn.params.get("jvp_jaxpr_fun")
    if rule is None or not eqn.params.get("symbolic_zeros"):
        return None
    jaxpr, consts, zeros = rule.call_wrapped(*(not m for m in moving[eqn.params["num_consts"] :]))
    return ClosedJaxpr(jaxpr, consts), [not z for z in zeros]


def inside(x: Any) -> Any:
    """Return the value inside nested batch and tangent tracers."""
    while isinstance(x, jax.core.Tracer):
        x = getattr(x, "val", getattr(x, "primal", None))
    return x


# ------------------------------------------------------------------- compilers


def typed(attributes: Any, version: Any) -> None:
    """Mark a custom call as typed by StableHLO's attribute. JAX writes an attribute of its own,
    which the XLA of jax 0.11 loses when it rewrites a call."""
    if "mhlo.backend_config" in attributes:
        attributes["backend_config"] = attributes["mhlo.backend_config"]
        attributes["api_version"] = version
        del attributes["mhlo.backend_config"]


def wrap_lowering(wrapper: Callable[[Callable], Callable]) -> bool:
    """Replace JAX's function f that lowers a program to a module by wrapper(f). Return False if
    this JAX has no such function."""
    try:
        from jax._src.interpreters import mlir

        mlir.lower_jaxpr_to_module = wrapper(mlir.lower_jaxpr_to_module)
    except (ImportError, AttributeError):
        return False
    return True


def replace_kernel_data(module: Any, ptx: dict[str, str]) -> None:
    """Replace placeholders in the launches of kernels of a module, which `typed` has marked.
    ptx: placeholder -> PTX."""
    from jax.interpreters import mlir

    ir = mlir.ir

    def visit(op: Any) -> Any:
        is_call = op.name == "stablehlo.custom_call"
        if is_call and ir.StringAttr(op.attributes["call_target_name"]).value == GPU_KERNEL:
            config = ir.DictAttr(op.attributes["backend_config"])
            given = {x.name: x.attr for x in (config[k] for k in range(len(config)))}
            code = ptx.get(ir.StringAttr(given["kernel_data"]).value)
            if code is not None:
                given["kernel_data"] = ir.StringAttr.get(code)
                op.attributes["backend_config"] = ir.DictAttr.get(given)
        return ir.WalkResult.ADVANCE

    with module.context:
        module.operation.walk(visit)


# ------------------------------------------------------------------- diffrax, optimistix, Equinox


def any_of_batch(x: jax.Array) -> jax.Array:
    """Check whether x is true for any sample of a batch that `vmap` adds."""
    from equinox.internal import unvmap_any

    return unvmap_any(x)


#: option by which diffrax passes the state of an iteration from stage to stage
FIRST_STATE = "init_state"


def correction(state: Any) -> Any:
    """Return the last correction of a root finder of optimistix (Newton, Chord)."""
    return state.diff


def corrections(state: Any) -> Any:
    """Return the number of corrections that a root finder of optimistix has made."""
    return state.step


def scan_kind(solver: Any) -> Any:
    """Return how a diffrax Runge-Kutta method loops over its stages ("lax", "checkpointed", ...).

    None: diffrax chooses. "": the solver has no such field."""
    return getattr(solver, "scan_kind", "")
