"""Bodies that can exist: least squares in log-Cholesky coordinates, with the CAD model as a prior.

    min over theta, x   |(tau - W pi) / s|^2 + (2 / w^2) sum over bodies of d(P(theta)||P_CAD)

pi stacks the inertial parameters phi(theta) of all bodies and the joints' numbers x, of which
armature and friction are positive (by their logarithms). Every theta is a body (`log_cholesky`), so
no constraint is needed. d is the log-determinant divergence (`inertia_metric`), about half the
square of the relative deviation, of which w is the standard deviation. With w = 1 (100 %) the prior
moves what the data determine well by a small part of its standard error, and decides what they
leave open. Rucker & Wensing, IEEE RA-L 7(2), 2022; Lee, Wensing & Park, IEEE T-RO 36(3), 2020.

The data enter by the triangular factor of [W, tau], so a step costs the same for any number of
samples. The Jacobian is exact, the prior a sum of squares (`prior_residual`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.stats

from rbjax.arguments import integer
from rbjax.dynamics.arguments import check_model
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.sysid.parameters.inertia_metric import prior_residual, scalar_residual
from rbjax.sysid.parameters.log_cholesky import (
    log_cholesky_parameters,
    model_log_cholesky,
    parameter_jacobian,
    with_inertial_parameters,
)
from rbjax.sysid.statistics.rank import Combinations
from rbjax.sysid.torque.regression import Regression, weighted
from rbjax.sysid.torque.regressors import joint_coordinates, parameter_names, parameter_values
from rbjax.sysid.torque.stacking import equations

Array = np.ndarray
POSITIVE = ("armature", "viscous", "coulomb", "gear_loss")
#: Noise that is estimated is at least this times the size of its torque: it may be rounding only.
LEAST_NOISE = 1e-7

_prior = jax.jit(prior_residual)
_prior_jacobian = jax.jit(jax.vmap(jax.jacfwd(prior_residual)))
_scalar = jax.jit(scalar_residual)
_scalar_slope = jax.jit(jax.vmap(jax.grad(scalar_residual)))


@dataclass(frozen=True, eq=False)
class Consistent:
    """Parameters that a robot can have.

    Fields: model with them (Coulomb friction, bias and gear losses are only in values); names and
    values (p,); covariance (p, p), of data and prior; noise (N, k) standard deviations that were
    used; residual (N, k); divergence (nb,) of each body from its prior; combinations that the data
    show; linear, the weighted least squares that it began with; steps; success, whether it
    converged.
    """

    model: Model
    names: tuple[str, ...]
    values: Array
    covariance: Array
    noise: Array
    residual: Array
    divergence: Array
    combinations: Combinations
    linear: Regression
    steps: int
    success: bool

    @property
    def errors(self) -> Array:
        """Standard deviations (p,); large where neither the data nor the prior say much."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def beta(self) -> Array:
        """Base parameters (r,)."""
        return self.combinations.combine(self.values)

    @property
    def base_covariance(self) -> Array:
        """(r, r), of beta."""
        B = self.combinations.matrix
        return B @ self.covariance @ B.T

    def intervals(self, level: float = 0.95) -> Array:
        """(r, 2) limits between which each base parameter lies with this probability."""
        if not 0 < level < 1:
            raise InputError(f"intervals: level is {level}, expected between 0 and 1")
        half = scipy.stats.t.ppf((1 + level) / 2, self.linear.dof)
        half = half * np.sqrt(np.diag(self.base_covariance))
        return np.stack([self.beta - half, self.beta + half], 1)


def consistent(
    model: Model,
    W: Any,
    tau: Any,
    *,
    joint_terms: Sequence[str] = (),
    noise: Any = None,
    spread: Any = 1.0,
    base: Combinations | None = None,
    lengths: Sequence[int] | None = None,
    max_steps: int = 300,
) -> Consistent:
    """Fit inertias that bodies can have, and positive armature and friction, to torques.

    Args:
        model: the robot; its inertias are the prior and the start, and so are its armature and
            damping where they are above 0.
        W: (N, k, p) observation matrix with these joint terms, or rows of a balance.
        tau: (N, k) torques, or impulses or work.
        joint_terms: of W's columns.
        noise: standard deviation of tau: a number, (k,) or (N, k); None for that of the residuals
            of weighted least squares. After a robust regression noise / sqrt(weights) keeps its
            weights.
        spread: relative standard deviation of the prior, a number or (nb,), one for each body.
        base, lengths: as for `regress`.
        max_steps: evaluations.

    Returns:
        `Consistent`.

    Raises:
        InputError: as `regress`; a body of the model that cannot exist, by name.

    Source: Rucker & Wensing 2022; Lee, Wensing & Park 2020.

    Example:
        >>> import jax, rbjax as rb
        >>> from rbjax.sysid.torque import consistent, observation_matrix, random_motions
        >>> model = rb.load("double_pendulum")
        >>> W = observation_matrix(model, *random_motions(model, 50))
        >>> heavier = model.replace(bodies=model.bodies.replace(mass=1.2 * model.bodies.mass))
        >>> found = consistent(model, W, W @ rb.inertial_parameters(heavier), noise=0.01)
        >>> found.success, bool((found.model.bodies.mass > 0).all())
        (True, True)
    """
    where = "consistent"
    check_model(where, model)
    names = parameter_names(model, joint_terms)
    integer(where, "max_steps", max_steps, least=1)
    eq = equations(W, tau, names, noise=noise, base=base, lengths=lengths)
    try:
        spread = np.asarray(spread, float)
    except (TypeError, ValueError):
        spread = np.array(np.nan)
    if spread.shape not in ((), (model.nb,)) or not ((spread > 0) & np.isfinite(spread)).all():
        raise InputError(
            f"{where}: spread is {spread}, expected a number above 0, such as 0.3 for 30 %, or "
            f"({model.nb},) of them"
        )
    linear = weighted(eq)
    if eq.noise is None:
        least = LEAST_NOISE * np.sqrt((eq.tau**2).mean())
        sd = np.broadcast_to(np.maximum(linear.noise, max(least, 1e-300)), eq.tau.shape)
    else:
        sd = eq.noise
    whole = np.concatenate([eq.W, eq.tau[..., None]], 2) / sd[..., None]
    R = scipy.linalg.qr(whole.reshape(-1, len(names) + 1), mode="r")[0][: len(names) + 1]
    problem = _Problem(model, joint_terms, R[:, :-1], R[:, -1], spread, linear)
    # Not `minimise`: its steps solve normal equations, which square the condition. The prior's rows
    # are of size 1 and the data's of 1 / noise, so at a noise of 1e-6 the prior is lost in rounding
    # (301 evaluations and not converged, where these steps by SVD take 17).
    with np.errstate(over="ignore", invalid="ignore"):  # of trial steps, which are refused
        found = scipy.optimize.least_squares(
            problem.residual, problem.start, problem.jacobian, x_scale="jac",
            ftol=1e-14, xtol=1e-14, gtol=1e-14, max_nfev=max_steps,
        )  # fmt: skip
    values, slopes = problem.parameters(found.x), problem.slopes(found.x)
    bread = np.linalg.pinv(found.jac.T @ found.jac, hermitian=True)
    prior = found.jac[len(problem.R) :]
    # the data's part of the sandwich's middle; linear.covariance follows the residuals
    data = eq.combinations.matrix @ slopes
    X = (eq.X / sd[..., None]).reshape(-1, eq.combinations.rank)
    data = X.T @ X @ data
    meat = data.T @ linear.covariance @ data + prior.T @ prior
    covariance = slopes @ bread @ meat @ bread @ slopes.T
    divergence = (np.asarray(_prior(problem.bodies(found.x), problem.prior)) ** 2).sum(1)
    return Consistent(
        _changed(model, values, joint_terms), names, values, covariance, sd,
        eq.tau - eq.W @ values, divergence, eq.combinations, linear, int(found.nfev),
        bool(found.status > 0),
    )  # fmt: skip


class _Problem:
    """Residuals and Jacobian of x = (theta of the bodies, numbers of joints)."""

    def __init__(
        self, model: Model, joint_terms: Sequence[str], R: Array, y: Array, spread: Array,
        linear: Regression,
    ) -> None:  # fmt: skip
        self.R, self.y, self.nb = R, y, model.nb
        self.prior = np.asarray(model_log_cholesky(model))
        self.pull = np.broadcast_to(np.sqrt(2) / spread, (model.nb,))
        each = joint_coordinates(model).size
        self.positive = np.repeat([term in POSITIVE for term in joint_terms], each).astype(bool)
        values = np.asarray(parameter_values(model, joint_terms))
        known = values[10 * model.nb :]
        # where the model says 0 there is no prior; linear least squares gives the start
        self.known = self.positive & (known > 0)
        guess = linear.parameters(values)[10 * model.nb :]
        size = np.linalg.norm(R[:, 10 * model.nb :], axis=0)
        small = 1e-3 * np.linalg.norm(y) / np.where(size > 0, size, 1.0)
        start = np.where(self.known, known, np.maximum(guess, np.where(small > 0, small, 1e-3)))
        start = np.where(self.positive, start, 0.0)
        logs = np.log(start, where=self.positive, out=np.zeros_like(start))
        self.start = np.concatenate([self.prior.ravel(), logs])

    def bodies(self, x: Array) -> Array:
        """theta (nb, 10)."""
        return x[: 10 * self.nb].reshape(-1, 10)

    def parameters(self, x: Array) -> Array:
        """pi (p,)."""
        phi, z = np.asarray(log_cholesky_parameters(self.bodies(x))), x[10 * self.nb :]
        return np.concatenate([phi.ravel(), np.where(self.positive, np.exp(z), z)])

    def slopes(self, x: Array) -> Array:
        """d pi / d x (p, p)."""
        z = x[10 * self.nb :]
        joints = np.diag(np.where(self.positive, np.exp(z), 1.0))
        return scipy.linalg.block_diag(*np.asarray(parameter_jacobian(self.bodies(x))), joints)

    def residual(self, x: Array) -> Array:
        """Data, prior of bodies, prior of joints."""
        bodies = np.asarray(_prior(self.bodies(x), self.prior)) * self.pull[:, None]
        off = (x - self.start)[10 * self.nb :][self.known] / 2  # logarithm of a ratio, halved
        joints = np.asarray(_scalar(off)) * self.pull.min()
        return np.concatenate([self.R @ self.parameters(x) - self.y, bodies.ravel(), joints])

    def jacobian(self, x: Array) -> Array:
        """Its derivative."""
        each = np.asarray(_prior_jacobian(self.bodies(x), self.prior)) * self.pull[:, None, None]
        off = (x - self.start)[10 * self.nb :][self.known] / 2
        slope = np.asarray(_scalar_slope(off)) / 2 * self.pull.min()
        joints = np.zeros((off.size, x.size))
        joints[np.arange(off.size), 10 * self.nb + np.flatnonzero(self.known)] = slope
        bodies = np.zeros((10 * self.nb, x.size))
        bodies[:, : 10 * self.nb] = scipy.linalg.block_diag(*each)
        return np.concatenate([self.R @ self.slopes(x), bodies, joints])


def _changed(model: Model, values: Array, joint_terms: Sequence[str]) -> Model:
    """The model with these parameters; those that are leaves of it."""
    model = with_inertial_parameters(model, jnp.asarray(values[: 10 * model.nb]))
    at, joints = joint_coordinates(model), model.joints
    for k, term in enumerate(joint_terms):
        start = 10 * model.nb + k * at.size
        part = values[start : start + at.size]
        if term == "armature":
            joints = joints.replace(armature=joints.armature.at[at].set(part))
        elif term == "viscous":
            joints = joints.replace(damping=joints.damping.at[at].set(part))
    return model.replace(joints=joints)
