"""Lagrange's equations of the first kind, in any coordinates.

    d/dt dL/dv - dL/dq = Q + G^T l,        v = q'
    f(t, q) = 0,     A(t, q) v = b(t, q),      G = [df/dq; A]
The terms are derivatives of L = T - V, f, A and b. Instead of the first line the user may give
M a = F + G^T l. A `Dense` method solves for a and l. Derivatives use the implicit function theorem.

Source: Goldstein, *Classical Mechanics*, 2.4; Arnold, *Mathematical Methods of Classical
Mechanics*, 21; Masarati, *Multibody System Dynamics*, 4.3; Neimark & Fufaev, *Dynamics of
Nonholonomic Systems*, ch. 3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import diffrax
import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike, instance
from rbjax.constraints.equations.model_rows import Residual
from rbjax.constraints.methods.dense import KKT, Dense
from rbjax.constraints.reactions import ConstrainedMotion
from rbjax.constraints.rows.functions import check_function, evaluate
from rbjax.constraints.rows.row import derivatives
from rbjax.errors import InputError
from rbjax.lanes.arrays import matvec

FULL = KKT()


@dataclass(frozen=True)
class LagrangeSystem:
    """A system M(t, q) a = F(t, q, v) + G^T l under f(t, q) = 0 and A(t, q) v = b(t, q).

    `energies` makes one from T and V, `lagrangian` from L. All functions may accept a last argument
    `args`, a pytree of numbers. Pass it to the methods too.

    Fields:
        mass: M, (t, q) -> (n, n), symmetric, positive diagonal, positive definite in the null space
            of G.
        force: F, (t, q, v) -> (n,).
        holonomic: f, (t, q) -> (m,), or None.
        pfaffian: A, (t, q) -> (k, n), or None.
        rate: b, (t, q) -> (k,), or None for zero.
        formulation: a `Dense` method.

    Raises:
        InputError: a function returns another shape.

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
        public = "a method on arrays, such as rbjax.constraints.KKT()"
        instance("LagrangeSystem", "formulation", self.formulation, Dense, public)

    @classmethod
    def lagrangian(cls, L: Callable, forces: Callable | None = None, **rows: Any) -> LagrangeSystem:
        """Make the system from a Lagrangian.

        Args:
            L: L(t, q, v) -> (), at most quadratic in v.
            forces: generalized forces Q(t, q, v) -> (n,).
            rows: the other fields of the system.
        """
        check_function("LagrangeSystem.lagrangian: L", L)
        if forces is not None:
            check_function("LagrangeSystem.lagrangian: forces", forces)

        def scalar(t: Any, q: jax.Array, v: jax.Array, *args: Any) -> jax.Array:
            return evaluate("LagrangeSystem: L", L, None, (t, q, v, *args), (), q.dtype)

        def mass(t: Any, q: jax.Array, *args: Any) -> jax.Array:
            return jax.hessian(scalar, 2)(t, q, jnp.zeros_like(q), *args)

        def force(t: Any, q: jax.Array, v: jax.Array, *args: Any) -> jax.Array:
            """Return the force F = Q + dL/dq minus the part of d/dt dL/dv that does not depend on
            v'."""

            def momentum(t: Any, q: jax.Array) -> jax.Array:
                return jax.grad(scalar, 2)(t, q, v, *args)

            _, momentum_rate = jax.jvp(momentum, (t, q), (jnp.ones_like(t), v))
            out = jax.grad(scalar, 1)(t, q, v, *args) - momentum_rate
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
        """Make the system from T(q, v), quadratic in v, and V(q); `forces` as in `lagrangian`."""
        check_function("LagrangeSystem.energies: kinetic", kinetic)
        if potential is not None:
            check_function("LagrangeSystem.energies: potential", potential)

        def L(t: Any, q: jax.Array, v: jax.Array, *args: Any) -> Any:
            T = kinetic(q, v, *args)
            return T if potential is None else T - potential(q, *args)

        return cls.lagrangian(L, forces, **rows)

    def solve(
        self, t: Any, q: ArrayLike, v: ArrayLike, args: Any = None, *, alpha: Any = 0.0,
        beta: Any = 0.0,
    ) -> ConstrainedMotion:  # fmt: skip
        """Compute accelerations (n,) and multipliers (m + k,).

        Args:
            t: time.
            q, v: (n,) coordinates and their rates.
            args: last argument of the functions; None if they have none.
            alpha, beta: Baumgarte gains, f'' + 2 alpha f' + beta^2 f = 0.
        """
        t, q, v = _arrays("LagrangeSystem.solve", t, q, v)
        M, F = self._mass(t, q, args), self._of("force", (t, q, v), args, q.shape)
        (value, rate, acceleration), G = self._rows(t, q, v, args)
        c = -acceleration - 2 * alpha * rate - beta**2 * value
        return ConstrainedMotion(*self.formulation.scaled_solution(M, G, F, c))

    def residual(self, t: Any, q: ArrayLike, v: ArrayLike, args: Any = None) -> Residual:
        """Compute the residuals of the constraints: values [f; 0] and rates [f'; A v - b]."""
        t, q, v = _arrays("LagrangeSystem.residual", t, q, v)
        value, rate, _ = self._rows(t, q, v, args)[0]
        return Residual(value, rate)

    def project(
        self, t: Any, q: ArrayLike, v: ArrayLike, args: Any = None, iterations: int = 3
    ) -> tuple[jax.Array, jax.Array]:
        """Project q and v on the constraints by the least change in the norm of M."""
        t, q, v = _arrays("LagrangeSystem.project", t, q, v)
        for _ in range(iterations):
            (value, _, _), G = self._rows(t, q, v, args)
            M = self._mass(t, q, args)
            q = q + self.formulation.scaled_solution(M, G, jnp.zeros_like(q), -value)[0]
        M = self._mass(t, q, args)
        for _ in range(2):
            (_, rate, _), G = self._rows(t, q, v, args)
            v = v + self.formulation.scaled_solution(M, G, jnp.zeros_like(v), -rate)[0]
        return q, v

    def term(self, alpha: Any = 0.0, beta: Any = 0.0) -> diffrax.ODETerm:
        """Return the `diffrax.ODETerm` for y = (q, v), with Baumgarte gains alpha and beta."""

        def rates(t: Any, y: tuple[jax.Array, jax.Array], args: Any) -> tuple:
            return y[1], self.solve(t, *y, args, alpha=alpha, beta=beta).acceleration

        return diffrax.ODETerm(rates)

    def _of(self, name: str, at: tuple, args: Any, shape: tuple[int, ...]) -> jax.Array:
        """Evaluate the function in the field `name`, and check the shape of its value."""
        given = at if args is None else (*at, args)
        f, dtype = getattr(self, name), at[1].dtype
        return evaluate(f"LagrangeSystem: {name}", f, None, given, shape, dtype)

    def _mass(self, t: Any, q: jax.Array, args: Any) -> jax.Array:
        return self._of("mass", (t, q), args, (len(q), len(q)))

    def _size(self, name: str, t: Any, q: jax.Array, args: Any) -> int:
        """Return the number of rows of a constraint function."""
        given = (t, q) if args is None else (t, q, args)
        out = jnp.shape(jax.eval_shape(lambda *x: jnp.asarray(getattr(self, name)(*x)), *given))
        due = (len(q),) if name == "pfaffian" else ()
        if len(out) != 1 + len(due) or out[1:] != due:
            want = f"(k, {len(q)})" if due else "(m,)"
            raise InputError(f"LagrangeSystem: {name} returned the shape {out}, expected {want}")
        return out[0]

    def _rows(self, t: Any, q: jax.Array, v: jax.Array, args: Any) -> tuple:
        """Compute the values, rates and accelerations (at a = 0) of the rows, and G (rows, n)."""
        parts = []
        if self.holonomic is not None:
            parts.append(self._holonomic_rows(t, q, v, args))
        if self.pfaffian is not None:
            parts.append(self._pfaffian_rows(t, q, v, args))
        columns, G = zip(*parts, strict=True)
        stacked = tuple(jnp.concatenate(x) for x in zip(*columns, strict=True))
        return stacked, jnp.concatenate(G)

    def _holonomic_rows(self, t: Any, q: jax.Array, v: jax.Array, args: Any) -> tuple:
        """Compute the constraint f, its derivatives f', f'' along the path q + s v, and df/dq."""
        shape = (self._size("holonomic", t, q, args),)

        def f(t: Any, q: jax.Array) -> jax.Array:
            return self._of("holonomic", (t, q), args, shape)

        path = derivatives(lambda s: f(t + s, q + s * v), jnp.zeros_like(t))
        return path, jax.jacrev(lambda q: f(t, q))(q)

    def _pfaffian_rows(self, t: Any, q: jax.Array, v: jax.Array, args: Any) -> tuple:
        """Return A v - b, its derivative along the path q + s v with constant v, and A itself."""
        shape = self._size("pfaffian", t, q, args), len(q)

        def y(s: jax.Array) -> tuple:
            at = t + s, q + s * v
            A = self._of("pfaffian", at, args, shape)
            out = matvec(A, v)
            if self.rate is not None:
                out = out - self._of("rate", at, args, shape[:1])
            return out, A

        rate, acceleration, A = jax.jvp(y, (jnp.zeros_like(t),), (jnp.ones_like(t),), has_aux=True)
        return (jnp.zeros_like(rate), rate, acceleration), A


def _arrays(where: str, t: Any, q: Any, v: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    q, v = (jnp.asarray(x) for x in (q, v))
    if q.ndim != 1 or v.shape != q.shape:
        raise InputError(
            f"{where}: q and v have the shapes {q.shape} and {v.shape}, expected (n,) each; for a "
            "batch use jax.vmap"
        )
    dtype = jnp.result_type(q, v, float if not jnp.issubdtype(q.dtype, jnp.floating) else q.dtype)
    return jnp.asarray(t, dtype), q.astype(dtype), v.astype(dtype)
