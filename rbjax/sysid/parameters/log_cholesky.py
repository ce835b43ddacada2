"""Log-Cholesky coordinates of inertias, and their log-determinant divergence.

An inertia is physically consistent if its pseudo-inertia P (4, 4) is positive definite
(`rbjax.spatial`). The upper Cholesky factor of P has a positive diagonal, whose logarithms are
free:

    P = [[S, h], [h^T, m]] = U U^T,   U = e^a [[e^d1, s12, s13, t1],
                                               [0, e^d2, s23, t2],
                                               [0, 0, e^d3, t3],
                                               [0, 0, 0, 1]]
    theta = (a, d1, d2, d3, s12, s23, s13, t1, t2, t3)

Thus m = e^(2a), and t is the center of mass. The ten inertial parameters of a body are

    phi = (m, hx, hy, hz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz),   h = m c,  I about the frame's origin,

as in `rbjax.inertial_parameters` (Rucker & Wensing, IEEE RA-L 7(2), 2022). The divergence of two
inertias does not depend on frame and unit. With the eigenvalues lambda of Q^-1 P it is (Lee,
Wensing & Park, IEEE T-RO 36(3), 2020)

    d(P||Q) = tr(Q^-1 P) - log det(Q^-1 P) - 4 = sum(lambda - 1 - log lambda)
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike, floating_array, real_array, real_number
from rbjax.dynamics import inertial_parameters
from rbjax.dynamics.arguments import check_array, check_model
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.rotations.arguments import entries, stacked, takes
from rbjax.spatial import from_pseudo_inertia

PARAMETERS = ("m", "hx", "hy", "hz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
"""The ten inertial parameters of a body, in their order."""
_UPPER_ENTRIES = np.triu_indices(4, 1)


@takes(phi="inertial")
def pseudo_inertia_of(phi: ArrayLike) -> jax.Array:
    """Compute the pseudo-inertia P (..., 4, 4) from the ten inertial parameters.

        P = [[tr(I)/2 1 - I, h], [h^T, m]],   linear in phi

    Args:
        phi: (..., 10) inertial parameters in the body's frame, in kg, kg m, kg m^2.

    Returns:
        (..., 4, 4), kg m^2, kg m and kg.

    Raises:
        InputError: another shape, or values that are not finite.

    Source: Wensing, Kim & Slotine, IEEE RA-L 3(1), 2018.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.sysid.parameters import pseudo_inertia_of
        >>> ball = jnp.array([2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0])
        >>> jnp.diag(pseudo_inertia_of(ball)).tolist()
        [0.5, 0.5, 0.5, 2.0]
    """
    m, hx, hy, hz, xx, xy, yy, xz, yz, zz = entries(phi)
    half = (xx + yy + zz) / 2
    rows = [half - xx, -xy, -xz, hx, -xy, half - yy, -yz, hy, -xz, -yz, half - zz, hz, hx, hy, hz]
    return stacked([*rows, m], 4, 4)


@takes(P="matrix4")
def inertial_parameters_of(P: ArrayLike) -> jax.Array:
    """Compute the inertial parameters phi (..., 10) from the pseudo-inertia P (..., 4, 4).

    It is the inverse of `pseudo_inertia_of`.

    Args:
        P: (..., 4, 4), pseudo-inertia, kg m^2, kg m and kg.

    Returns:
        (..., 10), kg, kg m and kg m^2.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.sysid.parameters import inertial_parameters_of
        >>> inertial_parameters_of(jnp.diag(jnp.array([0.5, 0.5, 0.5, 2.0]))).tolist()
        [2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0]
    """
    xx, xy, xz, hx, _, yy, yz, hy, _, _, zz, hz, _, _, _, m = entries(P, 2)
    return stacked([m, hx, hy, hz, yy + zz, 0 - xy, xx + zz, 0 - xz, 0 - yz, xx + yy])  # no -0.0


@takes(theta="inertial")
def from_log_cholesky(theta: ArrayLike) -> jax.Array:
    """Compute the pseudo-inertia P (..., 4, 4) from log-Cholesky coordinates.

    P = U U^T is positive definite for all coordinates.

    Args:
        theta: (..., 10) log-Cholesky coordinates, any real numbers.

    Returns:
        (..., 4, 4), kg m^2, kg m and kg.

    Raises:
        InputError: another shape, or values that are not finite.

    Source: Rucker & Wensing 2022, eq. 12.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.sysid.parameters import from_log_cholesky
        >>> from_log_cholesky(jnp.zeros(10)).diagonal().tolist()
        [1.0, 1.0, 1.0, 1.0]
    """
    U = upper_factor(theta)
    return (U[..., :, None, :] * U[..., None, :, :]).sum(-1)


def log_cholesky_parameters(theta: ArrayLike) -> jax.Array:
    """Compute the inertial parameters phi (..., 10) from log-Cholesky coordinates (..., 10)."""
    return inertial_parameters_of(from_log_cholesky(theta))


def to_log_cholesky(P: ArrayLike) -> jax.Array:
    """Compute the log-Cholesky coordinates of a pseudo-inertia, the inverse of `from_log_cholesky`.

    Args:
        P: (..., 4, 4), symmetric positive definite pseudo-inertia, kg m^2, kg m and kg.

    Returns:
        theta (..., 10). In traced code it is nan if P is not positive definite.

    Raises:
        InputError: P is not positive definite, so no body has this inertia (only outside of a
            trace).

    Source: Rucker & Wensing 2022.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.sysid.parameters import to_log_cholesky
        >>> to_log_cholesky(jnp.eye(4)).tolist()
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    """
    theta = _to_log_cholesky(P)
    if not isinstance(theta, jax.core.Tracer) and not np.isfinite(theta).all():
        at = np.argwhere(~np.isfinite(theta).all(-1))[0]
        least = np.linalg.eigvalsh(np.asarray(P, float)[tuple(at)])[0]
        where = f" of body {', '.join(map(str, at))}" if at.size else ""
        raise InputError(
            f"to_log_cholesky: the pseudo-inertia{where} has the eigenvalue {least:.3g}, expected "
            "all above zero: a mass above zero and three principal moments, each smaller than the "
            "sum of the others; `nearest_pseudo_inertia` gives a body that can exist"
        )
    return theta


@takes(P="matrix4")
def _to_log_cholesky(P: jax.Array) -> jax.Array:
    xx, xy, xz, hx, _, yy, yz, hy, _, _, zz, hz, _, _, _, m = entries(P, 2)
    t1, t2, t3 = hx / m, hy / m, hz / m
    # A = S / m - t t^T; its upper factor is the upper left 3 x 3 block of U / e^a
    d3 = zz / m - t3 * t3
    e3 = jnp.sqrt(d3)
    s23, s13 = (yz / m - t2 * t3) / e3, (xz / m - t1 * t3) / e3
    d2 = yy / m - t2 * t2 - s23 * s23
    s12 = (xy / m - t1 * t2 - s13 * s23) / jnp.sqrt(d2)
    d1 = xx / m - t1 * t1 - s12 * s12 - s13 * s13
    logs = [jnp.log(x) / 2 for x in (m, d1, d2, d3)]
    return stacked([*logs, s12, s23, s13, t1, t2, t3])


@takes(theta="inertial")
def upper_factor(theta: jax.Array) -> jax.Array:
    """Compute the upper triangular U (..., 4, 4) with a positive diagonal and P = U U^T."""
    a, d1, d2, d3, s12, s23, s13, t1, t2, t3 = entries(theta)
    o, one = jnp.zeros_like(a), jnp.ones_like(a)
    e1, e2, e3 = jnp.exp(d1), jnp.exp(d2), jnp.exp(d3)
    rows = [e1, s12, s13, t1, o, e2, s23, t2, o, o, e3, t3, o, o, o, one]
    return jnp.exp(a)[..., None, None] * stacked(rows, 4, 4)


def nearest_pseudo_inertia(P: ArrayLike, margin: float = 1e-6) -> jax.Array:
    """Project to the nearest P with eigenvalues of at least `margin` times the largest.

    Use it to repair an inertia of a file that no body can have.

    Args:
        P: (..., 4, 4) symmetric pseudo-inertia.
        margin: least ratio of the smallest to the largest eigenvalue, above 0.

    Returns:
        (..., 4, 4), nearest to P in the Frobenius norm. A valid P is returned unchanged.

    Raises:
        InputError: another shape, or a margin that is not above 0.

    Source: Higham, Linear Algebra Appl. 103, 1988.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.sysid.parameters import nearest_pseudo_inertia
        >>> nearest_pseudo_inertia(jnp.diag(jnp.array([-0.1, 0.5, 0.5, 2.0])), 1e-3).shape
        (4, 4)
    """
    where = "nearest_pseudo_inertia"
    real_number(where, "margin", margin, "a number above 0", above=0.0)
    P = floating_array(where, "P", P, lambda shape: shape[-2:] == (4, 4), "(..., 4, 4)")
    if not isinstance(P, jax.core.Tracer):
        real_array(where, "P", P)  # rejects nan
    w, V = jnp.linalg.eigh((P + jnp.swapaxes(P, -1, -2)) / 2)
    least = margin * w[..., -1:]
    lifted = (V * jnp.maximum(w, least)[..., None, :]) @ jnp.swapaxes(V, -1, -2)
    return jnp.where((w[..., :1] >= least)[..., None], P, lifted)


def with_inertial_parameters(model: Model, pi: ArrayLike) -> Model:
    """Set the inertial parameters of a model's bodies, the inverse of `rb.inertial_parameters`.

    Args:
        model: robot.
        pi: (10 nb,) or (nb, 10) inertial parameters, with positive masses.

    Returns:
        The model with these parameters.

    Raises:
        InputError: not a model, another shape, or a mass that is not above zero.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.sysid.parameters import with_inertial_parameters
        >>> model = rb.load("double_pendulum")
        >>> heavier = with_inertial_parameters(model, 2 * rb.inertial_parameters(model))
        >>> (heavier.bodies.mass / model.bodies.mass).round(3).tolist()
        [2.0, 2.0]
    """
    where = "with_inertial_parameters"
    check_model(where, model)
    nb = model.nb
    pi = check_array(where, "pi", pi, (10 * nb,), (nb, 10)).reshape(nb, 10)
    if not isinstance(pi, jax.core.Tracer) and (np.asarray(pi)[:, 0] <= 0).any():
        b = int(np.argmax(np.asarray(pi)[:, 0] <= 0))
        raise InputError(
            f"{where}: the mass of {model.body_names[b]} is {float(pi[b, 0]):g}, expected more "
            "than 0; fit in log-Cholesky coordinates (`consistent`) for masses that can exist"
        )
    mass, com, inertia = from_pseudo_inertia(pseudo_inertia_of(pi))
    return model.replace(bodies=model.bodies.replace(mass=mass, com=com, inertia=inertia))


def model_log_cholesky(model: Model) -> jax.Array:
    """Compute the log-Cholesky coordinates (nb, 10) of a model's bodies.

    Raises:
        InputError: an inertia that is not physically consistent, with the name of the body.
    """
    theta = _to_log_cholesky(pseudo_inertia_of(inertial_parameters(model).reshape(-1, 10)))
    known = np.zeros(theta.shape) if isinstance(theta, jax.core.Tracer) else np.asarray(theta)
    wrong = [model.body_names[i] for i in np.flatnonzero(~np.isfinite(known).all(1))]
    if wrong:
        raise InputError(
            f"model_log_cholesky: no body has the mass and inertia of {', '.join(wrong)} (its "
            "pseudo-inertia is not positive definite: a mass of 0, a flat body, or principal "
            "moments that break the triangle inequality); correct the file, or give it "
            "with_inertial_parameters of `nearest_pseudo_inertia`"
        )
    return theta


parameter_jacobian = jax.jit(jax.vmap(jax.jacfwd(log_cholesky_parameters)))
"""d phi / d theta (n, 10, 10) of n bodies."""


def log_determinant_divergence(P: ArrayLike, Q: ArrayLike) -> jax.Array:
    """Compute the divergence d(P||Q) (...) of two pseudo-inertias, which is 0 if they are equal.

        tr(Q^-1 P) - log det(Q^-1 P) - 4

    Args:
        P: (..., 4, 4) positive definite pseudo-inertia.
        Q: (..., 4, 4) positive definite pseudo-inertia, such as a prior from the CAD model.

    Returns:
        (...), no unit.

    Raises:
        InputError: a matrix that is not positive definite (only outside of a trace).

    Source: Lee, Wensing & Park 2020, eq. 21.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.sysid.parameters import log_determinant_divergence
        >>> round(float(log_determinant_divergence(2 * jnp.eye(4), jnp.eye(4))), 4)
        1.2274
    """
    for name, x in (("P", P), ("Q", Q)):
        if not isinstance(x, jax.core.Tracer):
            real_array("log_determinant_divergence", name, x)
    r = prior_residual(to_log_cholesky(P), to_log_cholesky(Q))
    return (r * r).sum(-1)


def prior_residual(theta: ArrayLike, prior: ArrayLike) -> jax.Array:
    """Compute smooth residuals r (..., 10) with |r|^2 = d(P(theta)||P(prior)), for least squares.

        r = (B_ij for i < j, sign(x) sqrt(e^(2x) - 1 - 2x)),   B = V^-1 U,  B_ii = e^x,
        with the upper factors P = U U^T and Q = V V^T

    theta and prior are (..., 10) log-Cholesky coordinates. Source: the divergence of Lee, Wensing &
    Park 2020, in the coordinates of Rucker & Wensing 2022.
    """
    theta, prior = jnp.broadcast_arrays(theta, prior)
    B = jax.scipy.linalg.solve_triangular(upper_factor(prior), upper_factor(theta))
    step = theta - prior
    a, d = step[..., 0], step[..., 1:4]
    diagonal = scalar_residual(jnp.concatenate([a[..., None], a[..., None] + d], -1))
    return jnp.concatenate([diagonal, B[..., *_UPPER_ENTRIES]], -1)


def scalar_residual(x: jax.Array) -> jax.Array:
    """Compute r with r^2 = e^(2x) - 1 - 2x, the divergence of two numbers with ratio e^(2x).

    Near 0, r ~ sqrt(2) x.
    """
    y = 2 * x
    small = jnp.abs(y) < 0.05
    far = jnp.where(small, 1.0, y)
    # 2 (e^y - 1 - y) / y^2, by a series for small y with a last term below 1e-16
    quotient = 2 * (jnp.expm1(far) - far) / far**2
    series = jnp.zeros_like(y)
    for k in range(11, 2, -1):
        series = (1 + series) * y / k
    return x * jnp.sqrt(2 * jnp.where(small, 1 + series, quotient))
