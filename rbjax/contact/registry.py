"""The registry of contact laws."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rbjax.contact.coulomb import CoulombContact
from rbjax.contact.impacts.moreau import MoreauContact
from rbjax.contact.soft import SoftContact
from rbjax.errors import InputError
from rbjax.model import Model

#: the classes of the laws, which have the method `solve`
Law = SoftContact | CoulombContact | MoreauContact
#: name -> constructor of the dynamics of a model
_LAWS: dict[str, Callable[[Model], Any]] = {
    "mujoco": lambda model: SoftContact(),
    "coulomb": lambda model: CoulombContact(),
    "impulse": MoreauContact.of,
}


def laws() -> dict[str, Callable[[Model], Any]]:
    """Return the contact laws by name: the values of `contact=` in `step` and `rollout`.

    Each law is a constructor of a dynamics from a model. `rb.contact.CompliantContact` is a force
    element instead, and needs no law.

        name      normal contact     friction           derivative of an impact
        mujoco    soft               soft, creeps       biased at any step size (`SoftContact`)
        coulomb   soft               Coulomb, sticks    biased in the same way
        impulse   rigid              Coulomb, sticks    exact to the order of the step

    Example:
        >>> import rbjax as rb
        >>> list(rb.contact.laws())
        ['mujoco', 'coulomb', 'impulse']
    """
    return dict(_LAWS)


def law_of(where: str, model: Model, contact: Any) -> Any:
    """Return the contact law of a name, or a given law.

    Raises:
        InputError: no such law, or the law does not suit the model.
    """
    known: Callable[[Model], Any] | None = None
    if isinstance(contact, str):
        known = _LAWS.get(contact)
    elif isinstance(contact, Law):
        known = lambda model: contact  # noqa: E731
    if known is None:
        raise InputError(
            f"{where}: contact is {contact!r}, expected one of {list(_LAWS)}, or a law with "
            "arguments, such as rb.contact.SoftContact(iterations=...)"
        )
    law = known(model)
    if isinstance(law, SoftContact | CoulombContact):
        law.check(where, model)
    return law
