"""The formulations that there are, and which one a motion takes."""

from __future__ import annotations

from typing import Any

from rbjax.constraints.formulation import Baumgarte, Formulation, Multipliers, Projected
from rbjax.errors import InputError, UnknownName
from rbjax.model import Model

DEFAULT = Projected()
_FORMULATIONS: dict[str, Formulation] = {f.name: f for f in (DEFAULT, Multipliers(), Baumgarte())}


def formulations() -> dict[str, Formulation]:
    """The formulations by name, each with its `family` and `index`.

    Example:
        >>> import rbjax as rb
        >>> rb.constraints.formulations()["baumgarte"].index
        1
    """
    return dict(_FORMULATIONS)


def formulation_of(where: str, model: Model, given: Any, law: Any, free: Any) -> Any:
    """The law of a motion: the caller's, or a formulation of the model's constraints, or free
    motion. `given`: a name, a `Formulation`, or None for the default."""
    if law is not free:
        if given is not None:
            raise InputError(
                f"{where}: got a law and constraints={given!r}; give one of them: a formulation is "
                "a law"
            )
        return law
    if not model.constraints:
        if given is not None:
            raise InputError(
                f"{where}: constraints={given!r}, and the model has none; "
                "model.with_constraints(...) adds some"
            )
        return law
    if given is None:
        return DEFAULT
    if isinstance(given, Formulation):
        return given
    if isinstance(given, str) and given in _FORMULATIONS:
        return _FORMULATIONS[given]
    raise UnknownName("formulation", given, _FORMULATIONS)
