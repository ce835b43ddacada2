"""Roles of the joints of a robot file: wheels, steerings, casters and hitches; all others are
locked.

A wheel is below the chassis or a trailer, with at most one steering or caster between them:

    chassis [- hitch - trailer]* [- steering | - caster] - wheel
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from rbjax.errors import InputError, UnknownName
from rbjax.loading.at_rest import AtRest

Patterns = str | Iterable[str]


@dataclass(frozen=True)
class Roles:
    """Indices of the joints of each role."""

    rest: AtRest
    wheels: tuple[int, ...]
    steerings: tuple[tuple[int, ...], ...] = ()  # one tuple for each `Steering`
    casters: tuple[int, ...] = ()
    hitches: tuple[int, ...] = ()  # of trailers, parents first

    @property
    def turntables(self) -> tuple[int, ...]:
        """Indices of the joints of steerings and casters."""
        return (*(j for group in self.steerings for j in group), *self.casters)

    def name(self, j: int) -> str:
        return self.rest.joint_names[j]

    def body(self, j: int) -> int:
        """Return the index of the body above a joint: 0 for the chassis, k for trailer k."""
        found = [k for k, h in enumerate(self.hitches, start=1) if h in self.rest.above(j)]
        return max(found, default=0)

    def turntable(self, wheel: int) -> int | None:
        """Return the joint of the steering or caster of a wheel, or None."""
        above = self.rest.above(wheel)
        return next((j for j in self.turntables if j in above), None)

    def steered(self, j: int) -> int:
        """Return the index of the wheel that a steering or caster turns."""
        return next(i for i, wheel in enumerate(self.wheels) if j in self.rest.above(wheel))

    def wheels_named(self, what: str, patterns: Patterns) -> list[int]:
        """Find the joints of wheels by names or patterns."""
        found = [j for j in hinges(self.rest, what, patterns) if j in self.wheels]
        if patterns and not found:
            named = ", ".join(repr(self.name(j)) for j in self.wheels)
            raise InputError(
                f"from_file: {what} name {patterns!r}, expected some of the wheels {named}"
            )
        return found

    def bodies(self, k: int) -> set[int]:
        """Return the file's bodies that form the chassis or trailer k, without further trailers."""
        root = self.rest.tree(self.rest.root(self.wheels[0]))
        own = set(self.rest.behind(self.hitches[k - 1]) if k else root)
        for hitch in self.hitches:
            if k == 0 or self.hitches[k - 1] in self.rest.above(hitch):
                own -= set(self.rest.behind(hitch))
        return own


def roles(
    rest: AtRest,
    wheels: Patterns,
    steerings: Sequence[str | Sequence[str]],
    casters: Patterns,
    trailers: Patterns,
) -> Roles:
    """Find the joints of all roles by names or patterns.

    Raises:
        UnknownName: no such joint.
        InputError: a joint is not a hinge, is named twice, or is not in the required tree.
    """
    groups: list[tuple[int, ...]] = []
    for given in [steerings] if isinstance(steerings, str) else steerings:
        found = hinges(rest, "steerings", given)
        groups += [(j,) for j in found] if isinstance(given, str) else [tuple(found)]
    out = Roles(
        rest,
        tuple(hinges(rest, "wheels", wheels)),
        tuple(groups),
        tuple(hinges(rest, "casters", casters)),
        tuple(sorted(hinges(rest, "trailers", trailers), key=lambda j: len(rest.above(j)))),
    )
    if not out.wheels:
        raise InputError(
            "from_file: got no wheels, expected names or patterns of the hinges of wheels, of "
            f"{_listed(rest)}"
        )
    named = (*out.wheels, *out.turntables, *out.hitches)
    twice = sorted({out.name(j) for j in named if named.count(j) > 1})
    if twice:
        raise InputError(f"from_file: joints {', '.join(twice)} are named twice, expected once")
    _check_tree(out)
    return out


def hinges(rest: AtRest, what: str, patterns: Patterns) -> list[int]:
    """Find the indices of hinges by names or glob patterns, in the given order."""
    names = rest.joint_names
    given = [patterns] if isinstance(patterns, str) else patterns
    if not isinstance(given, Iterable) or not all(isinstance(x, str) for x in given):
        raise InputError(
            f"from_file: {what} is {patterns!r}, expected names or glob patterns of hinges, of "
            f"{_listed(rest)}"
        )
    out: list[int] = []
    for pattern in given:
        exact = [j for j, name in enumerate(names) if name == pattern]
        found = exact or [
            j
            for j, name in enumerate(names)
            if fnmatchcase(name, pattern) and rest.kind(j) == "hinge"
        ]
        if not found:
            valid = [name for j, name in enumerate(names) if rest.kind(j) == "hinge"]
            raise UnknownName(f"hinge of {what}", pattern, valid)
        for j in found:
            if rest.kind(j) != "hinge":
                raise InputError(
                    f"from_file: {what} name the joint {names[j]!r}, which is a {rest.kind(j)}, "
                    f"expected a hinge, of {_listed(rest)}"
                )
        out += [j for j in found if j not in out]
    return out


def check_upright(roles: Roles, j: int, what: str, tolerance: float) -> float:
    """Return the sine of the lean of a steering, caster or hitch. Raise InputError if it is too
    large."""
    tilt = float(np.hypot(*roles.rest.axis(j)[:2]))
    if tilt > tolerance:
        raise InputError(
            f"from_file: {what} {roles.name(j)!r} leans {np.degrees(np.arcsin(min(1.0, tilt))):.3g}"
            f" degrees from the vertical, expected at most {np.degrees(tolerance):.3g}; hold the "
            "robot upright with q, or raise the tolerance"
        )
    return tilt


def _check_tree(roles: Roles) -> None:
    rest = roles.rest
    roots = {rest.root(j) for j in (*roles.wheels, *roles.turntables, *roles.hitches)}
    if len(roots) > 1:
        raise InputError(
            f"from_file: the joints belong to {len(roots)} robots, with the root bodies "
            f"{', '.join(sorted(map(rest.body_name, roots)))}; expected joints of one robot"
        )
    for wheel in roles.wheels:
        above = rest.above(wheel)
        others = [j for j in roles.wheels if j in above]
        turning = [j for j in roles.turntables if j in above]
        if others or len(turning) > 1:
            names = ", ".join(roles.name(j) for j in (*others, *turning))
            raise InputError(
                f"from_file: the wheel {roles.name(wheel)!r} hangs below {names}, expected at most "
                "one steering or caster, and no wheel"
            )
    for j in roles.turntables:
        below = [w for w in roles.wheels if j in rest.above(w)]
        if len(below) != 1:
            raise InputError(
                f"from_file: {'caster' if j in roles.casters else 'steering'} {roles.name(j)!r} "
                f"carries {len(below)} of the wheels{''.join(' ' + roles.name(w) for w in below)}, "
                f"expected one; below it are the hinges {_listed(rest, j)}"
            )


def _listed(rest: AtRest, above: int | None = None) -> str:
    """Format the names of the hinges as text: all hinges, or only the hinges below a joint."""
    found = [
        repr(name)
        for j, name in enumerate(rest.joint_names)
        if rest.kind(j) == "hinge" and (above is None or above in rest.above(j))
    ]
    return ", ".join(found) or "(there are none)"
