"""Link constants: poses, inertias and armatures of the links, computed from the leaves of a model.

They are computed once, outside every recursion, as columns over the links. If the leaves are
concrete (the model is closed over), the columns are numpy arrays, and their zeros and ones vanish
from the program. If the leaves are traced, the columns are traced.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.lanes import (
    Lane,
    Mat3,
    Sym3,
    Vec3,
    is_literal,
    matmat,
    matrix_transpose,
    matvec,
    quaternion_matrix,
)
from rbjax.model.cells import (
    Cell,
    Sparse,
    all_literal,
    cast_cells,
    cells,
    constant_leaves,
    lane_of,
    stacked,
)
from rbjax.model.model import Model
from rbjax.model.topology import WORLD, Topology
from rbjax.spatial import RigidInertia, Transform

#: concrete entries of rotations that are this close to 0, 1 or -1 are rounded to it
SNAP = 1e-15


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LinkConstants:
    """The constants of one link as lanes, or of all links as columns."""

    R: Mat3  # R and p: pose of the link in its parent link at zero displacement of the joint
    p: Vec3
    #: inertia of all bodies that move with the link, about its origin, in its axes
    inertia: RigidInertia
    armature: Lane  # rotor inertia of the dof
    reference: Lane  # value of the coordinate at zero displacement
    #: the parameters of the joint
    params: tuple[Lane, ...] = ()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ModelConstants:
    """The link constants of a model as columns, the poses of bodies in their links, and gravity."""

    columns: LinkConstants
    body_R: Any  # (nb, 3, 3)
    body_p: Any  # (nb, 3)
    gravity: Vec3

    def link(self, i: int) -> LinkConstants:
        """Return the constants of link i as lanes."""
        return jax.tree.map(lambda column: lane(column, i), self.columns)

    @property
    def welds(self) -> Transform:
        """The pose of each body in the link that carries it, as columns over the bodies."""
        R, p = self.body_R, self.body_p
        axes = Mat3(*(R[:, i, j] for i in range(3) for j in range(3)))
        return Transform(axes, Vec3(*(p[:, i] for i in range(3))))

    def weld(self, body: int) -> Transform:
        """Return the pose of one body in the link that carries it, as lanes."""
        return jax.tree.map(lambda column: lane(column, body), self.welds)


def prepare(model: Model, dtype: Any) -> ModelConstants:
    """Compute the link constants of a model. Traced constants have the given dtype.

    The z axis of each link is its joint axis. A joint at anchor a with axis s has the pose (A, a)
    in the frame of its body, with A z = s. Let B be the pose of a body in the body that carries it,
    and F the pose of a link in its body. The pose of a link in its parent is F_parent^-1 B F.
    """
    if model.execution.constants is not None:
        return _columns(model.execution.constants)
    leaves, zeros = constant_leaves(model), dict(model.execution.zeros or ())
    traced = [isinstance(x, jax.core.Tracer) for x in leaves.values()]
    if not any(traced):
        known = {name: np.asarray(x, np.float64) for name, x in leaves.items()}
        return _prepare(model.topology, known, np, np.float64)
    if all(traced) and not zeros:
        return _prepare(model.topology, leaves, jnp, dtype)
    # some entries are constant: compute entry by entry
    entries = {
        name: cells(x, zeros.get(name, (None,) * x.size), known=not moves)
        for (name, x), moves in zip(leaves.items(), traced, strict=True)
    }
    return _prepare(model.topology, entries, np, dtype)


def with_constants(model: Model, dtype: Any) -> Model:
    """Precompute the link constants and store them in the model.

    A program that has this model as an argument does not recompute them and keeps their zeros.
    """
    if model.execution.constants is not None:
        return model

    def sparse(columns: Any, units: bool = False) -> Any:
        return jax.tree.map(lambda x: Sparse.of(x, dtype, units=units), columns)

    made = prepare(model, dtype)
    c, gravity = made.columns, np.array([_cell(x) for x in made.gravity], object)
    columns = LinkConstants(
        sparse(c.R, units=True),
        *map(sparse, (c.p, c.inertia, c.armature, c.reference, c.params)),
    )
    body_R, body_p = (x.astype(dtype) for x in (made.body_R, made.body_p))
    return model.replace(constants=(columns, body_R, body_p, sparse(gravity)))


def without_constants(model: Model) -> Model:
    """Remove precomputed constants and weights. Call it before user code that may change leaves."""
    made = model.execution.constants, model.execution.weights
    return model if made == (None, None) else model.replace(constants=None, weights=None)


def _columns(made: Any) -> ModelConstants:
    """Rebuild the constants of a model from the sparse columns that `with_constants` has stored."""
    columns, body_R, body_p, gravity = jax.tree.map(
        lambda x: x.column() if isinstance(x, Sparse) else x, made,
        is_leaf=lambda x: isinstance(x, Sparse),
    )  # fmt: skip
    return ModelConstants(columns, body_R, body_p, Vec3(*(lane(gravity, i) for i in range(3))))


def _cell(x: Lane) -> Any:
    return x if isinstance(x, float) else Cell(x)


def _prepare(top: Topology, leaves: dict[str, Any], xp, dtype) -> ModelConstants:
    given = SimpleNamespace(**leaves)
    links, n = top.links, len(top.links)
    weld_R, weld_p, body_R = _welds(top, given, xp)

    # axes of each link in its body, before (own) and after (moved) the motion of the joint
    joint = np.array([link.joint for link in links], int)
    params = _joint_params(top, given.params, xp)
    moved_R = _link_axes(top, given.axis, given.params, xp)
    starts = np.array([link.spec.turns_body for link in links], bool)[:, None, None]
    own_R = xp.where(starts, np.eye(3), moved_R)
    anchor = given.placement[joint]
    # the origin of a link in its body; bodies at other frames of a flexible joint have no anchor
    anchored = np.array([_has_anchor(top, i) for i in range(n)], bool)[:, None]
    origin = xp.where(anchored, anchor, 0.0) if top.frames else anchor

    # for the first link of each body: the pose of the body in the carrier of its parent body
    body = np.array([link.body for link in links], int)
    parent_body = np.array(top.body_parents, int)[body]
    free = np.array([top.joints[j].on_world for j in joint], bool)
    first = np.array([link.first_on_body for link in links], bool) & ~free
    at_world = (parent_body == WORLD)[:, None, None]
    carry_R = xp.where(at_world, np.eye(3), weld_R[parent_body])
    carry_p = xp.where(at_world[..., 0], np.zeros(3), weld_p[parent_body])
    base_p = carry_p + matvec(carry_R, given.position[body])
    base_R = xp.where(first[:, None, None], matmat(carry_R, body_R[body]), np.eye(3))
    base_p = xp.where(first[:, None], base_p, np.zeros(3))

    parent = np.array(top.parents, int)
    root = (parent == WORLD)[:, None, None]
    inner_R = xp.where(root, np.eye(3), moved_R[parent])
    inner_p = xp.where(root[..., 0], np.zeros(3), origin[parent])
    R = matmat(matrix_transpose(inner_R), matmat(base_R, own_R))
    p = matvec(matrix_transpose(inner_R), base_p + matvec(base_R, anchor) - inner_p)

    # inertia about the link's origin, in its axes, of all bodies that move with it
    carrier_link = np.array(top.body_links, int)
    own = np.where(carrier_link == WORLD, n, carrier_link)  # index n is the frame of the world
    frame_R = xp.concatenate([moved_R, np.eye(3)[None]])[own]
    frame_p = xp.concatenate([origin, np.zeros((1, 3))])[own]
    to_link_R = matmat(matrix_transpose(frame_R), weld_R)
    to_link_p = matvec(matrix_transpose(frame_R), weld_p - frame_p)
    com = to_link_p + matvec(to_link_R, given.com)
    central = matmat(matmat(to_link_R, given.inertia), matrix_transpose(to_link_R))
    mass = given.mass
    square = (com * com).sum(-1)[:, None, None] * np.eye(3) - com[:, :, None] * com[:, None, :]
    J = _gather(central + mass[:, None, None] * square, carrier_link, n, xp)
    h = _gather(mass[:, None] * com, carrier_link, n, xp)
    m = _gather(mass, carrier_link, n, xp)

    q_of = np.array([link.q[0] if len(link.q) else 0 for link in links], int)
    scalar = np.array([link.spec.from_reference for link in links], bool)
    reference = xp.where(scalar, given.reference[q_of], 0.0) if n else np.zeros(0)
    if xp is np:
        R, to_link_R = _snap(R), _snap(to_link_R)
    if xp is np and J.dtype != object:
        J, h = _snap_relative(J), _snap_relative(h)

    def cast(x):
        return cast_cells(x, dtype) if x.dtype == object else x.astype(dtype)

    def whole(x):
        return stacked(x, dtype) if x.dtype == object else x.astype(dtype)

    columns = LinkConstants(
        R=Mat3(*(cast(R[:, i, j]) for i in range(3) for j in range(3))),
        p=Vec3(*(cast(p[:, i]) for i in range(3))),
        inertia=RigidInertia(
            cast(m),
            Vec3(*(cast(h[:, i]) for i in range(3))),
            Sym3(*(cast(J[:, i, j]) for i, j in _SYM)),
        ),
        armature=cast(_with_frames(given.armature, top, xp)),
        reference=cast(reference),
        params=tuple(cast(params[:, k]) for k in range(params.shape[1])),
    )
    lanes = Vec3(*(lane(cast(given.gravity), i) for i in range(3)))
    return ModelConstants(columns, whole(to_link_R), whole(to_link_p), lanes)


_SYM = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def _has_anchor(top: Topology, i: int) -> bool:
    """Return True if a link is a dof, or the frame that carries the body of a flexible joint."""
    j = top.links[i].joint
    return i < top.nv or i == top.last_links[top.joint_bodies[j]]


def _with_frames(x, top: Topology, xp):
    """Append zeros for the frames of flexible links to an array over the dofs."""
    return xp.concatenate([x, np.zeros(len(top.frames))]) if top.frames else x


def _welds(top: Topology, bodies, xp):
    """Compute the pose of each body in its carrier, and its orientation in its parent.

    A body with joints is its own carrier.
    """
    body_R = _quaternion_to_matrix(bodies.orientation, xp)
    depth = np.array(top.weld_depth, int)
    parent = np.array(top.body_parents, int)
    R = xp.where((depth > 0)[:, None, None], body_R, np.eye(3))
    p = xp.where((depth > 0)[:, None], bodies.position, np.zeros(3))
    for level in range(1, max(top.weld_depth, default=0) + 1):
        here = (depth == level) & (parent != WORLD)
        up_R, up_p = R[parent], p[parent]
        p = xp.where(here[:, None], up_p + matvec(up_R, bodies.position), p)
        R = xp.where(here[:, None, None], matmat(up_R, body_R), R)
    return R, p, body_R


def _joint_params(top: Topology, given, xp):
    """Return the parameters of each link's joint (links, m), padded with zeros. m is the largest
    number of parameters of a joint."""
    counts = [len(joint.defaults) for joint in top.joints]
    most, starts = max(counts, default=0), np.cumsum([0, *counts])
    out = xp.concatenate([given, np.zeros(1)])  # the last entry is the padding
    rows = [
        [starts[link.joint] + k if k < counts[link.joint] else -1 for k in range(most)]
        for link in top.links
    ]
    return out[np.array(rows, int).reshape(len(rows), most)]


def _link_axes(top: Topology, axis, given, xp):
    """Compute the orientation (links, 3, 3) of each link in its body, with z along its axis."""
    links, starts = top.links, np.cumsum([0, *(len(joint.defaults) for joint in top.joints)])
    shortest = np.array([joint.shortest_turn for joint in top.joints], bool)
    align = _alignments(axis, xp, shortest)[np.array([link.joint for link in links], int)]
    of_body = np.array([not top.joints[link.joint].aligned for link in links], bool)
    cycle = np.eye(3)[:, [[1, 2, 0], [2, 0, 1], [0, 1, 2]]].swapaxes(0, 1)  # z to x, y, z
    turned = cycle[np.array([link.spec.axis for link in links], int)]
    if any(link.spec.axis != 2 and not own for link, own in zip(links, of_body, strict=True)):
        align = matmat(xp.where(of_body[:, None, None], np.eye(3), align), turned)
    elif of_body.any():
        align = xp.where(of_body[:, None, None], turned, align)
    for i, link in enumerate(links):
        if link.spec.own_axis is not None:
            at = starts[link.joint] + link.spec.own_axis
            own = _alignments(given[at : at + 3][None], xp)
            align = xp.concatenate([align[:i], own, align[i + 1 :]])
    return align


def _alignments(axis, xp, shortest=False):
    """Compute rotations A (nj, 3, 3) with A z = axis / |axis| (Duff et al. 2017).

    A zero axis counts as z. If the z component of an axis is negative, A is not the shortest
    rotation from z to the axis, except for the joints marked in `shortest` (nj,).
    """
    shortest = np.broadcast_to(shortest, len(axis))
    if axis.dtype == object:
        rows = [_alignment_of_cells(*one) for one in zip(axis, shortest, strict=True)]
        return np.array(rows, object).reshape(-1, 3, 3)
    square = (axis * axis).sum(-1, keepdims=True)
    none = square == 0
    unit = xp.where(none, np.array([0.0, 0.0, 1.0]), axis / xp.sqrt(xp.where(none, 1.0, square)))
    x, y, z = unit[:, 0], unit[:, 1], unit[:, 2]
    sign = xp.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    rows = [1 + sign * x * x * a, b, x, sign * b, sign + y * y * a, y, -sign * x, -y, z]
    A = xp.stack(rows, -1).reshape(-1, 3, 3)
    if not shortest.any():
        return A
    across = x * x + y * y
    turned = shortest & (z < 0) & (across > 0)
    across = xp.where(turned, across, 1.0)
    c = xp.where(turned, (y * y - x * x) / across, 1.0)
    s = xp.where(turned, 2 * x * y / across, 0.0)
    o, one = xp.zeros_like(c), xp.ones_like(c)
    turn = xp.stack([c, -s, o, s, c, o, o, o, one], -1).reshape(-1, 3, 3)
    return matmat(A, turn)


def _alignment_of_cells(row: np.ndarray, shortest: bool = False) -> np.ndarray:
    """Compute `_alignments` of one axis of numbers or cells."""
    if all_literal(row):
        known = np.array([[float(lane_of(x)) for x in row]])
        return _alignments(known, np, shortest)[0].astype(object)
    dense = _alignments(jnp.stack([jnp.asarray(lane_of(x)) for x in row])[None], jnp, shortest)[0]
    return np.array([[Cell(dense[i, j]) for j in range(3)] for i in range(3)], object)


def _quaternion_to_matrix(q, xp):
    return xp.stack(list(quaternion_matrix(*(q[:, i] for i in range(4)))), -1).reshape(-1, 3, 3)


def _gather(x, index: np.ndarray, n: int, xp):
    """Sum values of bodies over each link. Bodies welded to the world (index -1) are left out."""
    slot = np.where(index == WORLD, n, index)
    if xp is np:
        out = np.zeros((n + 1, *x.shape[1:]), x.dtype)
        np.add.at(out, slot, x)
        return out[:n]
    return jax.ops.segment_sum(x, slot, n + 1)[:n]


def _snap(x: np.ndarray) -> np.ndarray:
    """Round constant entries that are within `SNAP` of 0, 1 or -1."""
    if x.dtype == object:
        known = np.array([is_literal(lane_of(v)) for v in x.ravel()], bool).reshape(x.shape)
        x = x.copy()
        x[known] = _snap(np.array([lane_of(v) for v in x[known]], float))
        return x
    x = np.where(np.abs(x) < SNAP, 0.0, x)
    return np.where(np.abs(np.abs(x) - 1) < SNAP, np.sign(x), x)


def _snap_relative(x: np.ndarray) -> np.ndarray:
    """Set entries to zero that are smaller than `SNAP` times the largest entry of their row."""
    rows = np.abs(x).max(axis=tuple(range(1, x.ndim)), initial=0.0)
    return np.where(np.abs(x) < SNAP * rows.reshape(-1, *(1,) * (x.ndim - 1)), 0.0, x)


def lane(column, i: int) -> Lane:
    """Return one entry of a column, as a Python float if the column is concrete."""
    if isinstance(column, np.ndarray):
        return lane_of(column[i])
    return column[i]
