"""Fit of physically consistent inertias to torques, by least squares in log-Cholesky coordinates.

    min over theta, x   |(tau - W pi) / s|^2 + (2 / w^2) sum over bodies of d(P(theta)||P_CAD)

pi contains the inertial parameters phi(theta) of all bodies and the joint parameters x. Armature
and friction are positive, since x contains their logarithms. Every theta is physically consistent,
so the problem has no constraints. The CAD model is the prior. d is the log-determinant divergence
(`log_cholesky`), about half the square of the relative deviation, and w is the standard deviation
of the relative deviation. With w = 1 (100 %) the prior determines the unidentifiable directions,
and changes the others by a small part of their standard error. Rucker & Wensing, IEEE RA-L 7(2),
2022; Lee, Wensing & Park, IEEE T-RO 36(3), 2020.

The data enter as the triangular factor of [W, tau], so the cost of a step does not depend on the
number of samples.
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

from rbjax.arguments import integer
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_model
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.status import HasStatus, Status
from rbjax.sysid.arguments import positive_numbers
from rbjax.sysid.parameters.divergence import TRIAL
from rbjax.sysid.parameters.log_cholesky import (
    log_cholesky_parameters,
    model_log_cholesky,
    parameter_jacobian,
    prior_residual,
    scalar_residual,
    with_inertial_parameters,
)
from rbjax.sysid.statistics.intervals import student_quantile
from rbjax.sysid.statistics.rank import Combinations
from rbjax.sysid.torque.regression import weighted
from rbjax.sysid.torque.regressors import joint_coordinates, parameter_names, parameter_values
from rbjax.sysid.torque.torque_equations import Regression, equations

Array = np.ndarray
POSITIVE = ("armature", "viscous", "coulomb", "gear_loss")
#: Lower limit of the estimated noise relative to the torque, for residuals at rounding level.
LEAST_NOISE = 1e-7

_prior = jax.jit(prior_residual)
_prior_jacobian = jax.jit(jax.vmap(jax.jacfwd(prior_residual)))
_scalar = jax.jit(scalar_residual)
_scalar_slope = jax.jit(jax.vmap(jax.grad(scalar_residual)))


@displayed
@dataclass(frozen=True, eq=False)
class Consistent(HasStatus):
    """The result of `consistent`.

    Fields:
        model: model with the estimates, except Coulomb friction, bias and gear losses.
        names: (p,) names of the parameters.
        values: (p,) estimates.
        covariance: (p, p) covariance from data and prior.
        noise: (N, k) standard deviations of the torques in the fit.
        residual: (N, k) tau - W pi.
        divergence: (nb,) divergence of each body from its prior.
        combinations: base parameters.
        linear: weighted least squares from which the search starts.
        steps: number of evaluations.
        status: a `Status`.
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
    status: Status

    @property
    def errors(self) -> Array:
        """The standard deviations (p,) of the parameters."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def beta(self) -> Array:
        """The base parameters (r,)."""
        return self.combinations.combine(self.values)

    @property
    def base_covariance(self) -> Array:
        """The covariance (r, r) of the base parameters."""
        B = self.combinations.matrix
        return B @ self.covariance @ B.T

    def intervals(self, level: float = 0.95) -> Array:
        """Compute the confidence intervals (r, 2) of the base parameters."""
        sd = np.sqrt(np.diag(self.base_covariance))
        half = student_quantile("intervals", level, self.linear.dof) * sd
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
    """Fit physically consistent inertias, and positive armature and friction, to torques.

    Use it instead of `regress` for a model that can be simulated with the estimates.

    Args:
        model: robot. Its inertias, and its positive armature and damping, are the prior and the
            start.
        W: (N, k, p) observation matrix with these joint terms.
        tau: (N, k) torques.
        joint_terms: joint terms of W's columns.
        noise: standard deviation of tau, one number, (k,) or (N, k). None: estimate it from the
            residuals of weighted least squares. noise / sqrt(weights) keeps the weights of a robust
            regression.
        spread: relative standard deviation of the prior, one number or (nb,).
        base: the combinations to fit. None: the combinations that W identifies.
        lengths: number of samples of each recording, as for `regress`.
        max_steps: largest number of evaluations.

    Returns:
        `Consistent`.

    Raises:
        InputError: invalid arrays (`regress`), a body of the model with an inconsistent inertia, or
            beams.

    Source: Rucker & Wensing 2022; Lee, Wensing & Park 2020.

    Example:
        >>> import numpy as np, rbjax as rb
        >>> from rbjax.sysid.torque import consistent, regressor
        >>> model = rb.load("double_pendulum")
        >>> W = regressor(model, *np.random.default_rng(0).normal(size=(3, 50, 2)))
        >>> heavier = model.replace(bodies=model.bodies.replace(mass=1.2 * model.bodies.mass))
        >>> found = consistent(model, W, W @ rb.inertial_parameters(heavier), noise=0.01)
        >>> found.success, bool((found.model.bodies.mass > 0).all())
        (True, True)
    """
    where = "consistent"
    check_model(where, model)
    names = parameter_names(model, joint_terms)
    if model.topology.frames:
        raise InputError(
            f"{where}: the model has beams, whose sections have no log-Cholesky coordinates; use "
            "regress, whose estimates of positive quantities may be negative"
        )
    integer(where, "max_steps", max_steps, least=1)
    eq = equations(W, tau, names, noise=noise, base=base, lengths=lengths)
    spread = positive_numbers(where, "spread", spread, model.nb, "body")
    linear = weighted(eq)
    if eq.noise is None:
        least = LEAST_NOISE * np.sqrt((eq.tau**2).mean())
        sd = np.broadcast_to(np.maximum(linear.noise, max(least, 1e-300)), eq.tau.shape)
    else:
        sd = eq.noise
    whole = np.concatenate([eq.W, eq.tau[..., None]], 2) / sd[..., None]
    R = scipy.linalg.qr(whole.reshape(-1, len(names) + 1), mode="r")[0][: len(names) + 1]
    problem = _Problem(model, joint_terms, R[:, :-1], R[:, -1], spread, linear)
    # `minimise` uses normal equations, which square the condition number. With a noise of 1e-6 the
    # rows of the prior (size 1) are below the rounding errors of the data rows.
    with np.errstate(**TRIAL):
        found = scipy.optimize.least_squares(
            problem.residual, problem.start, problem.jacobian, x_scale="jac",
            ftol=1e-14, xtol=1e-14, gtol=1e-14, max_nfev=max_steps,
        )  # fmt: skip
    values, slopes = problem.parameters(found.x), problem.slopes(found.x)
    bread = np.linalg.pinv(found.jac.T @ found.jac, hermitian=True)
    prior = found.jac[len(problem.R) :]
    # data part of the middle of the sandwich, with linear.covariance, which fits the residuals
    data = eq.combinations.matrix @ slopes
    X = (eq.X / sd[..., None]).reshape(-1, eq.combinations.rank)
    data = X.T @ X @ data
    meat = data.T @ linear.covariance @ data + prior.T @ prior
    covariance = slopes @ bread @ meat @ bread @ slopes.T
    divergence = (np.asarray(_prior(problem.bodies(found.x), problem.prior)) ** 2).sum(1)
    return Consistent(
        _write_parameters(model, values, joint_terms), names, values, covariance, sd,
        eq.tau - eq.W @ values, divergence, eq.combinations, linear, int(found.nfev),
        Status.of(bool(found.status > 0)),
    )  # fmt: skip


class _Problem:
    """Residuals and Jacobian as functions of x = (theta of the bodies, joint parameters)."""

    def __init__(
        self, model: Model, joint_terms: Sequence[str], R: Array, y: Array, spread: Array,
        linear: Regression,
    ) -> None:  # fmt: skip
        self.R, self.y, self.nb = R, y, model.nb
        self.prior = np.asarray(model_log_cholesky(model))
        self.weight = np.broadcast_to(np.sqrt(2) / spread, (model.nb,))
        each = joint_coordinates(model).size
        self.positive = np.repeat([term in POSITIVE for term in joint_terms], each).astype(bool)
        values = np.asarray(parameter_values(model, joint_terms))
        known = values[10 * model.nb :]
        # a joint parameter that is 0 in the model has no prior, and starts at the linear estimate
        self.known = self.positive & (known > 0)
        guess = linear.parameters(values)[10 * model.nb :]
        size = np.linalg.norm(R[:, 10 * model.nb :], axis=0)
        small = 1e-3 * np.linalg.norm(y) / np.where(size > 0, size, 1.0)
        start = np.where(self.known, known, np.maximum(guess, np.where(small > 0, small, 1e-3)))
        start = np.where(self.positive, start, 0.0)
        logs = np.log(start, where=self.positive, out=np.zeros_like(start))
        self.start = np.concatenate([self.prior.ravel(), logs])

    def bodies(self, x: Array) -> Array:
        """Select theta (nb, 10) of the bodies from x."""
        return x[: 10 * self.nb].reshape(-1, 10)

    def parameters(self, x: Array) -> Array:
        """Compute the parameters pi (p,) at x."""
        phi, z = np.asarray(log_cholesky_parameters(jnp.asarray(self.bodies(x)))), x[10 * self.nb :]
        return np.concatenate([phi.ravel(), np.where(self.positive, np.exp(z), z)])

    def slopes(self, x: Array) -> Array:
        """Compute the derivatives d pi / d x (p, p) of the parameters by the unconstrained x."""
        z = x[10 * self.nb :]
        joints = np.diag(np.where(self.positive, np.exp(z), 1.0))
        return scipy.linalg.block_diag(*np.asarray(parameter_jacobian(self.bodies(x))), joints)

    def residual(self, x: Array) -> Array:
        """Compute the residuals of the data and of the priors of bodies and joints."""
        bodies = np.asarray(_prior(self.bodies(x), self.prior)) * self.weight[:, None]
        off = (x - self.start)[10 * self.nb :][self.known] / 2  # half the logarithm of a ratio
        joints = np.asarray(_scalar(off)) * self.weight.min()
        return np.concatenate([self.R @ self.parameters(x) - self.y, bodies.ravel(), joints])

    def jacobian(self, x: Array) -> Array:
        """Compute the Jacobian of `residual`."""
        each = np.asarray(_prior_jacobian(self.bodies(x), self.prior)) * self.weight[:, None, None]
        off = (x - self.start)[10 * self.nb :][self.known] / 2
        slope = np.asarray(_scalar_slope(off)) / 2 * self.weight.min()
        joints = np.zeros((off.size, x.size))
        joints[np.arange(off.size), 10 * self.nb + np.flatnonzero(self.known)] = slope
        bodies = np.zeros((10 * self.nb, x.size))
        bodies[:, : 10 * self.nb] = scipy.linalg.block_diag(*each)
        return np.concatenate([self.R @ self.slopes(x), bodies, joints])


def _write_parameters(model: Model, values: Array, joint_terms: Sequence[str]) -> Model:
    """Write inertial parameters, armature and viscous friction into a model."""
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
