"""The inertial regressor of trees with beams.

    ID(q, v, a) = Y [pi; sigma] + armature a,    Y = [sum J_b^T W_b,  L sum_g w_g J_g^T W_g]

pi are the ten inertial parameters of each body (`rbjax.inertial_parameters`), with the wrenches W_b
of unit parameters on the body, and sigma the inertia of the sections of each beam. Mass per length,
rotary inertia, first moment and product of inertia of a section enter linearly, as the mass of a
body does (Khalil & Dombre, *Modeling, Identification and Control of Robots*, ch. 12).
"""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike
from rbjax.dynamics.algorithms.body_jacobians import body_jacobians
from rbjax.dynamics.algorithms.kinematics import accelerated_base, sweep
from rbjax.dynamics.algorithms.regressor import parameter_wrenches
from rbjax.dynamics.arguments import check_model
from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.errors import ModelError
from rbjax.flexible.elasticity import beam_params
from rbjax.flexible.strain import StrainBeam
from rbjax.joints import Flexible
from rbjax.lanes import Mat3, Vec3, as_arrays, matvec
from rbjax.model import WORLD, Model, prepare
from rbjax.spatial import Force, Motion, Transform


@algorithm("q", "v", "a")
def section_regressor(model: Model, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> jax.Array:
    """Compute the inertial regressor Y (nv, 10 nb + p) of a tree whose flexible links are beams.

    ID(q, v, a) = Y [pi; sigma] + armature a, with pi = `rb.inertial_parameters(model)` and
    sigma = `section_parameters(model)`. Use it to identify masses of bodies and densities of beams
    from measured forces, by linear least squares.

    Args:
        model: the robot.
        q: (nq,) configuration, m and rad.
        v: (nv,) velocity, m/s and rad/s.
        a: (nv,) acceleration, m/s^2 and rad/s^2.

    Returns:
        (nv, 10 nb + p), N and N m per unit of the parameters.

    Raises:
        ModelError: a flexible link is not a beam.

    Source: Khalil & Dombre, ch. 12.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> rod = rb.flexible.beam(2.0, [0, 0, 6.0, 0, 0, 0], {"k_z": 1}, mass=0.5)
        >>> model = rb.load("<mujoco/>").with_beam("rod", rod)
        >>> rb.flexible.section_regressor(model, *jnp.ones((3, 2))).shape
        (2, 14)
    """
    _check_beams("section_regressor", model)
    if not model.nv:
        return jnp.zeros((0, 10 * model.nb), q.dtype)
    d, top = Unrolled(model, prepare(model, q.dtype)), model.topology
    base = accelerated_base(Motion(Vec3.zero(), -d.prepared.gravity))
    (motions,) = sweep(d, d.joints(q, v), base, a=d.lanes(a))
    J, origin = body_jacobians(model, q), Transform(Mat3.identity(), Vec3.zero())

    def column(link: int, f: Force) -> jax.Array:
        return matvec(J[link].T, jnp.stack(as_arrays([*f], v[0])))

    columns = []
    for b, link in enumerate(top.body_links):
        if link == WORLD:
            columns += [jnp.zeros_like(v)] * 10
            continue
        forces = parameter_wrenches(origin, d.prepared.weld(b), motions[link])
        columns += [column(link, f) for f in forces]
    for joint, kind in _beams(model):
        first = top.frame_starts[model.joint(joint)]
        params = beam_params(model, joint, q.dtype, "section_regressor")[1]
        for name, k in kind.section_params:
            total = jnp.zeros_like(v)
            for g, inertia in enumerate(kind.unit_inertias(params, name, k)):
                w, acceleration, _ = motions[first + g]
                f = inertia(acceleration) + inertia.bias_force(w)
                total = total + column(first + g, f)
            columns.append(total)
    return jnp.stack(columns, -1)


def section_parameters(model: Model) -> jax.Array:
    """Compute the inertial parameters sigma (p,) of the sections of all beams of a model.

    Of each beam: mass_per_length, rotary_inertia (x, y, z), and for eccentric sections first_moment
    (y, z) and product_of_inertia; of a tapered beam at each Gauss point (`section_names`).

    Args:
        model: the robot.

    Returns:
        (p,), kg/m, kg m, kg and kg m.

    Raises:
        InputError: not a model. ModelError: a flexible link that is not a beam.

    Example:
        >>> import rbjax as rb
        >>> rod = rb.flexible.beam(2.0, [0, 0, 6.0, 0, 0, 0], {"k_z": 1}, mass=0.5)
        >>> rb.flexible.section_parameters(rb.load("<mujoco/>").with_beam("rod", rod)).tolist()
        [0.5, 0.0, 0.0, 0.0]
    """
    check_model("section_parameters", model)
    _check_beams("section_parameters", model)
    dtype, out = model.gravity.dtype, []
    for joint, kind in _beams(model):
        params = beam_params(model, joint, dtype, "section_parameters")[1]
        out += [jnp.asarray(params[name][k], dtype) for name, k in kind.section_params]
    return jnp.stack(out) if out else jnp.zeros(0, dtype)


def section_names(model: Model) -> tuple[str, ...]:
    """Return the names of `section_parameters`, such as "rod.rotary_inertia[2]".

    Args:
        model: the robot.

    Returns:
        (p,) names.

    Raises:
        InputError: not a model.

    Example:
        >>> import rbjax as rb
        >>> rod = rb.flexible.beam(2.0, [0, 0, 6.0, 0, 0, 0], {"k_z": 1}, mass=0.5)
        >>> rb.flexible.section_names(rb.load("<mujoco/>").with_beam("rod", rod))[:2]
        ('rod.mass_per_length[0]', 'rod.rotary_inertia[0]')
    """
    check_model("section_names", model)
    return tuple(
        f"{joint}.{name}[{k}]" for joint, x in _beams(model) for name, k in x.section_params
    )


def _beams(model: Model) -> Iterator[tuple[str, StrainBeam]]:
    for name, kind in zip(model.joint_names, model.topology.joints, strict=True):
        if isinstance(kind, StrainBeam):
            yield name, kind


def _check_beams(where: str, model: Model) -> None:
    for name, kind in zip(model.joint_names, model.topology.joints, strict=True):
        if isinstance(kind, Flexible) and not isinstance(kind, StrainBeam):
            raise ModelError(
                f"{where}: the link {name!r} is flexible and not a beam, and its inertia is not "
                "linear in its parameters; differentiate inverse_dynamics by joints.params instead"
            )
