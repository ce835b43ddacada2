"""Velocities after an impact, by Newton's or by energetic restitution, with Coulomb friction.

An impact changes velocities and no positions. Only contact impulses p act,

    M (v+ - v-) = J^T p,   u+ = u- + J W J^T p
Newton's law prescribes the normal velocity of all touching contacts at once: u_n+ >= e |u_n-|,
complementary to p_n >= 0, with Coulomb's law between impulses and final slip. It can create energy
if slip stops or reverses within the impact; the energetic law (`rbjax.contact.impacts.energetic`)
cannot.

Source: Brogliato, *Nonsmooth Mechanics*, ch. 4 and 6; Glocker, *Set-Valued Force Laws*, ch. 13.
"""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import choice, integer, real_number
from rbjax.contact.geometry.detection import Contacts, Pairs, chosen_pairs, contacts_at
from rbjax.contact.impacts.energetic import energetic_impulse
from rbjax.contact.impacts.impulse_equations import ImpulseProblem, solve_impulses
from rbjax.contact.impacts.point_velocity import (
    coefficients,
    constrained_inverse_inertia,
    contact_jacobian,
    file_friction,
)
from rbjax.contact.parameters import pair_parameters
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_array, check_arrays
from rbjax.errors import InputError, listed
from rbjax.lanes.arrays import matmat, matrix_transpose, matvec
from rbjax.model import Model, State

LAWS = ("newton", "energetic")


@displayed
class Impulse(NamedTuple):
    """The result of an impact.

    Fields:
        v: (nv,) velocity after the impact.
        impulses: (n, 3) N s, normal and tangential, on the second geom of each candidate, in the
            contact axes.
        contacts: the candidate contacts.
        residual: () m/s, largest violation of the laws of impact.
        success: () whether the residual is small, or the integration reached its end.
    """

    v: jax.Array
    impulses: jax.Array
    contacts: Contacts
    residual: jax.Array
    success: jax.Array


def impulse(
    model: Model,
    state: State,
    *,
    pairs: Any = None,
    restitution: Any = 0.0,
    friction: Any = None,
    law: str = "newton",
    reach: float | None = None,
    t: Any = 0.0,
    sweeps: int = 100,
) -> Impulse:
    """Compute the velocity after an impact at the contacts that touch, all at once.

    v+ = v- + W J^T p with impulses p by Newton's restitution and Coulomb's friction, or by
    Stronge's energetic restitution for one contact. Rigid constraints of the model hold during the
    impact.

    Args:
        model: the robot, with `model.geoms`.
        state: `State(q (nq,), v (nv,))` before the impact.
        pairs: names or indices of the geoms, two each; the pairs of the file if None.
        restitution: e, one number or one a pair (pairs,), from 0 (plastic) to 1 (elastic).
        friction: mu, one number or one a pair; 0 is frictionless, jnp.inf sticks; the friction of
            the geoms if None.
        law: "newton", or "energetic" for one contact that touches.
        reach: m, largest distance of contacts that touch; 1e-6 in f64 and 1e-4 in f32 if None.
        t: time in s, for constraints that depend on it.
        sweeps: number of Gauss-Seidel sweeps before Newton's steps.

    Returns:
        `Impulse`. Contacts farther apart, or that already separate, have no restitution.

    Raises:
        InputError: the model has no geoms; shapes and dtypes; coefficients out of range.
        UnknownName: no such geom or law. UnsupportedFeature: pairs without a closed form.

    Source: Brogliato, *Nonsmooth Mechanics*, ch. 4; Stronge, *Impact Mechanics*, ch. 3.

    Example:
        >>> import rbjax as rb
        >>> ball = '''<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 0.1">
        ...     <joint type="slide" axis="0 0 1"/><geom size="0.1"/></body></worldbody></mujoco>'''
        >>> model = rb.load(ball)
        >>> state = model.default_state().replace(v=[-2.0])
        >>> round(float(rb.contact.impulse(model, state, restitution=0.5).v[0]), 4)
        1.0
    """
    checked = check_arrays("impulse", model, {"state": state})["state"]
    chosen = check_pairs("impulse", model, pairs)
    choice("law of impact", law, LAWS)
    integer("impulse", "sweeps", sweeps, least=1)
    dtype = checked.q.dtype
    if reach is None:
        reach = 1e-6 if dtype == jnp.float64 else 1e-4
    real_number("impulse", "reach", reach, least=0.0, traced=True)
    e, mu = check_coefficients("impulse", model, chosen, restitution, friction, dtype)
    if law == "energetic" and not isinstance(mu, jax.core.Tracer) and jnp.isinf(mu).any():
        raise InputError(
            "impulse(law='energetic'): friction is inf, expected a finite number: infinite "
            "friction would stop the slip before any normal impulse; law='newton' takes it"
        )
    t = check_array("impulse", "t", t, ()).astype(dtype)
    given = (model, checked.q, checked.v, e, mu, jnp.asarray(reach, dtype), t)
    return _program(*given, chosen, law, int(sweeps))


def check_pairs(where: str, model: Model, pairs: Any) -> Pairs:
    """Return the pairs of geoms by index; raise if there are none or if one has no closed form."""
    chosen = chosen_pairs(where, model, pairs)
    if not chosen:
        raise InputError(
            f"{where}: no two geoms of the model may touch, expected at least one pair; give "
            "pairs=[(geom, geom)], or see contype and conaffinity of the file"
        )
    return chosen


def check_coefficients(
    where: str, model: Model, pairs: Pairs, restitution: Any, friction: Any, dtype: Any
) -> tuple[jax.Array, jax.Array]:
    """Return restitution and friction of each candidate (n,). Raise InputError if a restitution is
    not from 0 to 1, or a friction is negative or not a number; friction may be infinite."""
    if friction is None:
        friction = file_friction(model, pairs, dtype)
        _warn_of_rolling_friction(where, model, pairs)
    out = []
    for name, x in (("restitution", restitution), ("friction", friction)):
        found = coefficients(where, name, x, model, pairs, dtype)
        if not isinstance(found, jax.core.Tracer):
            limited = name == "restitution"  # above 1 an impact would create energy
            wrong = ~((found >= 0) & (found <= 1)) if limited else ~(found >= 0)
            if wrong.any():
                raise InputError(
                    f"{where}: {name} is {float(found[wrong.argmax()])}, expected numbers "
                    f"{'from 0 to 1' if limited else 'not below zero'}"
                )
        out.append(found)
    return out[0], out[1]


def _warn_of_rolling_friction(where: str, model: Model, pairs: Pairs) -> None:
    """Warn of pairs whose torsional or rolling friction is left out."""
    geoms: Any = model.geoms
    condim = pair_parameters(geoms, pairs).condim
    names = [
        " and ".join(geoms.names[i] for i in pair)
        for pair, dim in zip(pairs, condim, strict=True)
        if dim > 3
    ]
    if names:
        warnings.warn(
            f"{where}: impulses have only sliding friction, and {listed(names, 3)} have torsional "
            'or rolling friction too (condim 4 or 6), which is left out; contact="mujoco" and '
            '"coulomb" take it, and friction= (of sliding) silences this warning',
            stacklevel=4,
        )


def _impulse(
    model: Model, q: Any, v: Any, e: Any, mu: Any, reach: Any, t: Any, pairs: Pairs, law: str,
    sweeps: int,
) -> Impulse:  # fmt: skip
    contacts = contacts_at(model, q, reach, pairs)
    problem = impact_problem(model, q, v, contacts, mu, t)
    v, p, *found = impact(problem, v, e, law, sweeps)
    return Impulse(v, p, contacts, *found)


_program = jax.jit(_impulse, static_argnames=("pairs", "law", "sweeps"))


def impact(
    problem: ImpulseProblem, v: jax.Array, e: jax.Array, law: str, sweeps: int = 100
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Compute v after the impact, the impulses (n, 3), the residual and whether it succeeded."""
    active, mu, dtype = problem.active, problem.mu, v.dtype
    if law == "energetic":
        closing = jnp.where(active, problem.u[:, 0], jnp.inf)
        first = jnp.argmin(closing)
        one = jnp.arange(len(active)) == first
        several = (closing < 0).sum() > 1
        own, success = energetic_impulse(
            problem.D[first, :, first, :], problem.u[first], e[first], mu[first]
        )
        hit = closing[first] < 0
        p = jnp.where((one & hit)[:, None], own, 0)
        residual = jnp.zeros((), dtype)
        success = jnp.where(hit, success & ~several, True)
    else:
        b = e * jnp.maximum(-problem.u[:, 0], 0)
        p, residual = solve_impulses(problem._replace(b=b), sweeps)
        speed = jnp.abs(problem.u).max(initial=0.0)
        success = residual <= 1e3 * jnp.finfo(dtype).eps * (1 + speed)
    return v + problem.change(p), p, residual, success


def impact_problem(
    model: Model, q: jax.Array, v: jax.Array, contacts: Contacts, mu: jax.Array, t: Any,
    others: jax.Array | None = None,
) -> ImpulseProblem:  # fmt: skip
    """Return the impulse problem without restitution.

    W is the inverse mass matrix of the constrained model. `others` are rows (m, 3, nv) that follow
    those of the contacts; then n includes m, and they are active and frictionless.
    """
    J, exists = contact_jacobian(model, q, contacts), contacts.exists
    if others is not None:
        J = jnp.concatenate([J, others])
        exists = jnp.concatenate([exists, jnp.ones(len(others), bool)])
        mu = jnp.concatenate([mu, jnp.zeros(len(others), mu.dtype)])
    n, nv = len(J), model.nv
    rows = J.reshape(3 * n, nv)
    Y = matmat(constrained_inverse_inertia(model, q, t), matrix_transpose(rows))
    u = matvec(rows, v).reshape(n, 3)
    return ImpulseProblem(J, Y, u, jnp.zeros(n, v.dtype), mu, exists)
