"""MBDyn's modal format (.fem): node positions, mode shapes, modal matrices and lumped masses.

The file consists of records, `** RECORD GROUP n`, with n from 1 to 13 (MBDyn input manual, appendix
"Modal Element Data"). The inertia invariants follow from the lumped masses of record 11. Record 12,
if there is one, replaces mass, center of mass and inertia. Without record 11 the inertia is of
order zero: the deformation moves no mass.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rbjax.arguments import existing_file
from rbjax.display import displayed
from rbjax.errors import InputError, UnknownName
from rbjax.flexible.modal.body import ModalBody
from rbjax.flexible.modal.invariants import InertiaInvariants, inertia_invariants, modal_body

_RECORD = re.compile(r"\*\*\s*RECORD\s+GROUP\s+(\d+)", re.IGNORECASE)


@displayed
class MBDynModal(NamedTuple):
    """A body of MBDyn's modal format, and its initial state.

    Fields:
        body: the modal body.
        q: initial modal displacements (m,).
        v: initial modal velocities (m,).
    """

    body: ModalBody
    q: np.ndarray
    v: np.ndarray


def read_mbdyn_modal(
    path: str | os.PathLike[str], frames: Sequence[str] | None = None
) -> MBDynModal:
    """Read a modal body from a file in MBDyn's modal format.

    Args:
        path: the file, often with the ending .fem.
        frames: labels of the nodes that become frames; None for all.

    Returns:
        `MBDynModal`: the body, and the initial q and q'.

    Raises:
        InputError: a record is missing, has a wrong number of values, or is not valid.
        UnknownName: a label of `frames` is not a node.

    Source: Masarati et al., *MBDyn Input File Format*, appendix on the modal element.

    Example:
        >>> import pathlib, tempfile
        >>> from rbjax.flexible.modal import read_mbdyn_modal
        >>> text = '''** RECORD GROUP 1, HEADER
        ... **  revision, nodes, normal, attached, constraint, rejected
        ... REV0 1 1 0 0 0
        ... ** RECORD GROUP 2
        ... 1001
        ... ** RECORD GROUP 5
        ... 0.5
        ... ** RECORD GROUP 6
        ... 0
        ... ** RECORD GROUP 7
        ... 0
        ... ** RECORD GROUP 8
        ... ** mode 1
        ... 0 0 1 0 0 0
        ... ** RECORD GROUP 9
        ... 2
        ... ** RECORD GROUP 10
        ... 8
        ... ** RECORD GROUP 11
        ... 2 2 2 0 0 0
        ... '''
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "body.fem"
        >>> _ = path.write_text(text)
        >>> found = read_mbdyn_modal(path)
        >>> found.body.frequencies.round(12).tolist(), found.body.first_moment.tolist()
        ([2.0], [1.0, 0.0, 0.0])
    """
    file = existing_file("read_mbdyn_modal", path)
    where = str(file)
    records = _records(file.read_text("utf-8", errors="replace"), where)
    header = _words(records, 1, where, None)
    if len(header) < 6:
        raise InputError(
            f"{where}: record 1 has {len(header)} values, expected the revision and 5 integers"
        )
    n, normal, attached, constraint, rejected = (_integer(x, where) for x in header[1:6])
    m = normal + attached + constraint - rejected
    if n < 1 or m < 1:
        raise InputError(f"{where}: record 1 has {n} nodes and {m} modes, expected one at least")
    labels = _words(records, 2, where, n)
    q, v = (_numbers(records, k, where, m, False) for k in (3, 4))
    places = np.stack([_numbers(records, k, where, n) for k in (5, 6, 7)], 1)
    shape = _numbers(records, 8, where, 6 * n * m).reshape(m, n, 6).transpose(1, 2, 0)
    M, K, D = (_numbers(records, k, where, m * m, k != 13).reshape(m, m).T for k in (9, 10, 13))
    U, V = shape[:, :3], shape[:, 3:]
    found = _inertia(records, where, places, U, V)._replace(I6=(M + M.T) / 2)
    chosen = list(labels) if frames is None else [str(x) for x in frames]
    for name in chosen:
        if name not in labels:
            raise UnknownName("node", name, labels)
    at = [labels.index(name) for name in chosen]
    axes = np.tile(np.eye(3), (len(at), 1, 1))
    body = modal_body(
        found,
        stiffness=(K + K.T) / 2,
        damping=D,
        frames=(places[at], axes, U[at], V[at], None, chosen),
    )
    body.check_inertia(where)
    return MBDynModal(body, q, v)


def _inertia(
    records: dict[int, list[list[str]]],
    where: str,
    places: np.ndarray,
    U: np.ndarray,
    V: np.ndarray,
) -> InertiaInvariants:
    """Compute the invariants from lumped masses and global properties."""
    n, m = len(places), U.shape[-1]
    if 11 in records:
        lumped = _numbers(records, 11, where, 6 * n).reshape(n, 6)
        off = np.abs(lumped[:, :3] - lumped[:, :1]).max()
        if off > 1e-6 * np.abs(lumped[:, :3]).max():
            raise InputError(
                f"{where}: record 11 has masses that differ along x, y and z by {off:.3g}, "
                "expected equal ones"
            )
        J = lumped[:, 3:, None] * np.eye(3)
        found = inertia_invariants(lumped[:, 0], places, U, V, J)
    elif 12 in records:
        # all mass at rest in the floating frame: only the global properties count
        found = inertia_invariants(np.ones(1), np.zeros((1, 3)), np.zeros((1, 3, m)))
    else:
        raise InputError(
            f"{where}: there is neither record 11 (lumped masses) nor 12 (global inertia); a body "
            "that moves needs one of them"
        )
    if 12 not in records:
        return found
    x = _numbers(records, 12, where, 13)
    mass, com, J = x[0], x[1:4], x[4:].reshape(3, 3)
    about = J + mass * (com @ com * np.eye(3) - np.outer(com, com))
    return found._replace(I1=float(mass), I2=mass * com, I7=(about + about.T) / 2)


def _records(text: str, where: str) -> dict[int, list[list[str]]]:
    """Return the lines of each record, as words. Comments start with '*'."""
    out: dict[int, list[list[str]]] = {}
    into: list[list[str]] | None = None
    for line in text.splitlines():
        start = _RECORD.match(line.strip())
        if start:
            number = int(start[1])
            if number in out:
                raise InputError(f"{where}: record {number} is given twice")
            into = out[number] = []
        elif into is not None and line.strip() and not line.lstrip().startswith("*"):
            into.append(line.split())
    if 1 not in out:
        raise InputError(f"{where}: there is no '** RECORD GROUP 1'; is it MBDyn's modal format?")
    return out


def _words(
    records: dict[int, list[list[str]]], number: int, where: str, count: int | None
) -> list[str]:
    if number not in records:
        raise InputError(f"{where}: record {number} is missing")
    words = [w for line in records[number] for w in line]
    if count is not None and len(words) != count:
        raise InputError(
            f"{where}: record {number} has {len(words)} values, expected {count}; a comment must "
            "start with '**'"
        )
    return words


def _numbers(
    records: dict[int, list[list[str]]], number: int, where: str, count: int, needed: bool = True
) -> np.ndarray:
    if number not in records and not needed:
        return np.zeros(count)
    words = _words(records, number, where, count)
    try:
        out = np.array([float(w.replace("D", "E").replace("d", "e")) for w in words])
    except ValueError as error:
        raise InputError(f"{where}: record {number}: {error}, expected numbers") from error
    if not np.isfinite(out).all():
        raise InputError(f"{where}: record {number} has a number that is not finite")
    return out


def _integer(word: str, where: str) -> int:
    try:
        return int(word)
    except ValueError as error:
        raise InputError(f"{where}: record 1 has {word!r}, expected an integer") from error
