"""Lagrange's equations of the first kind, of a user's own system in any coordinates.

    d/dt dL/dv - dL/dq = Q + G^T l,        v = q'
    f(t, q) = 0,     A(t, q) v = b(t, q),      G = [df/dq; A]
by differentiation of L = T - V, f, A and b; or M a = F + G^T l in the place of the first line.
The rows hold as G a = c: f'' and (A v - b)' at a, with feedback of the residual (Baumgarte) where
it is asked for. Both lines are solved at once by a formulation on arrays. Their derivative is that
of the implicit function; of redundant rows l is the least. (Goldstein, *Classical Mechanics*, 2.4;
Arnold, *Mathematical Methods of Classical Mechanics*, 21; Masarati, *Multibody System Dynamics*,
ch. 7; Neimark & Fufaev, *Dynamics of Nonholonomic Systems*, ch. 3)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import diffrax
import jax
import jax.numpy as jnp

from rbjax.constraints.equations.model_rows import Residual
from rbjax.constraints.methods.dense import KKT, Dense
from rbjax.constraints.reactions import ConstrainedMotion
from rbjax.constraints.rows.functions import check_function, evaluate
from rbjax.errors import InputError
from rbjax.lanes.arrays import matvec

FULL = KKT()


@dataclass(frozen=True)
class LagrangeSystem:
    """M(t, q) a = F(t, q, v) + G^T l under f(t, q) = 0 and A(t, q) v = b(t, q).

    `energies` and `lagrangian` make one from T and V, or from L. All functions may take `args` as a
    last argument, a pytree of numbers, which is then given to the methods too: gradients by it are
    those of the equations.

    Fields: mass, to (n, n), symmetric, with a positive diagonal, and definite along what the rows
    leave free; force, to (n,); holonomic f, to (m,), or None; pfaffian A, to (k, n), or None; rate
    b, to (k,), or None for zero; formulation, a `Dense` one, "kkt" if not given.

    Raises: `InputError` where a function returns another shape.

    Example: a pendulum in x and z
        >>> import jax.numpy as jnp
        >>> from rbjax.constraints import LagrangeSystem
        >>> pendulum = LagrangeSystem.energies(
        ...     lambda q, v: v @ v / 2,
        ...     lambda q: 9.81 * q[1],
        ...     holonomic=lambda t, q: (q @ q - 1.0)[None],
        ... )
        >>> a, l = pendulum.solve(0.0, jnp.array([0.0, -1.0]), jnp.array([2.0, 0.0]))
        >>> a.round(6).tolist(), round(float(l[0]), 6)
        ([0.0, 4.0], -6.905)
    """

    mass: Callable
    force: Callable
    holonomic: Callable | None = None
    pfaffian: Callable | None = None
    rate: Callable | None = None
    formulation: Dense = FULL

    def __post_init__(self) -> None:
        for name in ("mass", "force", "holonomic", "pfaffian", "rate"):
            f = getattr(self, name)
            if f is not None or name in ("mass", "force"):
                check_function(f"LagrangeSystem({name}=...)", f)
        if self.holonomic is None and self.pfaffian is None:
            raise InputError(
                "LagrangeSystem: got no constraint, expected holonomic= or pfaffian=; a system "
                "without any is rbjax.body.lagrange's"
            )
        if self.rate is not None and self.pfaffian is None:
            raise InputError("LagrangeSystem: got a rate b without pfaffian=, expected both")
        if not isinstance(self.formulation, Dense):
            raise InputError(
                f"LagrangeSystem(formulation=...): got {type(self.formulation).__name__}, expected "
                "one on arrays, as rbjax.constraints.KKT()"
            )

    @classmethod
    def lagrangian(cls, L: Callable, forces: Callable | None = None, **rows: Any) -> LagrangeSystem:
        """Of L(t, q, v), a scalar and at most quadratic in v, and generalized forces
        Q(t, q, v) -> (n,) beside it; rows as the fields of those names."""
        check_function("LagrangeSystem.lagrangian: L", L)
        if forces is not None:
            check_function("LagrangeSystem.lagrangian: forces", forces)

        def scalar(t: Any, q: jax.Array, v: jax.Array, *args: Any) -> jax.Array:
            return evaluate("LagrangeSystem: L", L, None, (t, q, v, *args), (), q.dtype)

        def mass(t: Any, q: jax.Array, *args: Any) -> jax.Array:
            return jax.hessian(scalar, 2)(t, q, jnp.zeros_like(q), *args)

        def force(t: Any, q: jax.Array, v: jax.Array, *args: Any) -> jax.Array:
            """Q + dL/dq - (d/dt dL/dv without its part of v')."""

            def momentum(t: Any, q: jax.Array) -> jax.Array:
                return jax.grad(scalar, 2)(t, q, v, *args)

            _, swept = jax.jvp(momentum, (t, q), (jnp.ones_like(t), v))
            out = jax.grad(scalar, 1)(t, q, v, *args) - swept
            if forces is None:
                return out
            at = t, q, v, *args
            return out + evaluate("LagrangeSystem: forces", forces, None, at, q.shape, q.dtype)

        return cls(mass, force, **rows)

    @classmethod
    def energies(
        cls,
        kinetic: Callable,
        potential: Callable | None = None,
        forces: Callable | None = None,
        **rows: Any,
    ) -> LagrangeSystem:
        """Of T(q, v), quadratic in v, and V(q), scalars, and forces beside them (`lagrangian`)."""
        check_function("LagrangeSystem.energies: kinetic", kinetic)
        if potential is not None:
            check_function("LagrangeSystem.energies: potential", potential)

        def L(t: Any, q: jax.Array, v: jax.Array, *args: Any) -> Any:
            T = kinetic(q, v, *args)
            return T if potential is None else T - potential(q, *args)

        return cls.lagrangian(L, forces, **rows)

    def solve(
        self, t: Any, q: jax.Array, v: jax.Array, args: Any = None, *, alpha: Any = 0.0,
        beta: Any = 0.0,
    ) -> ConstrainedMotion:  # fmt: skip
        """Accelerations and multipliers.

        Args:
            t: time.
            q, v: (n,) coordinates and their rates.
            args: what the functions take as their last argument; None if they take none.
            alpha, beta: feedback of the residual, f'' + 2 alpha f' + beta^2 f = 0.
        """
        t, q, v = _arrays("LagrangeSystem.solve", t, q, v)
        M, F = self._mass(t, q, args), self._of("force", (t, q, v), args, q.shape)
        (value, rate, bent), G = self._rows(t, q, v, args)
        c = -bent - 2 * alpha * rate - beta**2 * value
        return ConstrainedMotion(*self.formulation.solved(M, G, F, c))

    def residual(self, t: Any, q: jax.Array, v: jax.Array, args: Any = None) -> Residual:
        """How far a state is from the constraints, as `solve`."""
        t, q, v = _arrays("LagrangeSystem.residual", t, q, v)
        value, rate, _ = self._rows(t, q, v, args)[0]
        return Residual(value, rate)

    def project(
        self, t: Any, q: jax.Array, v: jax.Array, args: Any = None, iterations: int = 3
    ) -> tuple[jax.Array, jax.Array]:
        """q and v put on the constraints by the least change in the norm of M, as `solve`; each
        iteration squares what the one before it left."""
        t, q, v = _arrays("LagrangeSystem.project", t, q, v)
        for _ in range(iterations):
            (value, _, _), G = self._rows(t, q, v, args)
            M = self._mass(t, q, args)
            q = q + self.formulation.solved(M, G, jnp.zeros_like(q), -value)[0]
        M = self._mass(t, q, args)
        for _ in range(2):
            (_, rate, _), G = self._rows(t, q, v, args)
            v = v + self.formulation.solved(M, G, jnp.zeros_like(v), -rate)[0]
        return q, v

    def term(self, alpha: Any = 0.0, beta: Any = 0.0) -> diffrax.ODETerm:
        """For diffrax: y = (q, v); its args are those of the functions."""

        def rates(t: Any, y: tuple[jax.Array, jax.Array], args: Any) -> tuple:
            return y[1], self.solve(t, *y, args, alpha=alpha, beta=beta).acceleration

        return diffrax.ODETerm(rates)

    def _of(self, name: str, at: tuple, args: Any, shape: tuple[int, ...]) -> jax.Array:
        """What one of the functions returns."""
        given = at if args is None else (*at, args)
        f, dtype = getattr(self, name), at[1].dtype
        return evaluate(f"LagrangeSystem: {name}", f, None, given, shape, dtype)

    def _mass(self, t: Any, q: jax.Array, args: Any) -> jax.Array:
        return self._of("mass", (t, q), args, (len(q), len(q)))

    def _size(self, name: str, t: Any, q: jax.Array, args: Any) -> int:
        """How many rows a function has."""
        given = (t, q) if args is None else (t, q, args)
        out = jnp.shape(jax.eval_shape(lambda *x: jnp.asarray(getattr(self, name)(*x)), *given))
        due = (len(q),) if name == "pfaffian" else ()
        if len(out) != 1 + len(due) or out[1:] != due:
            want = f"(k, {len(q)})" if due else "(m,)"
            raise InputError(f"LagrangeSystem: {name} returned the shape {out}, expected {want}")
        return out[0]

    def _rows(self, t: Any, q: jax.Array, v: jax.Array, args: Any) -> tuple:
        """Value, rate and the second derivative at a = 0 of the rows, and G (rows, n)."""
        parts = []
        if self.holonomic is not None:
            parts.append(self._held(t, q, v, args))
        if self.pfaffian is not None:
            parts.append(self._led(t, q, v, args))
        columns, G = zip(*parts, strict=True)
        stacked = tuple(jnp.concatenate(x) for x in zip(*columns, strict=True))
        return stacked, jnp.concatenate(G)

    def _held(self, t: Any, q: jax.Array, v: jax.Array, args: Any) -> tuple:
        """Those of f, along q + s v."""
        shape = (self._size("holonomic", t, q, args),)

        def f(t: Any, q: jax.Array) -> jax.Array:
            return self._of("holonomic", (t, q), args, shape)

        def slope(s: jax.Array) -> tuple:
            return jax.jvp(lambda s: f(t + s, q + s * v), (s,), (jnp.ones_like(s),))

        zero = jnp.zeros_like(t)
        (value, rate), (_, bent) = jax.jvp(slope, (zero,), (jnp.ones_like(t),))
        return (value, rate, bent), jax.jacrev(lambda q: f(t, q))(q)

    def _led(self, t: Any, q: jax.Array, v: jax.Array, args: Any) -> tuple:
        """Those of A v - b, along q + s v with v as it is."""
        shape = self._size("pfaffian", t, q, args), len(q)

        def y(s: jax.Array) -> tuple:
            at = t + s, q + s * v
            A = self._of("pfaffian", at, args, shape)
            out = matvec(A, v)
            if self.rate is not None:
                out = out - self._of("rate", at, args, shape[:1])
            return out, A

        rate, bent, A = jax.jvp(y, (jnp.zeros_like(t),), (jnp.ones_like(t),), has_aux=True)
        return (jnp.zeros_like(rate), rate, bent), A


def _arrays(where: str, t: Any, q: Any, v: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    q, v = (jnp.asarray(x) for x in (q, v))
    if q.ndim != 1 or v.shape != q.shape:
        raise InputError(
            f"{where}: q and v have the shapes {q.shape} and {v.shape}, expected (n,) each; for a "
            "batch use jax.vmap"
        )
    dtype = jnp.result_type(q, v, float if not jnp.issubdtype(q.dtype, jnp.floating) else q.dtype)
    return jnp.asarray(t, dtype), q.astype(dtype), v.astype(dtype)
