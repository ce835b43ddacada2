"""Standard input data of flexible bodies (SID): text files, and their structure in memory.

Each block is a Taylor expansion M0 + sum_k M1_k q_k (Wallrapp, *Standardization of flexible body
modeling in multibody system codes*, Mech. Struct. Mach. 22(3), 1994). With the symbols of
`rbjax.flexible.modal.body`:

    mdCM = h,  J = J,  Ct = l^T (m, 3),  Cr = c^T (m, 3),  Me = M,  Ke = K,  De = D
    Gr_j = 2 D_j,  D_j w = (w x c_j + dJ/dq_j w) / 2
    Ge_k = row j: (c1_jk - c1_kj)^T
    Oe   = row j: -w.D_j w on (wx^2, wy^2, wz^2, wx wy, wy wz, wx wz)
    frames: origin, phi = U + A q, psi = V, AP = R0

Gr and Ge follow from the others and are not read. The first-order term of Oe is that of G - J2. If
the file has geometric stiffening, J2 is at least the part that the modes carry,
sum_j c1_jk c1_jl^T / M, and this is taken. First-order terms of Ct, Cr, Oe and phi include
geometric stiffening, if the file has it. Files index M1 as (row, column, q) or as (row, q, column).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from rbjax.arguments import existing_file, new_file
from rbjax.errors import InputError
from rbjax.flexible.modal.body import FRAME_FIELDS, ModalBody, check_body, shapes

#: pairs of angular velocities, in the order of the columns of Oe
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))
#: entries of J with six rows: files of FEMBS have another order there, as their Gr shows
SIX = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
FRAME_BLOCKS = ("origin", "phi", "psi", "AP", "sigma")
BLOCKS = ("mdCM", "J", "Ct", "Cr", "Me", "Gr", "Ge", "Oe", "ksigma", "Ke", "De")
#: largest size of a block, and number of modes
LARGEST = 100_000
_ENTRY = re.compile(r"m([01])\s*\(([\d\s,]+)\)\s*=\s*(\S+)", re.IGNORECASE)


def read_sid(path: str | os.PathLike[str]) -> ModalBody:
    """Read a modal body from a text file of standard input data.

    Args:
        path: the file, often with the ending .SID_FEM.

    Returns:
        `ModalBody`.

    Raises:
        InputError: no such file, a line that is not valid, a block that is missing, indices of
            first-order terms that contradict each other, or negative kinetic energy.

    Source: Wallrapp 1994; the files of FEMBS and of FEMBeam.

    Example:
        >>> import pathlib, tempfile
        >>> import numpy as np
        >>> from rbjax.flexible.modal import from_points, read_sid, write_sid
        >>> body = from_points([2.0], [[1.0, 0, 0]], np.ones((1, 3, 1)), stiffness=[[8.0]])
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "body.SID_FEM"
        >>> write_sid(body, path)
        >>> float(read_sid(path).stiffness[0, 0])
        8.0
    """
    file = existing_file("read_sid", path)
    body = from_sid(_parse(file.read_text("utf-8", errors="replace"), str(file)))
    body.check_inertia(str(file))
    return body


def from_sid(sid: Any) -> ModalBody:
    """Create a modal body from a structure of standard input data.

    Args:
        sid: an object with the attributes `refmod` (mass, nelastq, ielastq), `frame` (a sequence of
            objects with origin, phi, psi and AP or APmod) and mdCM, J, Ct, Cr, Me, Oe, Ke and
            perhaps De, each with the arrays M0 (rows, columns) and perhaps M1 (rows, columns, q).

    Returns:
        `ModalBody`.

    Raises:
        InputError: a block is missing or has a wrong shape.

    Source: Wallrapp 1994; Schwertassek & Wallrapp 1999, table 6.9.

    Example:
        >>> from types import SimpleNamespace as Structure
        >>> import numpy as np
        >>> from rbjax.flexible.modal import from_sid
        >>> block = lambda *shape: Structure(M0=np.ones(shape))
        >>> sid = Structure(refmod=Structure(mass=2.0, nelastq=1, ielastq=["bending"]), frame=[],
        ...     mdCM=block(3, 1), J=block(3, 3), Ct=block(1, 3), Cr=block(1, 3), Me=block(1, 1),
        ...     Oe=block(1, 6), Ke=block(1, 1))
        >>> from_sid(sid).first_moment.tolist()
        [1.0, 1.0, 1.0]
    """
    m = int(sid.refmod.nelastq)
    names = [str(x).strip() for x in getattr(sid.refmod, "ielastq", [])]
    labels = tuple(names) if len(names) == m else tuple(f"mode {k + 1}" for k in range(m))

    def block(owner: Any, names: tuple[str, ...], rows: int, columns: int, needed: bool = True):
        found = next((getattr(owner, n) for n in names if hasattr(owner, n)), None)
        M0 = np.zeros((0, 0)) if found is None else np.asarray(found.M0, float)
        if M0.size == 0:
            if needed:
                raise InputError(f"SID: the block {names[0]} is missing")
            M0 = np.zeros((rows, columns))
        M1 = np.asarray(getattr(found, "M1", np.zeros(0)), float)
        M1 = np.zeros((*M0.shape, m)) if M1.size == 0 else M1
        if names[0] == "J" and M0.shape == (6, 1):
            M0, M1 = _from_six(M0[:, 0]), _from_six(M1[:, 0])
        if M0.shape != (rows, columns) or M1.shape != (rows, columns, m):
            raise InputError(
                f"SID: the block {names[0]} has M0 {M0.shape} and M1 {M1.shape}, expected "
                f"({rows}, {columns}) and ({rows}, {columns}, {m}) for {m} modes"
            )
        return M0, M1

    h, _ = block(sid, ("mdCM",), 3, 1)
    J, J1 = block(sid, ("J",), 3, 3)
    Ct, Ct1 = block(sid, ("Ct",), m, 3)
    Cr, Cr1 = block(sid, ("Cr",), m, 3)
    Me, Ke, De = (block(sid, (k,), m, m, k != "De")[0] for k in ("Me", "Ke", "De"))
    _, Oe1 = block(sid, ("Oe",), m, 6)
    total = np.zeros((m, m, 3, 3))  # J2 - G
    for n, (a, b) in enumerate(PAIRS):
        total[:, :, a, b] = total[:, :, b, a] = -Oe1[:, n] / (1 if a == b else 2)
    total = (total + total.transpose(1, 0, 2, 3)) / 2
    h2, c1 = Ct1.transpose(1, 0, 2), Cr1.transpose(1, 0, 2)
    P = len(sid.frame)
    empty = shapes(m, P)
    arrays = {k: np.zeros(empty[k]) for k in FRAME_FIELDS}
    for k, node in enumerate(sid.frame):
        arrays["positions"][k] = block(node, ("origin",), 3, 1)[0][:, 0]
        phi, phi1 = block(node, ("phi",), 3, m)
        arrays["modes"][k] = phi
        arrays["second_modes"][k] = (phi1 + phi1.transpose(0, 2, 1)) / 2
        arrays["rotation_modes"][k] = block(node, ("psi",), 3, m, False)[0]
        arrays["orientations"][k] = block(node, ("AP", "APmod"), 3, 3)[0]
    stiffened = np.any(h2) or np.any(arrays["second_modes"])
    J2 = _carried(c1, Me) if stiffened else total
    given: dict[str, Any] = dict(
        mass=float(sid.refmod.mass),
        first_moment=h[:, 0],
        first_moment1=Ct.T,
        first_moment2=(h2 + h2.transpose(0, 2, 1)) / 2,
        inertia=(J + J.T) / 2,
        inertia1=((J1 + J1.transpose(1, 0, 2)) / 2).transpose(2, 0, 1),
        inertia2=J2,
        centrifugal_stiffness=J2 - total,
        coupling=Cr.T,
        coupling1=c1,
        modal_mass=(Me + Me.T) / 2,
        stiffness=(Ke + Ke.T) / 2,
        damping=De,
        **arrays,
    )
    frames = tuple(str(getattr(node, "name", k + 1)).strip() for k, node in enumerate(sid.frame))
    return ModalBody(**given, mode_names=labels, frame_names=frames)


def write_sid(body: ModalBody, path: str | os.PathLike[str]) -> None:
    """Write a modal body as a text file of standard input data, with all digits.

    First-order terms are indexed as (row, column, q). The columns of Gr and Ge are in the order of
    the modes, three for each.

    Args:
        body: the body, whose arrays are not traced.
        path: the file to write.

    Raises:
        InputError: not a modal body, or not a path.

    Source: Wallrapp 1994.

    See `read_sid` for an example.

    Example:
        >>> import numpy as np
        >>> from rbjax.flexible.modal import write_sid
        >>> import tempfile, pathlib
        >>> from rbjax.flexible.modal import from_points
        >>> body = from_points(np.ones(2), np.eye(3)[:2], np.zeros((2, 3, 1)))
        >>> file = pathlib.Path(tempfile.mkdtemp()) / "rod.SID_FEM"
        >>> write_sid(body, file)
        >>> file.exists()
        True
    """
    check_body("write_sid", body)
    file = new_file("write_sid", path)
    b = SimpleNamespace(**{k: np.asarray(getattr(body, k)) for k in shapes(1, 1)})
    m, lines = body.mode_count, ["SID written by rbjax", "part", "new modal", "refmod"]
    lines += [f"mass = {float(b.mass)!r}", f"nelastq = {m}"]
    lines += [f"ielastq({k + 1}) = {name}" for k, name in enumerate(body.mode_names)]
    lines += ["end refmod", "frame"]
    for k, name in enumerate(body.frame_names):
        lines += [f"new node = {name}", "rframe = body ref"]
        lines += _block("origin", b.positions[k][:, None], b.modes[k][:, None])
        lines += _block("phi", b.modes[k], b.second_modes[k])
        lines += _block("psi", b.rotation_modes[k])
        turned = np.einsum("abj,bc->acj", _skew(b.rotation_modes[k]), b.orientations[k])
        lines += [*_block("AP", b.orientations[k], turned), "end node"]
    lines.append("end frame")
    D = (b.inertia1 - _skew(b.coupling).transpose(2, 0, 1)) / 2
    D1 = (
        2 * b.inertia2 - _skew(b.coupling1.reshape(3, -1)).reshape(3, 3, m, m).transpose(2, 3, 0, 1)
    ) / 2
    twice = [1 if a == c else 2 for a, c in PAIRS]
    Oe = [-f * b.inertia1[:, a, c] / 2 for f, (a, c) in zip(twice, PAIRS, strict=True)]
    total = b.inertia2 - b.centrifugal_stiffness
    Oe1 = [-f * total[:, :, a, c] for f, (a, c) in zip(twice, PAIRS, strict=True)]
    c1 = b.coupling1
    lines += _block("mdCM", b.first_moment[:, None], b.first_moment1[:, None])
    lines += _block("J", b.inertia, b.inertia1.transpose(1, 2, 0))
    lines += _block("Ct", b.first_moment1.T, b.first_moment2.transpose(1, 0, 2))
    lines += _block("Cr", b.coupling.T, c1.transpose(1, 0, 2))
    lines += _block("Me", b.modal_mass)
    lines += _block(
        "Gr", 2 * np.concatenate(list(D), 1), 2 * np.concatenate(list(D1.transpose(0, 2, 3, 1)), 1)
    )
    lines += _block("Ge", np.concatenate([(c1[:, :, k] - c1[:, k]).T for k in range(m)], 1))
    lines += _block("Oe", np.stack(Oe, 1), np.stack(Oe1, 1))
    lines += [*_block("Ke", b.stiffness), *_block("De", b.damping), "end modal", "end part"]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _carried(c1: np.ndarray, M: np.ndarray) -> np.ndarray:
    """Return the least J2 of displacements in the modes: sum_j c1_jk c1_jl^T / M (Bessel)."""
    g = (c1 - c1.transpose(0, 2, 1)) / 2
    J2 = np.einsum("ajk,ji,bil->klab", g, np.linalg.pinv(M), g)
    J2 = (J2 + J2.transpose(1, 0, 2, 3)) / 2
    return (J2 + J2.swapaxes(2, 3)) / 2


def _block(name: str, M0: np.ndarray, M1: np.ndarray | None = None) -> list[str]:
    rows, columns = M0.shape
    nq = 0 if M1 is None else M1.shape[2]
    out = [
        name,
        f"order = {int(M1 is not None)}",
        f"nrow = {rows}",
        f"ncol = {columns}",
        f"nq = {nq}",
        "nqn = 0",
        "structure = 3",
    ]
    for at in zip(*np.nonzero(M0), strict=True):
        out.append(f"m0({at[0] + 1}, {at[1] + 1}) = {float(M0[at])!r}")
    for at in zip(*np.nonzero(np.zeros((0, 0, 0)) if M1 is None else M1), strict=True):
        assert M1 is not None
        out.append(f"m1({at[0] + 1}, {at[1] + 1}, {at[2] + 1}) = {float(M1[at])!r}")
    return [*out, f"end {name}"]


def _skew(a: np.ndarray) -> np.ndarray:
    """Return [a_k] (3, 3, n) of the columns of a (3, n)."""
    return np.cross(a.T[:, None], np.eye(3)).transpose(2, 1, 0)


def _from_six(x: np.ndarray) -> np.ndarray:
    """Return symmetric (3, 3, ...) from (6, ...) in the order of `SIX`."""
    out = np.zeros((3, 3, *x.shape[1:]))
    for n, (a, b) in enumerate(SIX):
        out[a, b] = out[b, a] = x[n]
    return out


@dataclass
class _Taylor:
    """A Taylor series of an SID file while its block is read."""

    name: str
    sizes: dict[str, int] = field(default_factory=dict)
    entries: list[tuple[int, tuple[int, ...], float]] = field(default_factory=list)

    def arrays(self, m: int, swapped: bool) -> SimpleNamespace:
        rows, columns = self.sizes.get("nrow", 0), self.sizes.get("ncol", 0)
        M0, M1 = np.zeros((rows, columns)), np.zeros((rows, columns, m))
        structure = self.sizes.get("structure", 3)
        if structure == 4:
            M0 = np.eye(rows, columns)
        for order, at, value in self.entries:
            if order == 1 and swapped:
                at = (at[0], at[2], at[1])
            into = M1 if order else M0
            if any(not 1 <= k <= n for k, n in zip(at, into.shape, strict=True)):
                raise InputError(
                    f"SID: the block {self.name} has the index {at}, expected up to {into.shape}"
                )
            spot = tuple(k - 1 for k in at)
            into[spot] = value
            if structure == 2:
                into[(spot[1], spot[0], *spot[2:])] = value
        return SimpleNamespace(M0=M0, M1=M1)


def _parse(text: str, where: str) -> SimpleNamespace:
    """Parse a text to the structure that `from_sid` takes."""
    lines = _lines(text, where)
    sid = SimpleNamespace(refmod=SimpleNamespace(mass=None, nelastq=None, ielastq=[]), frame=[])
    node: Any = None
    found: list[tuple[Any, _Taylor]] = []
    for number, line in lines:
        key, _, value = (x.strip() for x in line.partition("="))
        if key in BLOCKS or key in FRAME_BLOCKS:
            owner = node if key in FRAME_BLOCKS else sid
            if owner is None:
                raise InputError(f"{where}, line {number}: {key} is outside of a node")
            found.append((owner, _taylor(key, lines, where)))
        elif key == "new node":
            node = SimpleNamespace(name=value)
            sid.frame.append(node)
        elif key == "end node":
            node = None
        elif key == "mass":
            sid.refmod.mass = _number(value, where, number)
        elif key == "nelastq":
            sid.refmod.nelastq = _integer(value, where, number)
        elif key.startswith("ielastq"):
            sid.refmod.ielastq.append(value)
    if sid.refmod.mass is None or sid.refmod.nelastq is None:
        raise InputError(f"{where}: there is no mass or nelastq in refmod; is it a SID file?")
    m = sid.refmod.nelastq
    swapped = _is_swapped([x for _, x in found], m, where)
    for owner, block in found:
        setattr(owner, block.name, block.arrays(m, swapped))
    return sid


def _is_swapped(blocks: list[_Taylor], m: int, where: str) -> bool:
    """Return True if first-order terms are indexed as (row, q, column)."""
    votes = {True: "", False: ""}
    for block in blocks:
        columns = block.sizes.get("ncol", 0)
        for order, at, _ in block.entries:
            if order == 1 and (at[1] > columns or at[2] > m):
                votes[True] = f"{block.name} {at}"
            if order == 1 and (at[1] > m or at[2] > columns):
                votes[False] = f"{block.name} {at}"
    if votes[True] and votes[False]:
        raise InputError(
            f"{where}: m1 of {votes[True]} can only be (row, q, column), and m1 of {votes[False]} "
            "only (row, column, q); expected one order in a file"
        )
    return bool(votes[True])


def _lines(text: str, where: str) -> Iterator[tuple[int, str]]:
    started = False
    for number, line in enumerate(text.splitlines(), 1):
        line = " ".join(line.split())
        started = started or line == "part"
        if started and line:
            yield number, line


def _taylor(name: str, lines: Iterator[tuple[int, str]], where: str) -> _Taylor:
    out = _Taylor(name)
    for number, line in lines:
        if line == f"end {name}":
            return out
        entry = _ENTRY.fullmatch(line)
        if entry:
            at = tuple(_integer(k, where, number, 1) for k in entry[2].split(","))
            if len(at) != 2 + int(entry[1]):
                raise InputError(
                    f"{where}, line {number}: got {line!r}, expected {2 + int(entry[1])} indices"
                )
            out.entries.append((int(entry[1]), at, _number(entry[3], where, number)))
            continue
        key, equal, value = (x.strip() for x in line.partition("="))
        if not equal or key not in ("order", "nrow", "ncol", "nq", "nqn", "structure"):
            raise InputError(
                f"{where}, line {number}: got {line!r} in the block {name}, expected order, nrow, "
                f"ncol, nq, nqn, structure, m0(i, j), m1(i, j, k) or 'end {name}'"
            )
        out.sizes[key] = _integer(value, where, number)
    raise InputError(f"{where}: the block {name} has no 'end {name}'")


def _integer(text: str, where: str, line: int, least: int = 0) -> int:
    x = _number(text, where, line)
    if not least <= x <= LARGEST or x != int(x):
        due = f"an integer from {least} to {LARGEST}"
        raise InputError(f"{where}, line {line}: got {text!r}, expected {due}")
    return int(x)


def _number(text: str, where: str, line: int) -> float:
    try:
        return float(text.replace("D", "E").replace("d", "e"))
    except ValueError as error:
        raise InputError(f"{where}, line {line}: got {text!r}, expected a number") from error
