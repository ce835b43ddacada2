"""Modal bodies as links of a robot: the link and its elastic forces.

    tau = -K q - D q'

Geometric stiffening is part of the link's inertia and of its frames (`rbjax.flexible.modal.link`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax

from rbjax.arguments import flag
from rbjax.dynamics.arguments import check_model
from rbjax.errors import InputError
from rbjax.flexible.linear_elasticity import (
    LinearElasticity,
    Matrix,
    diagonal_if_known,
    with_free_base,
)
from rbjax.flexible.modal.body import ModalBody, check_body
from rbjax.flexible.modal.link import ModalLayout, ModalLink
from rbjax.forces.context import Context
from rbjax.forces.element import Shapes
from rbjax.model import Model
from rbjax.model.leaves import numbers


class ModalElasticity(LinearElasticity):
    """The elasticity and damping of a modal body. `add_modal_body` adds it.

    Fields:
        stiffness: K (m, m), or its diagonal (m,).
        damping: D (m, m), or its diagonal (m,).
        joint: the name of the body's joint; static.

    Source: Shabana, section 5.5.

    See `add_modal_body` for an example.
    """

    stiffness: jax.Array
    damping: jax.Array
    joint: str = eqx.field(static=True)

    def shapes(self, model: Model) -> Shapes:
        m = model.topology.joints[model.joint(self.joint)].nv
        return {"stiffness": (m,) * self.stiffness.ndim, "damping": (m,) * self.damping.ndim}

    def matrices(self, context: Context) -> tuple[str, Matrix, Matrix]:
        K, D = (_rows(x, context.q.dtype) for x in (self.stiffness, self.damping))
        return self.joint, K, D


def add_modal_body(
    model: Model,
    name: str,
    body: ModalBody,
    parent: str = "world",
    *,
    position: Any = (0.0, 0.0, 0.0),
    orientation: Any = (1.0, 0.0, 0.0, 0.0),
    at: str | None = None,
    frames: Mapping[str, str] | None = None,
    free: bool = False,
    layout: ModalLayout | None = None,
) -> Model:
    """Add a modal body to a model. Its floating frame is fixed to a body, or moves freely.

    Bodies, sites, constraints and forces are added to the frames by the names of their bodies.

    Args:
        model: the model.
        name: name of the joint, whose coordinates are the modes, and of the body at the frame `at`.
        body: the modal body.
        parent: the body to which the floating frame is fixed, or "world".
        position: (3,) m, of the floating frame in the parent.
        orientation: (4,) unit quaternion of the floating frame in the parent.
        at: name of the frame that the body `name` moves with; None for the last frame.
        frames: name of a further body -> name of its frame.
        free: True for a floating frame that moves freely, by a joint named `name` + "_base"; the
            parent must then be the world.
        layout: structure of the parameters; None for the entries of `body` that are above 1e-12 of
            the largest of their kind. It is needed if `body` is traced.

    Returns:
        the model with the body, and its `ModalElasticity` as a force.

    Raises:
        UnknownName: no such parent or frame.
        InputError: the body has no frame, or a name is taken.

    Source: Jain & Rodriguez, JGCD 15(6), 1992.

    Example:
        >>> import numpy as np, rbjax as rb
        >>> from rbjax.flexible.modal import add_modal_body, from_points
        >>> shape = np.zeros((2, 3, 1)); shape[1, 2, 0] = 1.0
        >>> places = [[0, 0, 0], [1, 0, 0]]
        >>> arm = from_points([1.0, 2.0], places, shape, stiffness=[[8.0]], frames=[1])
        >>> model = add_modal_body(rb.load("<mujoco/>"), "arm", arm)
        >>> state = model.default_state().replace(q=[0.5])
        >>> rb.applied_forces(model, state).tolist()
        [-4.0]
    """
    check_model("add_modal_body", model)
    check_body("add_modal_body", body)
    flag("add_modal_body", "free", free)
    if not body.frame_names:
        raise InputError(
            "add_modal_body: the body has no frames; give craig_bampton an interface, or "
            "from_points frames=[...]"
        )
    at = body.frame_names[-1] if at is None else at
    further = {given: body.frame(frame) for given, frame in (frames or {}).items()}
    order = [k for k in range(len(body.frame_names)) if k != body.frame(at)] + [body.frame(at)]
    repeated = [given for given, k in further.items() if k == body.frame(at)]
    if repeated:
        raise InputError(
            f"add_modal_body: the body {repeated[0]!r} is at the frame {at!r}, as the body "
            f"{name!r}; use {name!r}"
        )
    moved = body.with_frames([body.frame_names[k] for k in order])
    link = ModalLink.of(moved, 1e-12) if layout is None else ModalLink(layout)
    base = {"position": position, "orientation": orientation}
    model, parent, base = with_free_base("add_modal_body", "body", model, name, parent, base, free)
    model = model.with_link(
        name,
        link,
        parent,
        params=link.layout.values(moved),
        frames={given: order.index(k) for given, k in further.items()},
        **base,
    )
    return model.with_forces(
        ModalElasticity(diagonal_if_known(body.stiffness), diagonal_if_known(body.damping), name)
    )


def _rows(x: jax.Array, dtype: Any) -> Matrix:
    values = numbers(x.reshape(-1), dtype)
    m = x.shape[0]
    if x.ndim == 1:
        return [[values[i] if i == j else 0.0 for j in range(m)] for i in range(m)]
    return [list(values[i * m : (i + 1) * m]) for i in range(m)]
