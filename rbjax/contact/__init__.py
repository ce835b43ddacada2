"""Contacts of geoms: which pairs may touch, where, how far they are apart, and laws of contact.

    detect             candidate contacts at a configuration
    with_geom          one more geom of a robot, as on a frame of a beam
    solve              acceleration and forces of a law, with the report of its solver
    impulse            velocity after an impact (Newton's or energetic restitution)
    SoftContact        MuJoCo's soft contact
    CoulombContact     dynamics of a step: soft normal contact, true Coulomb friction and sticking
    CompliantContact   force element: Hunt-Crossley and smooth friction
    MoreauContact      dynamics of a step: impulses with restitution and Coulomb friction
`rb.simulate_impacts` integrates from impact to impact.
"""

from rbjax.contact.compliant import CompliantContact
from rbjax.contact.contact_solution import solve
from rbjax.contact.coulomb import CoulombContact
from rbjax.contact.geom_addition import with_geom
from rbjax.contact.geometry.detection import Contacts, detect, pairs
from rbjax.contact.impacts.impulses import Impulse, impulse
from rbjax.contact.impacts.moreau import MoreauContact
from rbjax.contact.registry import laws
from rbjax.contact.soft import SoftContact
from rbjax.contact.solver.contact_forces import ContactForces
from rbjax.contact.solver.solution import ContactSolution

__all__ = [
    "CompliantContact",
    "ContactForces",
    "ContactSolution",
    "Contacts",
    "CoulombContact",
    "Impulse",
    "MoreauContact",
    "SoftContact",
    "detect",
    "impulse",
    "laws",
    "pairs",
    "solve",
    "with_geom",
]

__dir__ = __all__.copy
