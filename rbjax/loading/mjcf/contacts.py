"""Contacts of a file as the model takes them: pairs with a narrow phase, and checks of geoms."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import mujoco
import numpy as np

from rbjax.contact.geometry.narrow_phase import PAIRS
from rbjax.errors import ModelError, listed
from rbjax.loading.mjcf.constraints import loaded_equalities
from rbjax.loading.mjcf.contact_pairs import contact_pairs, kinds_of
from rbjax.loading.mjcf.fields import names_of
from rbjax.loading.mjcf.solver_parameters import solver_parameters
from rbjax.loading.mjcf.tendons import limited_tendons, rubbing_tendons
from rbjax.model.geoms import SIZES

#: group of rows -> prefix of its arrays in MjModel, and the arrays that must be finite
_FIELDS = {
    "geoms": ("geom", ("friction", "solref", "solimp", "margin", "gap", "solmix", "size")),
    "contact pairs": (
        "pair",
        ("friction", "solref", "solreffriction", "solimp", "margin", "gap"),
    ),
    "joint limits": ("jnt", ("solref", "solimp", "margin")),
    "joint friction loss": ("dof", ("frictionloss", "solref", "solimp")),
    "tendon limits": ("tendon", ("range", "margin", "solref_lim", "solimp_lim")),
    "tendon friction loss": ("tendon", ("frictionloss", "solref_fri", "solimp_fri")),
    "equalities": ("eq", ("solref", "solimp")),
}
#: options that change contacts and are not supported; MuJoCo 3 has none of them
_OPTIONS = {
    getattr(mujoco.mjtEnableBit, name): words
    for name, words in {
        "mjENBL_DIAGEXACT": "the exact diagonal of constraints (diagexact)",
        "mjENBL_IPC": "barriers of contacts (ipc)",
        "mjENBL_SPECULATIVE": "speculative contacts",
    }.items()
    if hasattr(mujoco.mjtEnableBit, name)
}


def closed_pairs(m: mujoco.MjModel) -> list[int]:
    """Return the positions in `contact_pairs` of the pairs that have a narrow phase. A `<pair>` of
    two geoms that no joint moves is left out."""
    kinds, moves = kinds_of(m), m.body_treeid[m.geom_bodyid] >= 0
    return [
        i
        for i, (a, b) in enumerate(contact_pairs(m))
        if _is_closed(m, kinds, a, b) and (moves[a] or moves[b])
    ]


def _is_closed(m: mujoco.MjModel, kinds: tuple[str, ...], a: int, b: int) -> bool:
    """Return whether a pair has a narrow phase. A mesh needs its hull, with faces."""
    if kinds[b] == "mesh" and not m.mesh_polynum[m.geom_dataid[b]]:
        return False
    return (kinds[a], kinds[b]) in PAIRS


def contacts_left_out(m: mujoco.MjModel) -> tuple[str, ...]:
    """Return the entries of `Model.dropped` about contacts that have no narrow phase, and about
    options of contacts."""
    kinds = kinds_of(m)
    missing = Counter(
        (kinds[a], kinds[b]) for a, b in contact_pairs(m) if not _is_closed(m, kinds, a, b)
    )
    out = [f"contact pairs of {a} and {b} ({count})" for (a, b), count in missing.items()]
    names = names_of(m, mujoco.mjtObj.mjOBJ_GEOM, m.ngeom)
    used = np.unique(np.array(contact_pairs(m), int).reshape(-1, 2))
    for what, values in (("adhesion", m.geom_adhesion), ("surface velocity", m.geom_surfacevel)):
        which = [names[i] for i in used if np.any(values[i])]
        out += [f"{what} of geoms ({listed(which)})"] * bool(which)
    if np.any(m.pair_adhesion):
        out.append(f"adhesion of contact pairs ({int(np.count_nonzero(m.pair_adhesion))})")
    if used.size:
        out += [text for bit, text in _OPTIONS.items() if m.opt.enableflags & int(bit)]
        if m.opt.noslip_iterations:
            out.append("iterations without slip (noslip_iterations)")
    return tuple(out)


def check_geoms(m: mujoco.MjModel) -> None:
    """Raise ModelError if a geom with contacts has no size."""
    kinds, names = kinds_of(m), names_of(m, mujoco.mjtObj.mjOBJ_GEOM, m.ngeom)
    for i in _geoms_in_pairs(m):
        sizes = m.geom_size[i, : SIZES.get(kinds[i], 0)]
        if not (sizes > 0).all():
            raise ModelError(
                f"geom {names[i]!r}: the size of the {kinds[i]} is {sizes.tolist()}, expected "
                "numbers above zero; correct it, give the geom contype='0' conaffinity='0', "
                "or load(contacts=False)"
            )


def check_finite(m: mujoco.MjModel) -> None:
    """Raise ModelError if a parameter of a contact, limit, friction loss or equality is not
    finite."""
    for group, name, i in _rows(m):
        prefix, fields = _FIELDS[group]
        for field in fields:
            values = np.atleast_1d(getattr(m, f"{prefix}_{field}")[i])
            if not np.isfinite(values).all():
                wrong = values[~np.isfinite(values)][0]
                raise ModelError(
                    f"{group} ({name}): {field} has {wrong}, expected finite numbers; correct it "
                    "in the file"
                )


def mixed_references(m: mujoco.MjModel) -> tuple[str, ...]:
    """List the geoms, contact pairs, joints, dofs, tendons and equalities whose solref has mixed
    signs."""
    found: dict[str, list[str]] = {}
    for group, name, i in _rows(m):
        prefix, fields = _FIELDS[group]
        for field in (x for x in fields if x.startswith("solref")):
            first, second = getattr(m, f"{prefix}_{field}")[i]
            if (first > 0) != (second > 0) and name not in found.setdefault(group, []):
                found[group].append(name)
    return tuple(f"{group} ({listed(names)})" for group, names in found.items() if names)


def _rows(m: mujoco.MjModel) -> Iterator[tuple[str, str, int]]:
    """Yield the group, name and index of each geom with contacts, contact pair and other row."""
    geoms, joints, tendons, equalities = (
        names_of(m, kind, count)
        for kind, count in (
            (mujoco.mjtObj.mjOBJ_GEOM, m.ngeom),
            (mujoco.mjtObj.mjOBJ_JOINT, m.njnt),
            (mujoco.mjtObj.mjOBJ_TENDON, m.ntendon),
            (mujoco.mjtObj.mjOBJ_EQUALITY, m.neq),
        )
    )
    solver = solver_parameters(m, np.asarray)
    for i in _geoms_in_pairs(m):
        yield "geoms", geoms[i], i
    for k, (a, b) in enumerate(contact_pairs(m)[: m.npair]):
        yield "contact pairs", f"{geoms[a]} and {geoms[b]}", k
    for j in solver.limited:
        yield "joint limits", joints[j], j
    for i in solver.rubbing:
        yield "joint friction loss", joints[m.dof_jntid[i]], i
    for i in np.flatnonzero(limited_tendons(m)).tolist():
        yield "tendon limits", tendons[i], i
    for i in np.flatnonzero(rubbing_tendons(m)).tolist():
        yield "tendon friction loss", tendons[i], i
    for i in loaded_equalities(m):
        yield "equalities", equalities[i], i


def _geoms_in_pairs(m: mujoco.MjModel) -> list[int]:
    return sorted({i for pair in contact_pairs(m) for i in pair})
