"""Flexible links: beams and elastic bodies as links of a robot.

beams         `Beam`, which `Model.with_beam` adds to a robot
distributed_load forces and moments along a beam
tendons       tendons along a beam
reduced_basis fewer coordinates of a beam, from its modes, static solutions or motions
elasticity    elastic and viscous forces of a beam
regressor     inertial regressor of trees with beams
elastic_columns regressor of the elastic and viscous forces of beams
linear_elasticity forces -K q - D q' of any flexible link; a base that moves freely
cross_section cross-sections: stiffness, mass and rotary inertia per length
strain/       beams whose strains are polynomials of the arclength
modal/        elastic bodies of any shape, by modes in a floating frame
reference/    beams of the literature: lumped chains, nodal elements
"""

from rbjax.flexible import modal
from rbjax.flexible.beams import Beam, beam
from rbjax.flexible.cross_section import Section, circle, ellipse, rectangle, section, tube
from rbjax.flexible.distributed_load import BeamLoad
from rbjax.flexible.elastic_columns import elastic_names, elastic_parameters, elastic_regressor
from rbjax.flexible.elasticity import BeamElasticity
from rbjax.flexible.regressor import section_names, section_parameters, section_regressor
from rbjax.flexible.tendons import BeamPath, BeamTendon

__all__ = [
    "Beam",
    "BeamElasticity",
    "BeamLoad",
    "BeamPath",
    "BeamTendon",
    "Section",
    "beam",
    "circle",
    "elastic_names",
    "elastic_parameters",
    "elastic_regressor",
    "ellipse",
    "modal",
    "rectangle",
    "section",
    "section_names",
    "section_parameters",
    "section_regressor",
    "tube",
]

__dir__ = __all__.copy
