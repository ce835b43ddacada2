"""Domain randomisation of a robot: friction, masses, centers of mass, joints.

All are uniform, and drawn at each reset.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import real_array, real_number, shown
from rbjax.dynamics.arguments import check_model
from rbjax.envs.task import Randomisation, random_offset, random_scale
from rbjax.errors import InputError
from rbjax.model import Model, joint_slices


def set_friction(name: str, geoms: Sequence[int], low: float, high: float) -> Randomisation:
    """Return the randomisation that sets one coefficient of sliding friction of geoms.

    Args:
        name: name of the randomisation.
        geoms: indices of the geoms.
        low, high: smallest and largest coefficient, without unit.

    Returns:
        `Randomisation`.

    Raises:
        InputError: low above high, or below zero; at a reset, an index that the model lacks.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.terms.set_friction("floor", [0], 0.4, 1.0).name
        'floor'
    """
    draw = _coefficient("set_friction", low, high)

    def apply(model: Model, value: jax.Array) -> Model:
        old = _coefficients("set_friction", "geoms", geoms, model, "friction")
        chosen = np.zeros(old.shape, bool)
        chosen[list(geoms), 0] = True
        friction = jnp.where(chosen, value, old)
        return eqx.tree_at(lambda m: m.geoms.friction, model, friction)

    return Randomisation(name, draw, apply)


def set_pair_friction(name: str, pairs: Sequence[int], low: float, high: float) -> Randomisation:
    """Return the randomisation that sets one coefficient of sliding friction of explicit pairs.

    Args:
        name: name of the randomisation.
        pairs: indices of the explicit pairs of geoms of the model.
        low, high: smallest and largest coefficient, without unit.

    Returns:
        `Randomisation`.

    Raises:
        InputError: low above high, or below zero; at a reset, an index that the model lacks.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.terms.set_pair_friction("soles", [0, 1], 0.4, 1.0).name
        'soles'
    """
    draw = _coefficient("set_pair_friction", low, high)

    def apply(model: Model, value: jax.Array) -> Model:
        old = _coefficients("set_pair_friction", "pairs", pairs, model, "pair_friction")
        chosen = np.zeros(old.shape, bool)
        chosen[list(pairs), :2] = True
        friction = jnp.where(chosen, value, old)
        return eqx.tree_at(lambda m: m.geoms.pair_friction, model, friction)

    return Randomisation(name, draw, apply)


def joint_randomisations(
    model: Model, *, friction: tuple[float, float], armature: tuple[float, float], zero: float
) -> tuple[Randomisation, ...]:
    """Return the randomisations of all hinges and slides.

    Args:
        model: the robot.
        friction, armature: ranges of the factors of friction loss and armature of each joint.
        zero: greatest change of the zero of each joint, rad or m.

    Raises:
        InputError: not a model, a model without hinges and slides, or ranges that are not low to
            high.

    Example:
        >>> import rbjax as rb
        >>> found = rb.envs.terms.joint_randomisations(
        ...     rb.load("quadruped"), friction=(0.9, 1.1), armature=(1.0, 1.05), zero=0.05)
        >>> [r.name for r in found]
        ['friction_loss', 'armature', 'joint_zero']
    """
    where = "joint_randomisations"
    check_model(where, model)
    zero = real_number(where, "zero", zero, least=0.0)
    ranges = [_range(where, *x) for x in (("friction", friction), ("armature", armature))]
    joints, coordinates = np.zeros(model.nv, bool), np.zeros(model.nq, bool)
    spans = zip(model.topology.joint_kinds, joint_slices(model.topology), strict=True)
    for kind, span in spans:
        if kind in ("hinge", "slide"):
            joints[span.v] = coordinates[span.q] = True
    if not joints.any():
        raise InputError(f"{where}: the model has no hinge and no slide, expected at least one")

    def factors(limits: tuple[float, float]) -> list[np.ndarray]:
        return [np.where(joints, x, 1.0) for x in limits]

    most = np.where(coordinates, zero, 0.0)
    return (
        random_scale("friction_loss", _friction_loss, *factors(ranges[0]), each=True),
        random_scale("armature", lambda m: m.joints.armature, *factors(ranges[1]), each=True),
        random_offset("joint_zero", lambda m: m.joints.reference, -most, most, each=True),
    )


def shift_center_of_mass(model: Model, body: str, most: float) -> Randomisation:
    """Return the randomisation of the center of mass of a body.

    Args:
        model: the robot.
        body: name of the body.
        most: greatest shift along each axis, m.

    Returns:
        `Randomisation`.

    Raises:
        UnknownName: no body has this name.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.terms.shift_center_of_mass(rb.load("quadruped"), "trunk", 0.05).name
        'center_of_mass'
    """
    check_model("shift_center_of_mass", model)
    most = real_number("shift_center_of_mass", "most", most, least=0.0)
    limit = np.zeros(model.bodies.com.shape)
    limit[model.body(body)] = most
    return random_offset("center_of_mass", lambda m: m.bodies.com, -limit, limit, each=True)


def mass_randomisations(
    model: Model, body: str, *, factor: tuple[float, float], added: float
) -> tuple[Randomisation, ...]:
    """Return the randomisations of masses. Moments of inertia do not change.

    Args:
        model: the robot.
        body: the body that carries a load.
        factor: range of the factor of the mass of each body.
        added: greatest absolute mass that is added to the body, kg, less than its least mass.

    Raises:
        InputError: not a model, ranges that are not low to high, or a mass that can become
            negative.

    Example:
        >>> import rbjax as rb
        >>> found = rb.envs.terms.mass_randomisations(
        ...     rb.load("quadruped"), "trunk", factor=(0.9, 1.1), added=1.0)
        >>> [r.name for r in found]
        ['masses', 'load']
    """
    check_model("mass_randomisations", model)
    added = real_number("mass_randomisations", "added", added, least=0.0)
    factor = _range("mass_randomisations", "factor", factor)
    limit = np.zeros(model.nb)
    limit[model.body(body)] = added
    mass = float(np.asarray(model.bodies.mass)[model.body(body)])
    if added >= factor[0] * mass:
        raise InputError(
            f"mass_randomisations: added is {added} kg and the least mass of {body!r} is "
            f"{factor[0] * mass:.4g} kg, expected less, so that its mass stays above zero"
        )
    return (
        random_scale("masses", lambda m: m.bodies.mass, *factor, each=True),
        random_offset("load", lambda m: m.bodies.mass, -limit, limit, each=True),
    )


def _coefficients(where: str, name: str, rows: Sequence[int], model: Model, leaf: str) -> jax.Array:
    """Return coefficients of friction of a model that have these rows."""
    found: Any = getattr(model.geoms, leaf, np.zeros((0, 3)))
    wrong = [i for i in rows if not 0 <= i < len(found)]
    if wrong or not len(rows):
        raise InputError(
            f"{where}: {name} has {wrong or 'no index'}, expected indices of 0 to "
            f"{len(found) - 1}; the model has {len(found)} {name}"
        )
    return found


def _coefficient(where: str, low: Any, high: Any) -> Callable[[Any, Any], jax.Array]:
    """Return the draw of one coefficient of friction between `low` and `high`."""
    low, high = _range(where, "(low, high)", (low, high))
    if low < 0:
        raise InputError(f"{where}: low is {low}, expected at least 0")

    def draw(key: Any, params: Any) -> jax.Array:
        return jax.random.uniform(key, (), minval=low, maxval=high)

    return draw


def _range(where: str, name: str, given: Any) -> tuple[float, float]:
    """Return a range (low, high) of finite numbers."""
    found = real_array(where, name, given, ndim=1)
    if found.size != 2 or not found[0] <= found[1]:
        raise InputError(f"{where}: {name} is {shown(given)}, expected (low, high), low first")
    return float(found[0]), float(found[1])


def _friction_loss(model: Any) -> jax.Array:
    loss: jax.Array = model.solver.frictionloss
    return loss
