"""Unknowns: which numbers of a set-up are sought, and what they can be.

An unknown reads and writes n physical numbers p of a pytree (a `Model`, or a `Setup` around it).
What p can be is said by a convex divergence D(p, p0): the distance from a guess, infinite where p
is impossible (`divergence`). So one term is the barrier of an estimator, the length of its steps,
and the prior that decides what the data leave open. Motion is nearly linear in p, and what data
leave open is a plane in p.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError, UnknownName
from rbjax.model import Model
from rbjax.spatial.mass import from_pseudo_inertia, pseudo_inertia
from rbjax.sysid.parameters.divergence import Divergence
from rbjax.sysid.parameters.log_cholesky import (
    PARAMETERS,
    inertial_parameters_of,
    pseudo_inertia_of,
)
from rbjax.sysid.parameters.setup_leaves import leaf_of as leaf_of
from rbjax.sysid.parameters.setup_leaves import put, with_leaf


@runtime_checkable
class Parametrisation(Protocol):
    """n physical numbers of a set-up. `read` and `write` are traced."""

    def names(self, label: str, target: Any) -> list[str]:
        """A name for each number."""
        ...

    def read(self, target: Any) -> jax.Array:
        """p (n,) as it stands in the set-up."""
        ...

    def write(self, target: Any, p: jax.Array) -> Any:
        """The set-up with p."""
        ...

    def divergence(self, p: np.ndarray, p0: np.ndarray) -> Divergence:
        """D(p, p0), convex in p, with its derivatives."""
        ...


class Scalars:
    """Numbers that are free, positive or bounded, each by itself."""

    positive: bool
    bounds: tuple[float, float] | None
    scale: float

    def divergence(self, p: np.ndarray, p0: np.ndarray) -> Divergence:
        if self.bounds is not None:
            return Divergence.bounded(p, p0, *self.bounds, self.scale)
        if self.positive:
            return Divergence.positive(p, p0)
        return Divergence.free(p, p0, self.scale)


@dataclass(frozen=True)
class Unknown(Scalars):
    """Numbers of one leaf.

    Args:
        leaf: its dotted name, such as "bodies.mass" or "forces.0.coulomb"; in a `Setup` a leaf of
            its model needs no "model." before it.
        index: which of its numbers; all if left out.
        positive: whether they are above zero.
        bounds: least and largest possible value, neither of which is reached.
        scale: of free numbers: what is a large change.

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
    """The pseudo-inertia's slopes (10, 4, 4) in the ten parameters: it is linear in them."""
    with jax.ensure_compile_time_eval():  # the first call may be within a traced program
        return np.asarray(pseudo_inertia_of(np.eye(10)))


@dataclass(frozen=True)
class Inertia:
    """The ten inertial parameters of a body: m, h = m c, and I about the origin of its frame, in
    the order m, hx, hy, hz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz. A body of some density has them.

    Args:
        body: name or index.
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
        """Of one body, or the sum of several that follow each other, ten numbers each."""
        slopes = _pseudo_slopes()
        P, P0 = (np.tensordot(x.reshape(-1, 10), slopes, 1) for x in (p, p0))
        return Divergence.definite(P, P0, slopes)

    def _place(self, target: Any) -> tuple[Any, int]:
        model: Model = getattr(target, "model", target)
        if isinstance(self.body, int):
            return model.bodies, self.body
        if self.body not in model.body_names:
            raise UnknownName("body", self.body, model.body_names)
        return model.bodies, model.body_names.index(self.body)


@dataclass(frozen=True)
class Shared:
    """One number, or row of numbers, that several leaves have in common: left leg = right leg.

    Args:
        members: unknowns of equal size; the first says what is possible.
        factors: what the number is multiplied by for each member; ones if None. A mirrored
            offset has -1.
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
    """Positive numbers of a leaf whose sum is known, such as masses of a robot that was weighed.

    The sought numbers are all but the last, which is what remains.
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
    """The direction of gravity in the axes of the world, in rad: a base that is not level.

    gravity = g (sin a, -cos a sin b, -cos a cos b); both angles are zero where it points to -z.
    """

    positive = False
    bounds = None
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
    """Numbers from which a function makes leaves: the density of links, the radius of a wheel.

    Args:
        start: first guess (n,).
        into: (set-up, p (n,)) -> set-up, traced.
        positive, bounds, scale: as in `Unknown`.
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


@dataclass(frozen=True)
class Unknowns:
    """Several unknowns by name, their numbers as one vector p in the order of the names."""

    members: Mapping[str, Parametrisation]
    sizes: tuple[int, ...]
    names: tuple[str, ...]

    @classmethod
    def of(cls, where: str, members: Mapping[str, Parametrisation], target: Any) -> Unknowns:
        """Checked against the set-up that they are read from."""
        fine = isinstance(members, Mapping) and members
        if not fine or not all(isinstance(u, Parametrisation) for u in members.values()):
            raise InputError(
                f"{where}: unknowns is {members!r}, expected a dict name -> Unknown, Inertia, "
                'Shared, FixedTotal, Tilt or Derived, such as {"mass": Unknown("bodies.mass", 0)}'
            )
        sizes, names = [], []
        for label, u in members.items():
            try:
                called = u.names(label, target)  # numpy's indexing refuses what is not there
                p = np.asarray(u.read(target))
            except (IndexError, TypeError) as error:
                raise InputError(f"{where}: {label} is {u!r}, but {error}") from error
            if not np.isfinite(u.divergence(p, p).value):
                raise InputError(
                    f"{where}: {label} is {p.tolist()}, expected a first guess within its range: "
                    "positive where positive=True, between the bounds, an inertia that a body can "
                    "have"
                )
            sizes.append(p.size)
            names += called
        return cls(dict(members), tuple(sizes), tuple(names))

    def read(self, target: Any) -> jax.Array:
        """p of all."""
        if not self.members:
            return jnp.zeros(0)
        return jnp.concatenate([u.read(target) for u in self.members.values()])

    def limits(self, target: Any) -> dict[str, tuple[float, float]]:
        """name -> (low, high) of the numbers that have limits, each by itself."""
        found: dict[str, tuple[float, float]] = {}
        for label, u in self.members.items():
            low, high = getattr(u, "bounds", None) or (-np.inf, np.inf)
            if getattr(u, "positive", False):
                low = max(low, 0.0)
            if low > -np.inf or high < np.inf:
                found |= dict.fromkeys(u.names(label, target), (low, high))
        return found

    def write(self, target: Any, p: jax.Array) -> Any:
        """The set-up with p."""
        for u, x in zip(self.members.values(), self._split(p), strict=True):
            target = u.write(target, x)
        return target

    def divergence(self, p: np.ndarray, p0: np.ndarray) -> Divergence:
        """The sum of all."""
        if not self.sizes:
            return Divergence.free(p, p0, 1.0)
        parts, end = [], 0
        for u, size in self._joined:
            own = slice(end, end + size)
            parts.append(u.divergence(p[own], p0[own]))
            end += size
        return Divergence.joined(parts)

    @functools.cached_property
    def _joined(self) -> list[tuple[Parametrisation, int]]:
        """The unknowns with their sizes, bodies that follow each other as one: their divergence
        takes as long as that of one."""
        found: list[tuple[Parametrisation, int]] = []
        for u, size in zip(self.members.values(), self.sizes, strict=True):
            if isinstance(u, Inertia) and found and isinstance(found[-1][0], Inertia):
                found[-1] = u, found[-1][1] + size
            else:
                found.append((u, size))
        return found

    def _split(self, x: jax.Array) -> list[jax.Array]:
        return jnp.split(x, np.cumsum(self.sizes)[:-1]) if self.sizes else []
