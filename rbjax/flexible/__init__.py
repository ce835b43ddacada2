"""Flexible links: beams in strain coordinates, and what a beam is made of.

section     cross-sections: stiffness, mass and rotary inertia per length
strain/     beams whose strains are polynomials of the arclength
"""
