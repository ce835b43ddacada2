"""Parameters of MuJoCo's constraint problem that belong to joints, dofs and the file."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice
from rbjax.model.record import Record, check_least, check_rows

CONES = ("pyramidal", "elliptic")


class SolverParameters(Record):
    """Parameters of joint limits, friction loss and contacts, as in MuJoCo.

    The parameters of geoms are in `model.geoms`, and the limits themselves in `joints.range`. A
    changed value does not compile again. Set `rubbing` to give friction loss to further dofs.

    Fields:
        impratio: (), ratio of the frictional to the normal impedance of a contact.
        limit_solref: (nj, 2) reference of the limits of each joint.
        limit_solimp: (nj, 5) impedance of the limits.
        limit_margin: (nj,) rad or m, distance from a limit at which it becomes active.
        frictionloss: (nv,) N m or N, the Coulomb friction of each dof.
        friction_solref: (nv, 2) reference of the friction loss.
        friction_solimp: (nv, 5) impedance of the friction loss.
        cone: "pyramidal" or "elliptic"; static.
        integrator: the file's integrator, as a name of `rb.rollout`; the default of motions with
            contact; static.
        refsafe: whether time constants are at least two time steps; static.
        limited: the joints with limits, by index; static.
        rubbing: the dofs with friction loss, by index; static.
        translating: the bodies that carry no other body and only slide along their own axes, by
            index; their weights are 1 / mass, as in MuJoCo; static.

    Source: MuJoCo, *Computation*, constraint model.
    """

    impratio: jax.Array
    limit_solref: jax.Array
    limit_solimp: jax.Array
    limit_margin: jax.Array
    frictionloss: jax.Array
    friction_solref: jax.Array
    friction_solimp: jax.Array
    cone: str = eqx.field(static=True, default="pyramidal")
    integrator: str = eqx.field(static=True, default="euler_implicit_damping")
    refsafe: bool = eqx.field(static=True, default=True)
    limited: tuple[int, ...] = eqx.field(static=True, default=())
    rubbing: tuple[int, ...] = eqx.field(static=True, default=())
    translating: tuple[int, ...] = eqx.field(static=True, default=())

    def replace(self, **changes: Any) -> SolverParameters:
        """Return a copy with the given fields changed. Arrays must keep their shapes.

        Raises:
            UnknownName: no such cone. InputError: a number is not finite, `impratio` is not above
                zero, a friction loss is negative, or `limited` or `rubbing` has no such index.
        """
        new = super().replace(**changes)
        choice("cone", new.cone, CONES)
        for name in changes.keys() & {"impratio", "frictionloss"}:
            where = f"SolverParameters.replace({name}=...)"
            check_least(where, getattr(new, name), above=name == "impratio")
        for name, count in (("limited", len(new.limit_margin)), ("rubbing", len(new.frictionloss))):
            if name in changes:
                check_rows(f"SolverParameters.replace({name}=...)", getattr(new, name), count)
        return new

    def with_joint(
        self, joint: int, body: int, dofs: slice, count: int, *, limits: bool
    ) -> SolverParameters:
        """Return the parameters after a joint with other dofs is put in place of an old one.

        Args:
            joint, body: the indices of the joint and of its body.
            dofs: the dofs of the old joint.
            count: the number of dofs of the new joint. Equal numbers keep the friction loss.
            limits: whether the new joint keeps the limits of the old one.
        """
        limited = tuple(j for j in self.limited if limits or j != joint)
        translating = tuple(b for b in self.translating if b != body)
        old = dofs.stop - dofs.start
        if count == old:
            return self.replace(limited=limited, translating=translating)
        given = {"frictionloss": 0.0, "friction_solref": SOLREF, "friction_solimp": SOLIMP}
        changes: dict[str, Any] = {
            name: _spliced(getattr(self, name), dofs, count, row) for name, row in given.items()
        }
        kept = [i for i in self.rubbing if not dofs.start <= i < dofs.stop]
        rubbing = tuple(i if i < dofs.start else i + count - old for i in kept)
        changes |= {"limited": limited, "rubbing": rubbing, "translating": translating}
        return dataclasses.replace(self, **changes)

    def with_link(self, count: int) -> SolverParameters:
        """Return the parameters after a joint with `count` dofs is added, without limits and
        friction loss."""
        rows: dict[str, Any] = {
            "limit_solref": [SOLREF], "limit_solimp": [SOLIMP], "limit_margin": [0.0],
            "frictionloss": [0.0] * count, "friction_solref": [SOLREF] * count,
            "friction_solimp": [SOLIMP] * count,
        }  # fmt: skip
        changes: dict[str, Any] = {
            name: _appended(getattr(self, name), x) for name, x in rows.items()
        }
        return dataclasses.replace(self, **changes)


#: MuJoCo's default reference and impedance
SOLREF = (0.02, 1.0)
SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)


def _appended(x: jax.Array, rows: Any) -> jax.Array:
    return jnp.concatenate([x, jnp.asarray(rows, x.dtype).reshape(-1, *x.shape[1:])])


def _spliced(x: jax.Array, at: slice, count: int, row: Any) -> jax.Array:
    """Replace rows of x by `count` rows with the given value."""
    new = jnp.broadcast_to(jnp.asarray(row, x.dtype), (count, *np.shape(row)))
    return jnp.concatenate([x[: at.start], new, x[at.stop :]])
