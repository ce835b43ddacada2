"""Valid calls of rotations, spatial vectors and bodies, as in `tests.public.calls`."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax import body, rotations, spatial
from rbjax.rotations import se3, so3
from rbjax.spatial import shapes
from tests.body import test_composes as of_bodies
from tests.rotations import test_public as of_rotations

Calls = dict[str, dict[str, Any]]

X, Y = np.array([0.3, -0.2, 0.5, 0.1, 0.4, -0.6]), np.array([0.1, 0.2, -0.3, 0.7, -0.5, 0.2])
S, D = np.array([0.2, -0.4, 0.3]), np.array([1.0, 1.1, 0.9])
T, R = np.asarray(se3.exp(X)), np.asarray(so3.exp(S))
INERTIA = np.diag([1.0, 1.2, 0.9])
MATRIX = np.asarray(spatial.spatial_inertia(2.0, S, INERTIA))
PSEUDO = np.asarray(spatial.pseudo_inertia(2.0, 0.1 * S, INERTIA))
BOX = shapes.box([1.0, 2.0, 3.0], mass=2.0)


def of_rotation(name: str) -> dict[str, Any]:
    """The first sample of a case of tests/rotations, by the names of the function's arguments."""
    import inspect

    names = inspect.signature(of_rotations.public()[name]).parameters
    return dict(zip(names, (x[0] for x in of_rotations.CASES[name]), strict=False))


ROTATIONS: Calls = {f"rotations.{name}": of_rotation(name) for name in of_rotations.CASES}
ROTATIONS |= {
    "rotations.convert": {
        "x": np.array([0.8, 0.2, 0.4, 0.4]), "source": "unit_quaternion", "target": "mrp",
    },
}  # fmt: skip

SPATIAL: Calls = {
    "central_axis": {"F": X},
    "check_mass_properties": {"mass": 2.0, "com": S, "inertia": INERTIA},
    "consistency": {"mass": 2.0, "inertia": INERTIA},
    "ellipsoid_margin": {
        "mass": 2.0, "com": S, "inertia": INERTIA, "semi_axes": 2 * D, "centre": S,
    },
    "extended_cross": {"omega": S},
    "extended_rotation": {"R": R},
    "extended_translation": {"p": S},
    "force_at": {"f": S, "point": D},
    "force_cross": {"V": X, "f": Y},
    "force_cross_matrix": {"V": X},
    "force_transform": {"T": T},
    "from_pseudo_inertia": {"P": PSEUDO},
    "kinetic_energy": {"matrix": MATRIX, "V": X},
    "mass_properties": {"matrix": MATRIX},
    "merge_wrenches": {"wrenches": np.stack([X, Y]), "points": np.stack([S, D]), "about": S},
    "momentum": {"matrix": MATRIX, "V": X},
    "motion_cross": {"V": X, "m": Y},
    "motion_cross_matrix": {"V": X},
    "motion_transform": {"T": T},
    "transform_properties": {"T": T, "mass": 2.0, "com": S, "inertia": INERTIA},
    "parallel_axes": {"inertia": INERTIA, "mass": 2.0, "offset": S},
    "power": {"F": X, "V": Y},
    "principal_axes": {"inertia": INERTIA},
    "pseudo_inertia": {"mass": 2.0, "com": S, "inertia": INERTIA},
    "rotate_inertia": {"R": R, "inertia": INERTIA},
    "spatial_inertia": {"mass": 2.0, "com": S, "inertia": INERTIA},
    "transform_force": {"T": T, "F": X},
    "transform_inertia": {"T": T, "matrix": MATRIX},
    "transform_motion": {"T": T, "V": X},
    "twist_at": {"V": X, "point": S},
    "wrench_at": {"F": X, "point": S},
    "shapes.box": {"size": D, "mass": 2.0},
    "shapes.capsule": {"radius": 0.2, "length": 1.0, "mass": 2.0},
    "shapes.combine": {"parts": [BOX, BOX]},
    "shapes.cone": {"radius": 0.2, "height": 1.0, "density": 2.0},
    "shapes.cylinder": {"radius": 0.2, "length": 1.0, "density": 2.0},
    "shapes.ellipsoid": {"semi_axes": D, "mass": 2.0},
    "shapes.hole": {"part": BOX},
    "shapes.mesh": {
        "vertices": np.concatenate([np.zeros((1, 3)), np.eye(3)]),
        "triangles": of_bodies.TETRAHEDRON, "density": 2.0,
    },
    "shapes.plate": {"size": D[:2], "mass": 2.0},
    "shapes.points": {"positions": np.stack([S, D]), "masses": D[:2]},
    "shapes.rod": {"length": 1.0, "mass": 2.0},
    "shapes.sphere": {"radius": 1.0, "mass": 2.0},
    "shapes.tube": {"outer": 1.0, "inner": 0.8, "length": 2.0, "mass": 2.0},
}  # fmt: skip

SITUATION = body.Situation(of_bodies.BODY, of_bodies.FORCES)
FRAME = of_bodies.frame(jnp.asarray(X))
BODY: Calls = {
    "ellipsoid_added_mass": {"semi_axes": D, "density": 2.0},
    "formulation": {"name": "kirchhoff"},
    "inertia_matrix": {"body": of_bodies.BODY},
    "kinetic_energy": {"body": of_bodies.BODY, "V": X},
    "potential_energy": {"situation": SITUATION, "T": T},
    "rigid_body": {"properties": BOX, "forces": of_bodies.FORCES},
    "total_wrench": {"situation": SITUATION, "t": 0.0, "T": T, "V": X},
    "Spring": {"stiffness": 2.0, "anchor": S, "point": D, "rest_length": 0.3},
    "Damper": {"damping": 2.0, "anchor": S, "point": D},
    "Buoyancy": {"density": 2.0, "volume": 0.3, "centre": S},
    "CentralGravity": {"mu": 2.0, "centre": S},
    "UniformGravity": {"acceleration": S},
    "LinearDrag": {"coefficients": np.diag(X)},
    "QuadraticDrag": {"coefficients": X},
    "lagrange.mass_matrix": {"system": of_bodies.SYSTEM, "q": S[:2]},
    "lagrange.acceleration": {
        "system": of_bodies.SYSTEM, "q": S[:2], "v": D[:2], "Q": S[:2],
    },
    "relative_motion.velocity": {"frame": FRAME, "r": S, "rd": D},
    "relative_motion.compose": {"outer": FRAME, "inner": FRAME},
}  # fmt: skip

ROOMS: dict[str, tuple[Any, Calls]] = {
    "rotations": (rotations, {n.removeprefix("rotations."): c for n, c in ROTATIONS.items()}),
    "spatial": (spatial, SPATIAL),
    "body": (body, BODY),
}
