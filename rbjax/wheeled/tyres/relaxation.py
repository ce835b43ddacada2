"""Tyres that relax: the carcass is a spring in series with the slip of the contact.

zeta is the deflection of the contact from the rim. For each newton of load the carcass pulls the
wheel with c (zeta + tau zeta'), c = C / sigma, where C is the slope of the law and sigma the
relaxation length. The contact slides on the ground at v_s + zeta', with the secant G of the law:

    c (zeta + tau zeta') = -G (v_s + zeta') / v,        v = sqrt((r phi')^2 + v_n^2)
    zeta' = -(G v_s + c v zeta) / (G + c tau v)
(Rill & Castro, *Road Vehicle Dynamics*, 3.4; Pacejka, *Tire and Vehicle Dynamics*, 7.2, is the
linear part, zeta' = -v_s - v zeta / sigma.)

    steady      zeta' = 0 gives the traction of the law.
    bounds      the traction is a mean, with the weights G and c tau v, of the spring force and the
                traction of the law, so it is within the limits of the law along and across.
    standing    v = v_n: a spring, which holds a car on a slope. Its deflection decays at the rate
                v_n C / (G sigma), so choose a small v_n, such as 1e-4 m/s.
    power       mu . v_s = -d/dt (c zeta^2 / 2) - c tau zeta'^2 - mu^2 v / G: none is gained.
"""

from __future__ import annotations

from typing import Any

import jax

from rbjax.arguments import instance
from rbjax.lanes import Lane
from rbjax.model.record import Record
from rbjax.wheeled.fields import check_ranges, number
from rbjax.wheeled.tyres.tyre import Pair, Tyre, pair


class Relaxing(Record):
    """A tyre law behind an elastic carcass. Its state is the deflection zeta (2,), m.

        zeta' = -(G v_s + c v zeta) / (G + c tau v),    mu = c (zeta + tau zeta'),  c = C / sigma

    Fields:
        law: a `Tyre`, with a small smooth_speed.
        length: sigma, () or (2,) along and across, m, above 0.
        damping_time: tau (), s; the carcass has the damping c tau.

    Source: Rill & Castro, *Road Vehicle Dynamics*, 2nd ed. 2020, 3.4.

    Example:
        >>> import rbjax as rb
        >>> rubber = rb.wheeled.Relaxing(rb.wheeled.LinearTyre(10.0, smooth_speed=1e-4), 0.3)
        >>> mu, rate = rubber.response(1.9, 0.0, 2.0, (0.0, 0.0))  # it drives; mu grows to 0.5
        >>> float(mu[0]), round(float(rate[0]), 3)
        (0.0, 0.1)
    """

    law: Tyre
    length: jax.Array = number()
    damping_time: jax.Array = number(default=0.0)

    def __check_init__(self) -> None:
        instance("Relaxing", "law", self.law, Tyre, "a tyre law, such as rbjax.wheeled.TMeasy")
        above, least = {"length": 0.0}, {"damping_time": 0.0}
        check_ranges(self, per_axis=True, above=above, least=least)

    @property
    def size(self) -> int:
        """The number of states."""
        return 2

    def response(self, ux: Lane, uy: Lane, roll_speed: Lane, z: Any) -> tuple[Pair, Pair]:
        """Compute the traction (mu_x, mu_y) and the rates (zeta_x', zeta_y'), m/s.

        Args:
            ux, uy: the velocity of the wheel's centre, m/s in the wheel's axes.
            roll_speed: r phi', m/s.
            z: (zeta_x, zeta_y), m.
        """
        v = self.law.reference_speed(roll_speed)
        slides = ux - roll_speed, uy
        secants = self.law.secants(slides[0] / v, slides[1] / v)
        mu, rates = [], []
        for c, G, vs, zeta in zip(self.carcass, secants, slides, z, strict=True):
            cv = c * v
            rate = -(G * vs + cv * zeta) / (G + cv * self.damping_time)
            mu.append(c * (zeta + self.damping_time * rate))
            rates.append(rate)
        return (mu[0], mu[1]), (rates[0], rates[1])

    def damping(self, vx: Lane, vy: Lane, roll_speed: Lane, h: Lane) -> Pair:
        """Compute the damping c (h + tau) G / (G + c v tau) of the sliding velocity, s/m.

        G is the secant of the law, v the rolling speed, c and tau stiffness and damping time of the
        carcass. It is the implicit damping by the traction at the end of a step h.
        """
        v = self.law.reference_speed(roll_speed)
        secants = self.law.secants(vx / v, vy / v)
        along, across = (
            c * (h + self.damping_time) * G / (G + c * v * self.damping_time)
            for c, G in zip(self.carcass, secants, strict=True)
        )
        return along, across

    def stored(self, z: Any) -> Lane:
        """Compute the elastic energy per newton of load, (c_x zeta_x^2 + c_y zeta_y^2) / 2, m."""
        (cx, cy), (x, y) = self.carcass, z
        return (cx * x * x + cy * y * y) / 2

    @property
    def limits(self) -> Pair:
        """The traction limits of the law."""
        return self.law.limits

    @property
    def carcass(self) -> Pair:
        """The carcass stiffness c = C / sigma along and across, 1/m."""
        (ax, ay), (sx, sy) = self.law.slopes, pair(self.length)
        return ax / sx, ay / sy
