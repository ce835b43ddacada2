"""The geometry of a robot: shapes fixed to its bodies."""

from __future__ import annotations

import equinox as eqx
import jax

from rbjax.model.record import Record


class Geoms(Record):
    """Shapes fixed to bodies, with the parameters of MuJoCo's geoms.

    `rb.contact.detect` computes their contacts. No contact force acts on them.

    Fields:
        size: (ng, 3) m. Radius of a sphere; radius and half length of a capsule or cylinder;
            semi-axes of an ellipsoid; half sides of a box; half sides of a plane, 0 if it is
            infinite; half sides of the bounding box of a mesh.
        position: (ng, 3) m, in the frame of the body.
        orientation: (ng, 4) quaternion, in the frame of the body.
        friction: (ng, 3) sliding, torsional (m) and rolling (m).
        solref: (ng, 2) reference of the contact, as in MuJoCo.
        solimp: (ng, 5) impedance of the contact, as in MuJoCo.
        margin, gap: (ng,) m, a contact exists below the distance margin, acts below margin - gap.
        names, types: of each geom; a type is a name of MuJoCo, such as "box"; static.
        bodies: the body of each geom, -1 for the world; static.
        contype, conaffinity: bit masks of the pairs that may collide; static.
        condim, priority, group: as in MuJoCo; static.
        rgba: colour and opacity; static.
        pairs: the pairs of geoms that may touch by the rules of the file; static.
    """

    size: jax.Array
    position: jax.Array
    orientation: jax.Array
    friction: jax.Array
    solref: jax.Array
    solimp: jax.Array
    margin: jax.Array
    gap: jax.Array
    names: tuple[str, ...] = eqx.field(static=True)
    types: tuple[str, ...] = eqx.field(static=True)
    bodies: tuple[int, ...] = eqx.field(static=True)
    contype: tuple[int, ...] = eqx.field(static=True)
    conaffinity: tuple[int, ...] = eqx.field(static=True)
    condim: tuple[int, ...] = eqx.field(static=True)
    priority: tuple[int, ...] = eqx.field(static=True)
    group: tuple[int, ...] = eqx.field(static=True)
    rgba: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True, default=())
