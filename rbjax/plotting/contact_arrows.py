"""Contact forces of a picture: an arrow from each contact, with the force on the moving body.

An arrow of the weight of the robot has a third of the height of the picture. Longer arrows end at
two thirds of it.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from rbjax.arguments import instance
from rbjax.contact import ContactForces
from rbjax.errors import InputError
from rbjax.model import WORLD, Model
from rbjax.plotting.film import Film

Array = np.ndarray
#: length of the weight of the robot, and of the longest arrow, relative to the picture
_WEIGHT, _LONGEST = 1 / 3, 2 / 3


def with_arrows(
    where: str, film: Film, model: Model, contacts: Any, ts: Array | None = None
) -> Film:
    """Return a film with the arrows of contact forces; the film itself if `contacts` is None.

    contacts: `ContactForces` of one state, or of all states at the times ts (T,), as `jax.vmap` of
        `rb.contact.solve` returns; those of the first sample of a batch are drawn.
    """
    if contacts is None:
        return film
    public = "ContactForces, as rb.contact.solve(...).contacts"
    instance(where, "contacts", contacts, ContactForces, public)
    lead = () if ts is None else (len(ts),)
    position = np.asarray(contacts.position, float)
    batched = ts is not None and position.ndim == 4
    if position.shape[batched:-2] != lead:
        raise InputError(
            f"{where}: contacts.position has shape {position.shape}, expected {(*lead, 'n', 3)}: "
            "one state" + (" a picture" if ts is None else " for each time of the trajectory")
        )
    fields = contacts.exists, contacts.position, contacts.world_force
    exists, position, world = (np.asarray(x)[0] if batched else np.asarray(x) for x in fields)
    bodies = model.geoms.bodies if model.geoms is not None else ()
    signs = [-1.0 if bodies[second] == WORLD else 1.0 for _, second in contacts.geoms]
    world = world * np.reshape(signs, (-1, 1))
    at = np.zeros(len(film.ts), int)
    if ts is not None:
        at = np.clip(np.searchsorted(ts, film.ts, side="right") - 1, 0, len(ts) - 1)
    else:
        exists, position, world = exists[None], position[None], world[None]
    exists, position, world = exists[at], position[at], world[at]
    size = np.linalg.norm(world, axis=-1, keepdims=True)
    weight = float(np.sum(model.bodies.mass) * np.linalg.norm(model.gravity))
    weight = weight or float(size.max(initial=0.0)) or 1.0
    height = float(film.size.max())
    length = np.minimum(size / weight * _WEIGHT, _LONGEST) * height
    ends = position + world / np.maximum(size, 1e-300) * length
    arrows = np.stack([position, ends], -2)
    return dataclasses.replace(film, arrows=np.where(exists[..., None, None], arrows, np.nan))


def strokes(arrows: Array, axes: Array, head: float) -> list[Array]:
    """Return the lines (n, 2) of arrows (n, 2, 3) in the image: a shaft and a head of two lines.

    axes: (2, 3) right and up. head: the greatest length of a head.
    """
    out = []
    for start, end in (arrows @ axes.T)[~np.isnan(arrows[:, 0, 0])]:
        shaft = end - start
        length = float(np.hypot(*shaft))
        if length < 1e-12:
            continue
        along = shaft / length * min(head, 0.4 * length)
        across = 0.5 * np.array([-along[1], along[0]])
        out += [np.stack([start, end]), np.stack([end - along + across, end, end - along - across])]
    return out
