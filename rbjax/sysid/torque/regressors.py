"""The regressor: torques are linear in the parameters of bodies and joints.

    tau = Y(q, v, a) pi

with ten inertial columns for each body (`rbjax.inertial_regressor`) and one column for each term of
each joint coordinate i:

    armature J_i a_i,  viscous d_i v_i,  coulomb F_i tanh(v_i / v_0),  bias b_i
    gear_loss mu_i |tau_i| tanh(v_i / v_0)

tau (nv,) is what the motors give: it moves the bodies and overcomes the friction. A gear loses a
share mu of the torque that it transmits (`forces.GearLoss`); that column takes the measured torque.
Samples one below the other form the observation matrix. Khalil & Dombre, *Modeling, Identification
and Control of Robots*, ch. 12; Swevers, Verdonck & De Schutter, IEEE Control Systems 27(5), 2007.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics import inertial_parameters, inertial_regressor
from rbjax.dynamics.arguments import SHAPES, check_array, check_model, shape_of
from rbjax.errors import InputError, UnknownName
from rbjax.lanes import fusion_barrier
from rbjax.model import Model
from rbjax.sysid.parameters.log_cholesky import PARAMETERS


def _sign(v: jax.Array, v_0: float) -> jax.Array:
    return jnp.tanh(v / v_0) if v_0 else jnp.sign(v)


#: name of a term -> its column's entry from v, a, tau and the smoothing v_0 of one coordinate
JOINT_TERMS: dict[str, Callable[..., jax.Array]] = {
    "armature": lambda v, a, tau, v_0: a,
    "viscous": lambda v, a, tau, v_0: v,
    "coulomb": lambda v, a, tau, v_0: _sign(v, v_0),
    "bias": lambda v, a, tau, v_0: jnp.ones_like(v),
    "gear_loss": lambda v, a, tau, v_0: jnp.abs(tau) * _sign(v, v_0),
}


def regressor(
    model: Model,
    q: jax.Array,
    v: jax.Array,
    a: jax.Array,
    *,
    joint_terms: Sequence[str] = (),
    smoothing: float = 0.0,
    tau: jax.Array | None = None,
) -> jax.Array:
    """Y(q, v, a) (nv, p) with tau = Y pi, the columns in the order of `parameter_names`.

    Args:
        model: the robot; of its numbers only kinematics and gravity matter.
        q: (nq,) configuration.
        v: (nv,) velocity.
        a: (nv,) acceleration.
        joint_terms: of "armature", "viscous", "coulomb", "bias", "gear_loss": columns of every
            joint coordinate except those of free joints.
        smoothing: v_0 in rad/s or m/s, the width of the step of dry friction at rest. 0 is sign(v),
            as in a real drive: if the step is wider than the drive's, the estimate of its viscous
            friction is too small. For simulated data take the smoothing of the simulated friction.
        tau: (nv,) measured torques, which "gear_loss" needs.

    Returns:
        (nv, 10 nb + columns of joints).

    Raises:
        UnknownName: a joint term that does not exist. InputError: wrong arrays; a negative
            smoothing; "gear_loss" without tau.

    Source: Khalil & Dombre, ch. 12.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.sysid.torque import regressor
        >>> model = rb.load("double_pendulum")
        >>> s = model.default_state()
        >>> regressor(model, s.q, s.v, s.v, joint_terms=["viscous"]).shape
        (2, 22)
    """
    _check_terms("regressor", joint_terms, smoothing)
    if "gear_loss" in joint_terms and tau is None:
        raise InputError('regressor: "gear_loss" without tau, expected the measured torques (nv,)')
    if tau is not None:
        check_model("regressor", model)
        tau = check_array("regressor", "tau", tau, (model.nv,))
    Y = inertial_regressor(model, q, v, a)
    if not joint_terms:
        return Y
    at = joint_coordinates(model)
    v, a, tau = (jnp.asarray(x, Y.dtype)[at] for x in (v, a, a if tau is None else tau))
    chosen = jnp.zeros((model.nv, at.size), Y.dtype).at[at, np.arange(at.size)].set(1.0)
    columns = [chosen * JOINT_TERMS[term](v, a, tau, smoothing) for term in joint_terms]
    return jnp.concatenate([fusion_barrier(Y), *columns], 1)


def observation_matrix(
    model: Model,
    q: jax.Array,
    v: jax.Array,
    a: jax.Array,
    *,
    rows: Sequence[int | str] | slice | None = None,
    joint_terms: Sequence[str] = (),
    smoothing: float = 0.0,
    tau: jax.Array | None = None,
) -> jax.Array:
    """W (n, rows, p): the regressor at each of n samples of a motion.

    Args:
        model: the robot.
        q: (n, nq) configurations.
        v: (n, nv) velocities.
        a: (n, nv) accelerations.
        rows: the torques that are measured, as joint names or places in v; None for all.
        joint_terms: as for `regressor`.
        smoothing: as for `regressor`.
        tau: (n, nv) measured torques, which "gear_loss" needs.

    Returns:
        (n, rows, p).

    Raises:
        UnknownName, InputError: as `regressor`; a row that does not exist.

    Source: Swevers, Verdonck & De Schutter 2007, eq. 12.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax.sysid.torque import observation_matrix
        >>> model = rb.load("double_pendulum")
        >>> q, v, a = jnp.linspace(0.0, 1.0, 30).reshape(3, 5, 2)
        >>> observation_matrix(model, q, v, a, rows=[1]).shape
        (5, 1, 20)
    """
    where = "observation_matrix"
    check_model(where, model)
    n = (*shape_of(where, "q", q), 1)[0]
    q, v, a = (
        check_array(where, name, x, (n, *SHAPES[name](model)), fix=": one row a sample")
        for name, x in (("q", q), ("v", v), ("a", a))
    )
    each = functools.partial(regressor, model, joint_terms=joint_terms, smoothing=smoothing)
    if tau is None:
        W = jax.vmap(each)(q, v, a)
    else:
        tau = check_array(where, "tau", tau, (n, model.nv), fix=": one row a sample")
        W = jax.vmap(lambda q, v, a, tau: each(q, v, a, tau=tau))(q, v, a, tau)
    return W if rows is None else W[:, coordinate_rows(model, rows)]


def parameter_names(model: Model, joint_terms: Sequence[str] = ()) -> tuple[str, ...]:
    """The columns of `regressor`: "body.m", "body.hx", ..., "body.Izz", "joint.armature", ...

    Coordinate k of a ball joint is "joint.armature[k]".

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
    return (*inertial, *joints)


def parameter_values(model: Model, joint_terms: Sequence[str] = ()) -> jax.Array:
    """pi (p,) of a model, in the order of `parameter_names`: inertial parameters, armature, viscous
    damping of its joints; 0 for Coulomb friction, bias and gear losses, which are no leaves of
    joints.

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
    return jnp.concatenate(
        [inertial_parameters(model), *(known.get(term, none)[at] for term in joint_terms)]
    )


def joint_coordinates(model: Model) -> np.ndarray:
    """The places in v of all joints but the free ones: those that may have a motor and friction."""
    top = model.topology
    return np.array([i for i, k in enumerate(top.dofs) if top.joint_kinds[k.joint] != "free"], int)


def coordinate_rows(model: Model, rows: Sequence[int | str] | slice | None) -> np.ndarray:
    """Places in v from joint names, places, or a slice."""
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
        if not isinstance(term, str) or term not in JOINT_TERMS:
            raise UnknownName("joint term", term, JOINT_TERMS)
    if len(set(terms)) < len(terms):
        raise InputError(f"{where}: joint_terms is {list(terms)}, expected none twice")
    number = isinstance(smoothing, (int, float)) and not isinstance(smoothing, bool)
    if not number or not 0 <= smoothing < np.inf:
        raise InputError(
            f"{where}: smoothing is {smoothing!r}, expected a speed in rad/s or m/s, 0 or more"
        )
