"""The regressor of inverse dynamics, and the base parameters of a robot.

    tau = Y(q, v, a) pi

Y has ten inertial columns for each body (`rbjax.inertial_regressor`) and one column for each term
of each joint coordinate i:

    armature J_i a_i,  viscous d_i v_i,  coulomb F_i tanh(v_i / v_0),  bias b_i
    gear_loss mu_i |tau_i| tanh(v_i / v_0)

tau (nv,) is the torque of the motors, including friction. A gear loses a share mu of the torque
that it transmits (`forces.GearLoss`), so the gear_loss column contains the measured torque. The
regressors of all samples form the observation matrix. Khalil & Dombre, *Modeling, Identification
and Control of Robots*, ch. 12; Swevers, Verdonck & De Schutter, IEEE Control Systems 27(5), 2007.

The rank of the observation matrix of random motions is structural. Its independent combinations are
the base parameters (Gautier & Khalil, IEEE Trans. Robotics and Automation 6(3), 1990). With a free
base, the six equations of the base determine all base parameters (Ayusawa, Venture & Nakamura, IJRR
33(3), 2014).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike, choice, real_number
from rbjax.dynamics import inertial_parameters, inertial_regressor
from rbjax.dynamics.arguments import check_arrays, check_model, check_moves, shape_of
from rbjax.errors import InputError
from rbjax.flexible import (
    elastic_names,
    elastic_parameters,
    elastic_regressor,
    section_names,
    section_parameters,
    section_regressor,
)
from rbjax.joints import Flexible
from rbjax.lanes import fusion_barrier
from rbjax.model import Model
from rbjax.sysid.parameters.log_cholesky import PARAMETERS
from rbjax.sysid.statistics.rank import Combinations, combinations
from rbjax.sysid.torque.motions import random_motions


def _sign(v: jax.Array, v_0: float) -> jax.Array:
    return jnp.tanh(v / v_0) if v_0 else jnp.sign(v)


#: name of a joint term -> function of v, a, tau and smoothing v_0 that returns the column's entry
JOINT_TERMS: dict[str, Callable[..., jax.Array]] = {
    "armature": lambda v, a, tau, v_0: a,
    "viscous": lambda v, a, tau, v_0: v,
    "coulomb": lambda v, a, tau, v_0: _sign(v, v_0),
    "bias": lambda v, a, tau, v_0: jnp.ones_like(v),
    "gear_loss": lambda v, a, tau, v_0: jnp.abs(tau) * _sign(v, v_0),
}


def regressor(
    model: Model,
    q: ArrayLike,
    v: ArrayLike,
    a: ArrayLike,
    *,
    rows: Sequence[int | str] | slice | None = None,
    joint_terms: Sequence[str] = (),
    smoothing: float = 0.0,
    tau: ArrayLike | None = None,
) -> jax.Array:
    """Compute the regressor Y(q, v, a) (nv, p) with tau = Y pi, or those of n samples.

    The regressors (n, rows, p) of the samples of a motion are its observation matrix W.

    Args:
        model: robot. Only its kinematics and gravity are used.
        q: (nq,) configuration, or (n, nq).
        v: (nv,) velocity, or (n, nv).
        a: (nv,) acceleration, or (n, nv).
        rows: measured torques, as joint names or indices of v. None: all.
        joint_terms: names from "armature", "viscous", "coulomb", "bias", "gear_loss". Each term
            adds one column for every joint coordinate, except for free joints and beams.
        smoothing: v_0 in rad/s or m/s, the width of the step of dry friction at rest. 0 is sign(v),
            as in a real drive. If v_0 is larger than in the real drive, the estimated viscous
            friction is too small. For simulated data use the smoothing of the simulated friction.
        tau: (nv,) or (n, nv) measured torques, required by "gear_loss".

    Returns:
        (rows, 10 nb + columns of beams and joints), in the order of `parameter_names`; or
            (n, rows, ...).

    Raises:
        UnknownName: an unknown joint term or joint.
        InputError: wrong arrays, an invalid row, a negative smoothing, or "gear_loss" without tau.
        ModelError: a flexible link that is not a beam; its inertia is not linear in its numbers.

    Source: Khalil & Dombre, ch. 12; Swevers, Verdonck & De Schutter 2007, eq. 12.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax.sysid.torque import regressor
        >>> model = rb.load("double_pendulum")
        >>> q, v, a = jnp.linspace(0.0, 1.0, 30).reshape(3, 5, 2)
        >>> regressor(model, q[0], v[0], a[0], joint_terms=["viscous"]).shape
        (2, 22)
        >>> regressor(model, q, v, a, rows=[1]).shape
        (5, 1, 20)
    """
    where = "regressor"
    check_model(where, model)
    _check_terms(where, joint_terms, smoothing)
    if "gear_loss" in joint_terms and tau is None:
        raise InputError('regressor: "gear_loss" without tau, expected the measured torques (nv,)')
    samples = shape_of(where, "q", q)[:-1][:1]
    given = {"q": q, "v": v, "a": a} | ({} if tau is None else {"tau": tau})
    arrays = check_arrays(where, model, given, samples)
    one = functools.partial(_regressor, model, tuple(joint_terms), smoothing)
    Y = (jax.vmap(one) if samples else one)(arrays)
    return Y if rows is None else Y[..., coordinate_rows(model, rows), :]


def _regressor(
    model: Model, joint_terms: tuple[str, ...], smoothing: float, arrays: dict[str, jax.Array]
) -> jax.Array:
    q, v, a = arrays["q"], arrays["v"], arrays["a"]
    if _has_flexible_links(model):
        Y = jnp.concatenate([section_regressor(model, q, v, a), elastic_regressor(model, q, v)], 1)
    else:
        Y = inertial_regressor(model, q, v, a)
    if not joint_terms:
        return Y
    at = joint_coordinates(model)
    v, a, tau = (jnp.asarray(x, Y.dtype)[at] for x in (v, a, arrays.get("tau", a)))
    chosen = jnp.zeros((model.nv, at.size), Y.dtype).at[at, np.arange(at.size)].set(1.0)
    columns = [chosen * JOINT_TERMS[term](v, a, tau, smoothing) for term in joint_terms]
    return jnp.concatenate([fusion_barrier(Y), *columns], 1)


def parameter_names(model: Model, joint_terms: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the names of the regressor's columns: "body.m", "body.hx", ..., "joint.armature", ...

    The coordinates of a ball joint are "joint.armature[k]". The columns of a beam are
    "beam.mass_per_length[0]", ..., "beam.stiffness[k_y]", ..., "beam.viscosity[k_y]", ...

    Args:
        model: robot.
        joint_terms: names of joint terms, such as "viscous" (`JOINT_TERMS`).

    Returns:
        (p,) names.

    Raises:
        InputError: not a model. UnknownName: no such joint term.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.sysid.torque import parameter_names
        >>> parameter_names(rb.load("pendulum"), ["viscous"])[-2:]
        ('rod.Izz', 'hinge.viscous')
    """
    check_model("parameter_names", model)
    _check_terms("parameter_names", joint_terms)
    inertial = [f"{body}.{name}" for body in model.body_names for name in PARAMETERS]
    links, names = model.topology.dofs, model.joint_names
    coordinates = [links[i] for i in joint_coordinates(model)]
    places = [
        "" if len(model.topology.joints[k.joint].dofs) == 1 else f"[{k.v.start - s}]"
        for k in coordinates
        for s in [model.topology.joint_v[k.joint]]
    ]
    joints = [
        f"{names[k.joint]}.{term}{place}"
        for term in joint_terms
        for k, place in zip(coordinates, places, strict=True)
    ]
    beams = (*section_names(model), *elastic_names(model))
    return (*inertial, *beams, *joints)


def parameter_values(model: Model, joint_terms: Sequence[str] = ()) -> jax.Array:
    """Read the parameters pi (p,) from a model, in the order of `parameter_names`.

    Coulomb friction, bias and gear losses are 0, since they are not leaves of joints.

    Args:
        model: robot.
        joint_terms: names of joint terms, such as "viscous" (`JOINT_TERMS`).

    Returns:
        (p,), kg, kg m, kg m^2, and the units of the joint terms, SI.

    Raises:
        InputError: not a model. UnknownName: no such joint term.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.sysid.torque import parameter_values
        >>> parameter_values(rb.load("double_pendulum"), ["armature"]).shape
        (22,)
    """
    check_model("parameter_values", model)
    _check_terms("parameter_values", joint_terms)
    at, joints = joint_coordinates(model), model.joints
    known = {"armature": joints.armature, "viscous": joints.damping}
    none = jnp.zeros_like(joints.armature)
    beams = []
    if _has_flexible_links(model):
        beams = [section_parameters(model), elastic_parameters(model)]
    terms = (known.get(term, none)[at] for term in joint_terms)
    return jnp.concatenate([inertial_parameters(model), *beams, *terms])


def _has_flexible_links(model: Model) -> bool:
    return any(isinstance(joint, Flexible) for joint in model.topology.joints)


def joint_coordinates(model: Model) -> np.ndarray:
    """Return the indices of v of all joints except free joints and flexible links, which have no
    motor or friction."""
    joints = model.topology.joints
    moved = [j.name != "free" and not isinstance(j, Flexible) for j in joints]
    return np.array([i for i, k in enumerate(model.topology.dofs) if moved[k.joint]], int)


def coordinate_rows(model: Model, rows: Sequence[int | str] | slice | None) -> np.ndarray:
    """Convert joint names, indices of v, or a slice to indices of v."""
    if rows is None or isinstance(rows, slice):
        return np.arange(model.nv)[rows if rows is not None else slice(None)]
    if isinstance(rows, str) or not isinstance(rows, Iterable):
        raise InputError(f"rows is {rows!r}, expected a sequence such as [{rows!r}]")
    found: list[int] = []
    for row in rows:
        if isinstance(row, str):
            place = model.v_slice(row)
            found += range(place.start, place.stop)
        elif type(row) is not bool and isinstance(row, (int, np.integer)) and 0 <= row < model.nv:
            found.append(int(row))
        else:
            raise InputError(
                f"rows has {row!r}, expected joint names or places in v from 0 to {model.nv - 1}"
            )
    if not found or len(set(found)) < len(found):
        raise InputError(f"rows is {list(rows)}, expected at least one row, and none twice")
    return np.array(found, int)


def _check_terms(where: str, terms: Any, smoothing: float = 0.0) -> None:
    if isinstance(terms, str) or not isinstance(terms, Iterable):
        example = terms if isinstance(terms, str) else "viscous"
        raise InputError(
            f"{where}: joint_terms is {terms!r}, expected a list such as [{example!r}]"
        )
    terms = list(terms)
    for term in terms:
        choice("joint term", term, JOINT_TERMS)
    if len(set(terms)) < len(terms):
        raise InputError(f"{where}: joint_terms is {list(terms)}, expected none twice")
    real_number(where, "smoothing", smoothing, "a speed in rad/s or m/s, 0 or more", least=0.0)


def base_parameters(
    model: Model,
    q: ArrayLike | None = None,
    v: ArrayLike | None = None,
    a: ArrayLike | None = None,
    *,
    rows: Sequence[int | str] | slice | None = None,
    joint_terms: Sequence[str] = (),
    first: Sequence[str] = (),
    samples: int | None = None,
    seed: int = 0,
    tolerance: float | None = None,
    smoothing: float = 0.0,
) -> Combinations:
    """Find the base parameters of a robot: the combinations that torques identify.

        tau = Y pi = Y_kept beta,   beta = pi_kept + K pi_dropped

    Args:
        model: robot. The result depends on its gravity, but not on its masses.
        q: (n, nq) configurations. None: random motions.
        v: (n, nv) velocities.
        a: (n, nv) accelerations.
        rows: measured torques, as joint names or indices of v. None: all. The first six rows of a
            free base are its wrench.
        joint_terms: names from "armature", "viscous", "coulomb", "bias".
        first: names of parameters to keep with priority, such as "joint1.armature" before
            "link1.Izz".
        samples: number of random motions. None: as many as necessary.
        seed: seed of the random motions.
        tolerance: relative singular value that counts as zero, as for `combinations`.
        smoothing: width of the step of Coulomb friction, as for `regressor`.

    Returns:
        `Combinations`: rank, kept and dropped parameters, K, and `summary()`.

    Raises:
        InputError: a model without joints, wrong shapes, or only some of q, v and a.

    Source: Gautier 1991.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.sysid.torque import base_parameters
        >>> base = base_parameters(rb.load("double_pendulum"), joint_terms=["armature"])
        >>> base.rank
        7
        >>> base.terms()[2]
        'upper.Iyy + lower.m + shoulder.armature'
    """
    where = "base_parameters"
    check_model(where, model)
    check_moves(where, model)
    names = parameter_names(model, joint_terms)
    if q is None and v is None and a is None:
        if samples is None:  # twice as many equations as columns, from the fewest rows
            samples = 20 + 2 * len(names) // min(model.nv, 6)
        q, v, a = map(jnp.asarray, random_motions(model, samples, seed=seed))
    if q is None or v is None or a is None:
        raise InputError(f"{where}: expected all of q, v and a, or none for random motions")
    W = regressor(model, q, v, a, rows=rows, joint_terms=joint_terms, smoothing=smoothing)
    return combinations(W, names, tolerance=tolerance, first=first)
