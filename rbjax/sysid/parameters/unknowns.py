"""Unknowns: the parameters of a set-up to estimate, and their ranges.

An unknown reads and writes n physical parameters p of a pytree, which is a `Model` or a `Setup`. A
convex divergence D(p, p0) is the distance from a guess, infinite outside of the range of p
(`divergence`). Estimators use it as barrier, metric of the step length, and prior in the
unidentifiable directions. The motion is nearly linear in p.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice
from rbjax.errors import UnknownName
from rbjax.model import Model
from rbjax.spatial.mass_conditions import from_pseudo_inertia, pseudo_inertia
from rbjax.sysid.parameters.divergence import Divergence
from rbjax.sysid.parameters.log_cholesky import (
    PARAMETERS,
    inertial_parameters_of,
    pseudo_inertia_of,
)


@runtime_checkable
class Parametrisation(Protocol):
    """Protocol of n physical parameters of a set-up. `read` and `write` are traced."""

    def names(self, label: str, target: Any) -> list[str]:
        """Return the name of each parameter."""

    def read(self, target: Any) -> jax.Array:
        """Read p (n,) from the set-up."""

    def write(self, target: Any, p: jax.Array) -> Any:
        """Write p into the set-up."""

    def divergence(self, p: np.ndarray, p0: np.ndarray) -> Divergence:
        """Compute D(p, p0), convex in p, with its derivatives."""


class Scalars:
    """Parameters that are free, positive or bounded independently of each other."""

    positive: bool = False
    bounds: tuple[float, float] | None = None
    scale: float = 1.0

    def divergence(self, p: np.ndarray, p0: np.ndarray) -> Divergence:
        if self.bounds is not None:
            return Divergence.bounded(p, p0, *self.bounds, self.scale)
        if self.positive:
            return Divergence.positive(p, p0)
        return Divergence.free(p, p0, self.scale)


@dataclass(frozen=True)
class Unknown(Scalars):
    """Unknown entries of one leaf of a model or a set-up.

    Args:
        leaf: dotted name of the leaf, such as "bodies.mass" or "forces.0.coulomb". In a `Setup`,
            the prefix "model." is optional.
        index: index of the entries; all by default.
        positive: whether the entries are positive.
        bounds: open lower and upper bound.
        scale: a change of this size of a free parameter counts as large; in its unit.
        prior: mean and standard deviation of a normal prior of each entry. None: no prior.

    Example:
        >>> import rbjax as rb
        >>> mass = rb.sysid.Unknown("bodies.mass", 0, positive=True)
        >>> float(mass.read(rb.load("pendulum"))[0])
        1.0
    """

    leaf: str
    index: Any = ...
    positive: bool = False
    bounds: tuple[float, float] | None = None
    scale: float = 1.0
    prior: tuple[float, float] | None = None

    def names(self, label: str, target: Any) -> list[str]:
        shape = np.asarray(leaf_of(target, self.leaf))[self.index].shape
        if not shape:
            return [label]
        return [f"{label}[{', '.join(map(str, i))}]" for i in np.ndindex(*shape)]

    def read(self, target: Any) -> jax.Array:
        return jnp.asarray(leaf_of(target, self.leaf))[self.index].reshape(-1)

    def write(self, target: Any, p: jax.Array) -> Any:
        value = jnp.asarray(leaf_of(target, self.leaf))
        new = put(value, self.index, p.reshape(value[self.index].shape).astype(value.dtype))
        return with_leaf(target, self.leaf, new)


@functools.cache
def _pseudo_slopes() -> np.ndarray:
    """Compute the derivatives dP/dphi (10, 4, 4) of the pseudo-inertia, which is linear in phi."""
    with jax.ensure_compile_time_eval():  # the first call may occur during a trace
        return np.asarray(pseudo_inertia_of(jnp.asarray(np.eye(10))))


@dataclass(frozen=True)
class Inertia:
    """Unknown inertia of a body: its ten inertial parameters.

    The parameters are m, h = m c, and I about the origin of the body's frame, in the order m, hx,
    hy, hz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz. Estimates are physically consistent.

    Args:
        body: name or index of the body.

    Example:
        >>> from rbjax.sysid import Inertia
        >>> Inertia("thigh").body
        'thigh'
    """

    body: str | int

    def names(self, label: str, target: Any) -> list[str]:
        return [f"{label}.{part}" for part in PARAMETERS]

    def read(self, target: Any) -> jax.Array:
        bodies, k = self._place(target)
        P = pseudo_inertia(bodies.mass[k], bodies.com[k], bodies.inertia[k])
        return inertial_parameters_of(P)

    def write(self, target: Any, p: jax.Array) -> Any:
        bodies, k = self._place(target)
        found = from_pseudo_inertia(pseudo_inertia_of(p))
        named = zip(("mass", "com", "inertia"), found, strict=True)
        new = {name: put(getattr(bodies, name), k, x) for name, x in named}
        return with_leaf(target, "bodies", bodies.replace(**new))

    def divergence(self, p: np.ndarray, p0: np.ndarray) -> Divergence:
        """Compute the divergence of one body, or the sum over several, with ten parameters each."""
        slopes = _pseudo_slopes()
        P, P0 = ((x.reshape(-1, 10) @ slopes.reshape(10, 16)).reshape(-1, 4, 4) for x in (p, p0))
        return Divergence.definite(P, P0, slopes)

    def _place(self, target: Any) -> tuple[Any, int]:
        model: Model = getattr(target, "model", target)
        if isinstance(self.body, int):
            return model.bodies, self.body
        return model.bodies, model.body_names.index(choice("body", self.body, model.body_names))


@dataclass(frozen=True)
class Shared:
    """Unknown parameters with a common value in several leaves, such as a left and a right leg.

    Args:
        members: unknowns of equal size. The range of the first member applies.
        factors: one factor of the common value for each member, such as -1 for a mirrored offset.
            None: ones.

    Example:
        >>> from rbjax.sysid import Shared
        >>> from rbjax.sysid import Unknown
        >>> legs = Unknown("bodies.mass", 0), Unknown("bodies.mass", 3)
        >>> len(Shared(legs).members)
        2
    """

    members: tuple[Unknown, ...]
    factors: tuple[float, ...] | None = None

    def names(self, label: str, target: Any) -> list[str]:
        return self.members[0].names(label, target)

    def read(self, target: Any) -> jax.Array:
        return self.members[0].read(target) / self._factors()[0]

    def write(self, target: Any, p: jax.Array) -> Any:
        for member, factor in zip(self.members, self._factors(), strict=True):
            target = member.write(target, factor * p)
        return target

    def divergence(self, p: np.ndarray, p0: np.ndarray) -> Divergence:
        factor = self._factors()[0]
        return self.members[0].divergence(factor * p, factor * p0).through(factor * np.eye(p.size))

    def _factors(self) -> Sequence[float]:
        return (1.0,) * len(self.members) if self.factors is None else self.factors


@dataclass(frozen=True)
class FixedTotal:
    """Unknown positive entries of a leaf with a known sum, such as the masses of a weighed robot.

    The last entry is the total minus the other entries.

    Args:
        leaf: dotted name of the leaf.
        index: indices of the entries.
        total: sum of the entries.

    Example:
        >>> from rbjax.sysid import FixedTotal
        >>> FixedTotal("bodies.mass", (0, 1, 2), total=12.5).total
        12.5
    """

    leaf: str
    index: tuple[int, ...]
    total: float

    def names(self, label: str, target: Any) -> list[str]:
        return [f"{label}[{i}]" for i in self.index[:-1]]

    def read(self, target: Any) -> jax.Array:
        p = jnp.asarray(leaf_of(target, self.leaf))[jnp.array(self.index)]
        return p[:-1] * (self.total / p.sum())

    def write(self, target: Any, p: jax.Array) -> Any:
        value = jnp.asarray(leaf_of(target, self.leaf))
        whole = jnp.append(p, self.total - p.sum()).astype(value.dtype)
        return with_leaf(target, self.leaf, value.at[jnp.array(self.index)].set(whole))

    def divergence(self, p: np.ndarray, p0: np.ndarray) -> Divergence:
        whole = [np.append(x, self.total - x.sum()) for x in (p, p0)]
        return Divergence.positive(*whole).through(np.vstack([np.eye(p.size), -np.ones(p.size)]))


@dataclass(frozen=True)
class Tilt(Scalars):
    """Unknown direction of gravity, for a base that is not level.

    gravity = g (sin a, -cos a sin b, -cos a cos b) in the world frame, with angles a, b in rad.
    Both angles are zero if gravity points to -z.
    """

    scale = 0.1

    def names(self, label: str, target: Any) -> list[str]:
        return [f"{label} about y", f"{label} about x"]

    def read(self, target: Any) -> jax.Array:
        x, y, z = leaf_of(target, "gravity")
        return jnp.stack([jnp.arctan2(x, jnp.hypot(y, z)), jnp.arctan2(-y, -z)])

    def write(self, target: Any, p: jax.Array) -> Any:
        old = jnp.asarray(leaf_of(target, "gravity"))
        (a, b), size = p, jnp.linalg.norm(old)
        down = jnp.stack([jnp.sin(a), -jnp.cos(a) * jnp.sin(b), -jnp.cos(a) * jnp.cos(b)])
        return with_leaf(target, "gravity", (size * down).astype(old.dtype))


@dataclass(frozen=True)
class Derived(Scalars):
    """Unknown parameters of a function that writes leaves, such as a density or a wheel radius.

    Args:
        start: (n,) first guess.
        into: traced function (set-up, p (n,)) -> set-up.
        positive: whether the parameters are positive.
        bounds: open lower and upper bound.
        scale: a change of this size of a free parameter counts as large; in its unit.

    Example:
        >>> from rbjax.sysid import Derived
        >>> into = lambda setup, p: setup.replace(model=setup.model.replace(gravity=p))
        >>> Derived((0.0, 0.0, -9.8), into).start
        (0.0, 0.0, -9.8)
    """

    start: tuple[float, ...]
    into: Callable[[Any, jax.Array], Any]
    positive: bool = False
    bounds: tuple[float, float] | None = None
    scale: float = 1.0

    def names(self, label: str, target: Any) -> list[str]:
        n = len(self.start)
        return [label] if n == 1 else [f"{label}[{i}]" for i in range(n)]

    def read(self, target: Any) -> jax.Array:
        return jnp.asarray(self.start, float)

    def write(self, target: Any, p: jax.Array) -> Any:
        return self.into(target, p)


def put(array: Any, index: Any, new: Any) -> jax.Array:
    """Replace an entry of an array. Untraced arrays use numpy, which is 100 times faster."""
    if any(isinstance(x, jax.core.Tracer) for x in (array, new)):
        return jnp.asarray(array).at[index].set(new)
    out = np.array(array)
    out[index] = new
    return jnp.asarray(out)


def leaf_of(target: Any, leaf: str) -> Any:
    """Return the floating-point leaf with a dotted name in a pytree."""
    try:
        value = functools.reduce(_child, _parts(target, leaf), target)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError):
        value = None
    numeric = eqx.is_array(value) or isinstance(value, float)
    if not numeric or not jnp.issubdtype(jnp.result_type(value), jnp.floating):
        paths = jax.tree_util.tree_flatten_with_path(target)[0]
        keys = (jax.tree_util.keystr(p, simple=True, separator=".") for p, _ in paths)
        known = [key.removeprefix("model.") for key in keys]
        raise UnknownName(f"leaf of {type(target).__name__}", leaf, known)
    return value


def with_leaf(target: Any, leaf: str, new: Any) -> Any:
    """Replace the leaf with a dotted name in a pytree. A `Model` updates its derived values."""
    return _with(target, _parts(target, leaf), new)


def _parts(target: Any, leaf: str) -> list[str]:
    parts = leaf.split(".")
    inside = isinstance(getattr(target, "model", None), Model) and not hasattr(target, parts[0])
    return ["model", *parts] if inside else parts


def _child(value: Any, part: str) -> Any:
    if isinstance(value, Mapping):
        return value[part]
    return value[int(part)] if isinstance(value, (tuple, list)) else getattr(value, part)


def _with(value: Any, parts: list[str], new: Any) -> Any:
    if not parts:
        return new
    part, rest = parts[0], parts[1:]
    child = _with(_child(value, part), rest, new)
    if isinstance(value, Model):
        return value.replace(**{part: child})
    return eqx.tree_at(lambda x: _child(x, part), value, child, is_leaf=lambda x: x is None)
