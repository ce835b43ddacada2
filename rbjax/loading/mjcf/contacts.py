"""Contacts of a file as the model takes them: pairs with a narrow phase, and checks of geoms."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import mujoco
import numpy as np

from rbjax.contact.geometry.narrow_phase import PAIRS
from rbjax.errors import ModelError, listed
from rbjax.loading.mjcf.constraints import equalities_are_on, is_loaded
from rbjax.loading.mjcf.contact_pairs import contact_pairs
from rbjax.loading.mjcf.fields import names_of
from rbjax.loading.mjcf.solver_parameters import solver_parameters
from rbjax.loading.mjcf.tendons import limited_tendons, rubbing_tendons
from rbjax.model.geoms import SIZES

_SHOWN = 4  # names listed before "and N more"
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


def kinds_of(m: mujoco.MjModel) -> tuple[str, ...]:
    """Return the kind of each geom, such as "box"."""
    return tuple(mujoco.mjtGeom(int(t)).name[7:].lower() for t in m.geom_type)


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
        out += [f"{what} of geoms ({listed(which, _SHOWN)})"] * bool(which)
    if np.any(m.pair_adhesion):
        out.append(f"adhesion of contact pairs ({int(np.count_nonzero(m.pair_adhesion))})")
    if used.size:
        out += [text for bit, text in _OPTIONS.items() if m.opt.enableflags & int(bit)]
        if m.opt.noslip_iterations:
            out.append("iterations without slip (noslip_iterations)")
    return tuple(out)


def check_geoms(m: mujoco.MjModel) -> None:
    """Raise ModelError if a geom with contacts has no size, or a parameter is not finite."""
    kinds, names = kinds_of(m), names_of(m, mujoco.mjtObj.mjOBJ_GEOM, m.ngeom)
    pairs = contact_pairs(m)
    for i in sorted({i for pair in pairs for i in pair}):
        sizes = m.geom_size[i, : SIZES.get(kinds[i], 0)]
        if not (sizes > 0).all():
            raise ModelError(
                f"geom {names[i]!r}: the size of the {kinds[i]} is {sizes.tolist()}, expected "
                "numbers above zero; correct it, give the geom contype='0' conaffinity='0', "
                "or load(contacts=False)"
            )
        for field in ("friction", "solref", "solimp", "margin", "gap", "solmix", "size"):
            _check_finite(f"geom {names[i]!r}", field, getattr(m, f"geom_{field}")[i])
    for k, (a, b) in enumerate(pairs[: m.npair]):
        for field in ("friction", "solref", "solreffriction", "solimp", "margin", "gap"):
            where = f"contact pair of {names[a]!r} and {names[b]!r}"
            _check_finite(where, field, getattr(m, f"pair_{field}")[k])


def check_rows(m: mujoco.MjModel) -> None:
    """Raise ModelError if a parameter of a limit, friction loss or equality is not finite."""
    joint, tendon = mujoco.mjtObj.mjOBJ_JOINT, mujoco.mjtObj.mjOBJ_TENDON
    joints, tendons = names_of(m, joint, m.njnt), names_of(m, tendon, m.ntendon)
    solver = solver_parameters(m, np.asarray)
    for j in solver.limited:
        for field in ("solref", "solimp", "margin"):
            _check_finite(f"joint {joints[j]!r}", field, getattr(m, f"jnt_{field}")[j])
    for i in solver.rubbing:
        for field in ("frictionloss", "solref", "solimp"):
            where = f"joint {joints[m.dof_jntid[i]]!r}"
            _check_finite(where, f"{field} of the friction", getattr(m, f"dof_{field}")[i])
    for mask, fields in (
        (limited_tendons(m), ("range", "margin", "solref_lim", "solimp_lim")),
        (rubbing_tendons(m), ("frictionloss", "solref_fri", "solimp_fri")),
    ):
        for i in np.flatnonzero(mask).tolist():
            for field in fields:
                _check_finite(f"tendon {tendons[i]!r}", field, getattr(m, f"tendon_{field}")[i])
    for name, i in _equalities(m):
        for field in ("solref", "solimp"):
            _check_finite(f"equality {name!r}", field, getattr(m, f"eq_{field}")[i])


def _equalities(m: mujoco.MjModel) -> list[tuple[str, int]]:
    """Return names and indices of the equalities that are loaded."""
    if not equalities_are_on(m):
        return []
    names = names_of(m, mujoco.mjtObj.mjOBJ_EQUALITY, m.neq)
    active = np.flatnonzero(m.eq_active0).tolist()
    return [(names[i], i) for i in active if is_loaded(m, i)]


def _check_finite(where: str, field: str, values: np.ndarray) -> None:
    values = np.atleast_1d(values)
    if not np.isfinite(values).all():
        wrong = values[~np.isfinite(values)][0]
        raise ModelError(
            f"{where}: {field} has {wrong}, expected finite numbers; correct it in the file"
        )


def mixed_references(m: mujoco.MjModel) -> tuple[str, ...]:
    """List the geoms, contact pairs, joints, dofs, tendons and equalities whose solref has mixed
    signs."""
    geoms, joints, tendons = (
        names_of(m, kind, count)
        for kind, count in (
            (mujoco.mjtObj.mjOBJ_GEOM, m.ngeom),
            (mujoco.mjtObj.mjOBJ_JOINT, m.njnt),
            (mujoco.mjtObj.mjOBJ_TENDON, m.ntendon),
        )
    )
    pairs = contact_pairs(m)
    used = sorted({i for pair in pairs for i in pair})
    solver = solver_parameters(m, np.asarray)

    def rows() -> Iterator[tuple[str, str, np.ndarray]]:
        for i in used:
            yield "geoms", geoms[i], m.geom_solref[i]
        for k, (a, b) in enumerate(pairs[: m.npair]):
            yield "contact pairs", f"{geoms[a]} and {geoms[b]}", m.pair_solref[k]
            yield "contact pairs", f"{geoms[a]} and {geoms[b]}", m.pair_solreffriction[k]
        for j in solver.limited:
            yield "joint limits", joints[j], m.jnt_solref[j]
        for i in solver.rubbing:
            yield "joint friction loss", joints[m.dof_jntid[i]], m.dof_solref[i]
        for i in np.flatnonzero(limited_tendons(m)).tolist():
            yield "tendon limits", tendons[i], m.tendon_solref_lim[i]
        for i in np.flatnonzero(rubbing_tendons(m)).tolist():
            yield "tendon friction loss", tendons[i], m.tendon_solref_fri[i]
        for name, i in _equalities(m):
            yield "equalities", name, m.eq_solref[i]

    found: dict[str, list[str]] = {}
    for what, name, (first, second) in rows():
        if (first > 0) != (second > 0) and name not in found.setdefault(what, []):
            found[what].append(name)
    return tuple(f"{what} ({listed(names, _SHOWN)})" for what, names in found.items() if names)
