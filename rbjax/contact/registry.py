"""The registry of contact laws."""

from __future__ import annotations

from typing import Any

from rbjax.contact.soft import SoftContact
from rbjax.errors import InputError
from rbjax.model import Model

_LAWS: dict[str, Any] = {"mujoco": SoftContact()}


def laws() -> dict[str, Any]:
    """Return the contact laws by name: the values of `contact=` in `step` and `rollout`.

    Example:
        >>> import rbjax as rb
        >>> "mujoco" in rb.contact.laws()
        True
    """
    return dict(_LAWS)


def law_of(where: str, model: Model, contact: Any) -> Any:
    """Return the contact law of a name, or a given `SoftContact`.

    Raises:
        InputError: no such law, or the law does not suit the model.
    """
    law: Any = _LAWS.get(contact) if isinstance(contact, str) else contact
    if not hasattr(law, "check"):
        raise InputError(
            f"{where}: contact is {contact!r}, expected one of {list(_LAWS)}, "
            "or rb.contact.SoftContact(iterations=...)"
        )
    law.check(where, model)
    return law
