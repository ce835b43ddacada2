"""Beams and cables as links of a robot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import check_positive, real_array
from rbjax.errors import InputError
from rbjax.flexible import reduced_basis
from rbjax.flexible.cross_section import Section, section
from rbjax.flexible.elasticity import BeamElasticity
from rbjax.flexible.linear_elasticity import diagonal_if_known, with_free_base
from rbjax.flexible.strain import STRAINS, StrainBeam, strain_beam
from rbjax.model import Model
from rbjax.model.record import Record
from rbjax.rotations.arguments import checked


class Beam(Record):
    """A flexible beam, which `Model.with_beam` adds to a robot. Create it with `beam`.

    Fields:
        length: (), m.
        section: the cross-section, or one at each Gauss point of a tapered beam.
        viscosity: C_v of the section, (6,) or (6, 6) or one at each Gauss point, as
            `section.stiffness`.
        natural: name of the curvature -> Legendre coefficients of natural curvature and twist, 1/m.
        degrees: (strain, degree) pairs; static.
        points: the number of Gauss points, or None for the default; static.
        basis: rows of T of a reduced beam (`reduced`), one for each Legendre coefficient; static.
    """

    length: jax.Array
    section: Section
    viscosity: jax.Array
    natural: dict[str, jax.Array]
    degrees: tuple[tuple[str, int], ...] = eqx.field(static=True)
    points: int | None = eqx.field(static=True, default=None)
    basis: tuple[tuple[float, ...], ...] = eqx.field(static=True, default=())

    @property
    def tapered(self) -> bool:
        """True if the section varies along the beam."""
        return np.ndim(self.section.mass) == 1

    def joint(self, frames: tuple[float, ...] = ()) -> StrainBeam:
        """Return the kind of joint of the beam, with further frames at s / L."""
        return strain_beam(
            dict(self.degrees),
            points=self.points,
            frames=frames,
            natural={name: len(x) - 1 for name, x in self.natural.items()},
            tapered=self.tapered,
            eccentric=self.section.eccentric,
            basis=self.basis or None,
        )

    def params(self, joint: StrainBeam) -> jax.Array:
        """Return the parameters (n,) of the kind of joint."""
        section = self.section
        values = {
            "length": self.length,
            "mass_per_length": section.mass,
            "rotary_inertia": section.inertia,
            "first_moment": section.first_moment,
            "product_of_inertia": section.product,
            **{f"natural_{name}": x for name, x in self.natural.items()},
        }
        return jnp.concatenate([jnp.ravel(values[name]) for name in joint.params])

    def add(
        self,
        model: Model,
        name: str,
        parent: str = "world",
        *,
        position: Any = (0.0, 0.0, 0.0),
        orientation: Any = (1.0, 0.0, 0.0, 0.0),
        free: bool = False,
        frames: Mapping[str, float] | None = None,
    ) -> Model:
        """Add the beam to a model. `Model.with_beam` calls it.

        The beam starts at its base frame, along x, and the body `name` is its tip. Add bodies,
        sites, constraints and forces to the tip and to the bodies of `frames` by their names.
        Contacts act on geoms of the tip and of the frames (`rb.contact.with_geom`), not on the
        surface of the beam.

        Args:
            model: the model.
            name: name of the beam's joint, and of the body at its tip.
            parent: the body to which the base is clamped, or "world".
            position: (3,) m, of the base frame in the parent.
            orientation: (4,) unit quaternion of the base frame in the parent.
            free: True for a base that moves freely, by a joint named `name` + "_base"; the parent
                must then be the world.
            frames: name of a further body -> s / L of its frame.

        Returns:
            the model with the beam, and its `BeamElasticity` as a force.

        Raises:
            UnknownName: no such parent. InputError: a name that is taken, a place out of range.

        Example:
            >>> import rbjax as rb
            >>> rod = rb.flexible.beam(2.0, [0, 5.0, 5.0, 0, 0, 0], {"k_z": 3}, mass=0.5)
            >>> model = rb.load("<mujoco/>").with_beam("rod", rod, frames={"middle": 0.5})
            >>> model.nv, model.body_names
            (4, ('rod', 'middle'))
        """
        if frames is not None and not isinstance(frames, Mapping):
            raise InputError(
                f"with_beam: frames is {type(frames).__name__}, expected a mapping from the name "
                'of a body to its place s / L, for example {"middle": 0.5}'
            )
        places = dict(frames or {})
        joint = self.joint(tuple(places.values()))
        base = {"position": position, "orientation": orientation}
        model, parent, base = with_free_base("with_beam", "beam", model, name, parent, base, free)
        extra = {body: joint.tip + 1 + i for i, body in enumerate(places)}
        params = self.params(joint)
        model = model.with_link(name, joint, parent, params=params, frames=extra, **base)
        return model.with_forces(self.elasticity(name))

    def elasticity(self, name: str) -> BeamElasticity:
        """Return the elastic and viscous forces of the beam, for its joint `name`."""
        C, viscosity = self.section.stiffness, self.viscosity
        diagonals = diagonal_if_known(C), diagonal_if_known(viscosity)
        if diagonals[0].ndim == diagonals[1].ndim:
            C, viscosity = diagonals
        return BeamElasticity(C, viscosity, name)

    def reduced(self, snapshots: Any, count: int | Mapping[str, int] | None = None) -> Beam:
        """Reduce the coordinates by proper orthogonal decomposition of given states of the beam.

        The strains are then xi_0 + sum_j P_j T_j q with a constant basis T, whose columns are the
        principal directions of the snapshots in the inner product of the elastic energy. Length,
        section and damping stay parameters. Large deflections and rotations are exact for the
        strains of the basis.

        Args:
            snapshots: (k, n), coordinates of this beam: `vibration_modes`, `static_modes`, static
                solutions or a motion, or several of them (np.concatenate). A larger snapshot has
                more weight.
            count: the number of coordinates, each with all strains; None for the number of
                independent snapshots. Or strain -> number, for separate coordinates of each strain.
                Then the stiffness matrix is diagonal for any uniform section without couplings.

        Returns:
            the beam in the new coordinates. The value of a coordinate is the largest strain of its
            shape: 1/m for k_x, k_y and k_z, without unit for e_x, g_y and g_z.

        Raises:
            InputError: a wrong shape, values that are not finite or not constants, more coordinates
                than independent snapshots.
            UnknownName: a strain in count that the beam does not have.

        Source: Volkwein, *Proper Orthogonal Decomposition: Theory and Reduced-Order Modelling*,
            2013.

        Example:
            >>> import rbjax as rb
            >>> rod = rb.flexible.beam(2.0, [0, 0, 5.0, 0, 1e3, 0], {"k_z": 9, "g_y": 9}, mass=0.5)
            >>> small = rod.reduced(rod.vibration_modes(4))
            >>> rod.joint().coordinates, small.joint().coordinates
            (20, 4)
        """
        return self.replace(basis=reduced_basis.principal_shapes(self, snapshots, count))

    def vibration_modes(self, count: int) -> np.ndarray:
        """Compute the linear vibration modes of the beam, clamped at its base and free at its tip.

        Args:
            count: the number of modes, from the lowest frequency upwards.

        Returns:
            (count, n), coordinates of this beam, each of the elastic energy 1/2 J.

        Raises:
            InputError: a number of modes out of range, or traced parameters.

        Source: Craig, *Structural Dynamics*, 1981.

        Example:
            >>> import rbjax as rb
            >>> rod = rb.flexible.beam(2.0, [0, 0, 5.0, 0, 0, 0], {"k_z": 9}, mass=0.5)
            >>> rod.vibration_modes(3).shape
            (3, 10)
        """
        return reduced_basis.vibration_modes(self, count)

    def static_modes(self) -> np.ndarray:
        """Compute the linear static deflections under unit forces and moments at the tip.

        Add them to the snapshots of `reduced` if loads, bodies or constraints act at the tip:
        vibration modes have no curvature there.

        Returns:
            (m, n), coordinates of this beam, each of the elastic energy 1/2 J; m is at most six,
            because a load that does not strain the beam is left out.

        Raises:
            InputError: traced parameters.

        Source: Craig, *Structural Dynamics*, 1981.

        Example:
            >>> import rbjax as rb
            >>> rod = rb.flexible.beam(2.0, [0, 0, 5.0, 0, 0, 0], {"k_z": 9}, mass=0.5)
            >>> rod.static_modes().shape  # a force along y and a moment about z
            (2, 10)
        """
        return reduced_basis.static_modes(self)

    def replace_joint(self, model: Model, name: str) -> Model:
        """Put the beam in the place of a joint of a model, such as a hinge of a file.

        The base frame is at the anchor of the joint, in the axes of the body. The frame of the body
        moves to the tip, by the length along x, with its geoms, sites and children.

        Args:
            model: the model.
            name: name of the joint, and then of the beam.

        Raises:
            UnknownName: no such joint. InputError: a force element acts on the old joint.

        Example:
            >>> import rbjax as rb
            >>> rod = rb.flexible.beam(0.5, [0, 2.0, 2.0, 0, 0, 0], {"k_y": 2}, mass=0.3)
            >>> rod.replace_joint(rb.load("pendulum"), "hinge").nv
            3
        """
        joint = self.joint()
        at = np.cumsum([0, *(np.size(x) for x in joint.params.values())])
        flat = self.params(joint)
        values = {
            key: flat[start : start + np.size(x)].reshape(np.shape(x))
            for start, (key, x) in zip(at, joint.params.items(), strict=False)
        }
        return model.with_joint(name, joint.name, **values).with_forces(self.elasticity(name))


def beam(
    length: Any,
    section: Section | Any,
    degrees: Mapping[str, int] | None = None,
    *,
    mass: Any = None,
    inertia: Any = (0.0, 0.0, 0.0),
    damping: Any = 0.0,
    natural: Mapping[str, Any] | None = None,
    points: int | None = None,
) -> Beam:
    """Create a beam, for `Model.with_beam`.

    Bending without shear (a Kirchhoff rod) and without axial strain (inextensible) needs k_y and
    k_z, and k_x for torsion; such a beam has no stiff axial waves. The largest frequency grows with
    the fourth power of the degree, so prefer degree 2 or 3, and long cables in several links.

    Args:
        length: m, more than zero.
        section: the cross-section (`rbjax.flexible.circle` and others), or the diagonal (6,) or the
            matrix (6, 6) of its stiffness in the order k_x, k_y, k_z, e_x, g_y, g_z.
        degrees: strain -> degree of its polynomial; torsion and bending of degree 2 if None.
        mass: kg/m, if `section` is a stiffness.
        inertia: (3,) rotary inertia about x, y, z, kg m, if `section` is a stiffness.
        damping: s, the ratio of viscosity to stiffness (Kelvin and Voigt): one number, or six.
        natural: "k_x", "k_y" or "k_z" -> Legendre coefficients of natural twist or curvature, 1/m.
        points: the number of Gauss points; by default n + 3, where n is the largest number of
            coefficients of a strain.

    Returns:
        the beam.

    Raises:
        InputError: a value that is not positive, no strain, a degree out of range.
        UnknownName: no such strain.

    Source: Boyer, Lebastard, Candelier & Renda, IEEE T-RO 37(3), 2021.

    Example:
        >>> import rbjax as rb
        >>> steel = rb.flexible.circle(0.005, E=2.1e11, nu=0.3, density=7800.0)
        >>> rb.flexible.beam(0.5, steel, {"k_y": 3, "k_z": 3}).joint().coordinates
        8
    """
    check_positive("beam", length=length)
    length = checked("beam", "length", length, "scalar")
    given = _section(section, mass, inertia)
    if not isinstance(damping, jax.core.Tracer):
        real_array("beam", "damping", damping, "ratios of viscosity to stiffness in s")
    ratio = jnp.asarray(damping, float)
    if ratio.shape not in ((), (6,)):
        raise InputError(
            f"beam: damping has the shape {ratio.shape}, expected one ratio of viscosity to "
            "stiffness in s, or (6,), one for each strain"
        )
    if not isinstance(ratio, jax.core.Tracer) and not bool((np.asarray(ratio) >= 0).all()):
        raise InputError(f"beam: damping is {damping}, expected ratios not below zero, in s")
    C = given.stiffness
    root = jnp.sqrt(jnp.broadcast_to(ratio, (6,)))
    viscosity = C * root[:, None] * root
    strains = {"k_x": 2, "k_y": 2, "k_z": 2} if degrees is None else degrees
    for key, mapping in (("degrees", strains), ("natural", natural or {})):
        if not isinstance(mapping, Mapping):
            raise InputError(
                f"beam: {key} is {type(mapping).__name__}, expected a mapping from strain to "
                f"{'degree' if key == 'degrees' else 'Legendre coefficients'}"
            )
    curved = {name: _coefficients(name, x) for name, x in (natural or {}).items()}
    out = Beam(length, given, viscosity, curved, tuple(strains.items()), points)
    joint = out.joint()  # checks the strains
    _check_stations(length, given, joint)
    _check_stiffness(C, joint)
    params = out.params(joint)
    if not isinstance(params, jax.core.Tracer):
        reason = joint.invalid(np.zeros(joint.coordinates), np.asarray(params))
        if reason is not None:
            raise InputError(f"beam: natural is out of range: {reason}")
    return out


def _coefficients(name: str, x: Any) -> jax.Array:
    """Check the Legendre coefficients of a natural curvature."""
    values = jnp.atleast_1d(jnp.asarray(x, float))
    if values.ndim != 1:
        raise InputError(
            f"beam: natural[{name!r}] has the shape {values.shape}, expected (n,), Legendre "
            "coefficients from degree 0 upwards, 1/m"
        )
    if not isinstance(values, jax.core.Tracer) and not np.isfinite(np.asarray(values)).all():
        raise InputError(f"beam: natural[{name!r}] is {x}, expected finite values")
    return values


def _section(given: Any, mass: Any, inertia: Any) -> Section:
    if isinstance(given, Section):
        if mass is not None:
            raise InputError("beam: got a section and mass; the section has a mass already")
        return given
    if mass is None:
        raise InputError(
            "beam: section is a stiffness, so mass (kg/m) is needed; or make a section by its "
            "shape, for example rbjax.flexible.circle"
        )
    return section(given, mass, inertia)


def _check_stations(length: jax.Array, section: Section, joint: StrainBeam) -> None:
    """Raise InputError unless there is one length, and one section or one at each Gauss point."""
    if length.ndim:
        raise InputError(
            f"beam: length has the shape {length.shape}, expected one number in m; for a batch of "
            "beams, use jax.vmap"
        )
    stations, points = np.shape(section.mass), joint.shape.points
    if stations not in ((), (points,)):
        raise InputError(
            f"beam: the values of the section have the shape {stations}, expected () for a "
            f"uniform beam or ({points},), one at each Gauss point of a tapered beam; points= sets "
            "their number"
        )


def _check_stiffness(C: Any, joint: StrainBeam) -> None:
    """Raise InputError if an active strain has no stiffness."""
    if isinstance(C, jax.core.Tracer):
        return
    for name, _ in joint.shape.degrees:
        k = STRAINS.index(name)
        if not bool((np.asarray(C)[..., k, k] > 0).all()):
            raise InputError(
                f"beam: the strain {name} is a coordinate, and its stiffness is "
                f"{np.asarray(C)[..., k, k]}, expected a number above zero; leave the strain out "
                "of degrees, or give it a stiffness"
            )
