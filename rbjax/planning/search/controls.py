"""A finite set of controls of a wheeled robot, and a table of their motions.

A control is a speed v and a turning rate w, constant over a time dt:

    x' = v cos(theta),  y' = v sin(theta),  theta' = w

A robot that slides sideways also has a speed u to the left. The motion is an arc, integrated
exactly. If w dt is a multiple of the width of a heading's cell, only n headings occur, and all
motions can be tabulated by heading and control.
(Lynch & Park, *Modern Robotics*, 10.4.2, figure 10.14)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.arguments import integer, real_array, real_number
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.planning.maps.footprint import Footprint
from rbjax.planning.paths.path import Path, displacements

HEADINGS = 72  # heading cells of a full turn
UNIT = 10  # the price of driving a cell's diagonal straight ahead


@displayed
@dataclass(frozen=True, eq=False)
class Controls:
    """The finite set of controls of a planner.

    Fields:
        speeds: (n,), m/s, negative backwards.
        turn_rates: (n,), rad/s.
        dt: the duration of each control, s.
        costs: (n,), positive integers; None for 1 each.
        reversal: the cost of a change between driving forwards and backwards, a nonnegative
            integer.
        steering: the cost of a change of curvature, a nonnegative integer.
        sideways: (n,), m/s to the left; None for 0 each.

    Example:
        >>> car = Controls.car(radius=1.0, turn=np.deg2rad(15.0), reversal=2)
        >>> len(car.speeds), round(car.dt, 4), car.costs.tolist()
        (6, 0.2618, [1, 1, 1, 1, 1, 1])
    """

    speeds: np.ndarray
    turn_rates: np.ndarray
    dt: float
    costs: Any = None
    reversal: int = 0
    steering: int = 0
    sideways: Any = None

    def __post_init__(self) -> None:
        speeds, rates = (
            np.atleast_1d(real_array("Controls", name, x))
            for name, x in (("speeds", self.speeds), ("turn_rates", self.turn_rates))
        )
        costs = np.ones(len(speeds), int) if self.costs is None else np.asarray(self.costs)
        if speeds.ndim != 1 or not len(speeds) or not speeds.shape == rates.shape == costs.shape:
            raise InputError(
                f"Controls: got speeds, turn_rates and costs of shapes {speeds.shape}, "
                f"{rates.shape} and {costs.shape}, expected (n,) each"
            )
        slides = np.zeros_like(speeds) if self.sideways is None else np.asarray(self.sideways)
        if slides.shape != speeds.shape or not np.isfinite(slides).all():
            raise InputError(
                f"Controls: sideways is {self.sideways!r}, expected {len(speeds)} finite speeds "
                "in m/s"
            )
        real_number("Controls", "dt", self.dt, above=0.0)
        if costs.dtype.kind not in "iu" or (costs < 1).any():
            raise InputError(
                f"Controls: costs are {costs.tolist()}, expected positive integers: choose a unit "
                "so small that every cost is a multiple of it"
            )
        for name in ("reversal", "steering"):
            integer("Controls", name, getattr(self, name), least=0)
        for name, value in (
            ("speeds", speeds), ("turn_rates", rates), ("costs", costs),
            ("sideways", slides.astype(float)),
        ):  # fmt: skip
            object.__setattr__(self, name, value)

    @classmethod
    def car(
        cls, radius: float, turn: float, speed: float = 1.0, costs: Any = None, reversal: int = 0,
        steering: int = 0,
    ) -> Controls:  # fmt: skip
        """Make the six controls of a car: forwards and backwards; left, straight and right.

        radius: the turning radius, m.
        turn: the angle of an arc, rad.
        speed: m/s.
        costs: (6,), forwards before backwards, and from left to right.
        """
        for name, x in (("radius", radius), ("turn", turn), ("speed", speed)):
            real_number("Controls.car", name, x, "a number above zero", above=0.0, traced=True)
        speeds = speed * np.repeat([1.0, -1.0], 3)
        bend = np.tile([1.0, 0.0, -1.0], 2) / radius
        return cls(speeds, speeds * bend, float(radius * turn / speed), costs, reversal, steering)

    @property
    def steps(self) -> np.ndarray:
        """Displacement twists (n, 3) of the motions: m forwards, m to the left, rad."""
        return self.dt * np.column_stack([self.speeds, self.sideways, self.turn_rates])

    @property
    def curvatures(self) -> np.ndarray:
        """Curvatures w / v (n,), 1/m; zero for controls that do not drive."""
        still = self.speeds == 0
        return np.where(still, 0.0, self.turn_rates / np.where(still, 1.0, self.speeds))

    @property
    def prices(self) -> np.ndarray:
        """Costs (n + 1, n) of control j after control i; the last row is for the first control of a
        path."""
        v, bend = self.speeds, self.curvatures
        reversed_ = v[:, None] * v < 0
        bent = ~np.isclose(bend[:, None], bend, rtol=1e-9, atol=0)
        after = self.costs + self.reversal * reversed_ + self.steering * bent
        return np.vstack([after, self.costs])

    def in_reverse(self) -> Controls:
        """Return the controls whose motions run backwards in time, with the same costs."""
        return replace(
            self, speeds=-self.speeds, turn_rates=-self.turn_rates, sideways=-self.sideways
        )

    def path(self, start: np.ndarray, controls: np.ndarray) -> Path:
        """Make the path of a sequence of control indices (n,), from a pose (3,)."""
        return Path(jnp.asarray(start), jnp.asarray(self.steps[controls].reshape(-1, 3)))

    def turns(self, headings: int) -> np.ndarray:
        """Compute the turns w dt (n,) as integer numbers of heading cells."""
        exact = self.turn_rates * self.dt * headings / (2 * math.pi)
        whole = np.round(exact)
        off = int(np.abs(exact - whole).argmax())
        if abs(exact[off] - whole[off]) > 1e-9:
            raise InputError(
                f"turn_rates[{off}] * dt is {exact[off]:.6g} of {headings} heading cells, expected "
                "an integer; change dt or the number of headings"
            )
        return whole.astype(int)

    def displacements(self, heading: Any, t: Any) -> tuple[np.ndarray, np.ndarray]:
        """Compute the displacements (..., n), m, by all controls from a heading (...), after a time
        t (...)."""
        heading, t = np.broadcast_arrays(heading, t)
        steps = t[..., None, None] / self.dt * self.steps
        return displacements(heading[..., None], steps, np)


def car_controls(radius: float, least: float, backwards: bool) -> Controls:
    """Make the controls of a car: arcs to both sides and straight segments."""
    cell = 2 * math.pi / HEADINGS
    turn = cell * max(1, math.ceil(least / (radius * cell) * (1 - 1e-9)))
    reversal = max(1, round(UNIT * radius / (radius * turn)))
    n = 6 if backwards else 3
    costs = [UNIT + 1, UNIT, UNIT + 1, UNIT + 3, UNIT + 2, UNIT + 3][:n]
    speeds = np.repeat([1.0, -1.0], 3)[:n]
    bend = np.tile([1.0, 0.0, -1.0], 2)[:n] / radius
    return Controls(speeds, speeds * bend, radius * turn, costs, reversal, steering=1)


def differential_controls(radius: float, least: float, backwards: bool) -> Controls:
    """Make the controls of a differential drive: straight segments, and turns on the spot."""
    spin = 2 * 2 * math.pi / HEADINGS / least
    speeds = np.array([1.0, -1.0, 0.0, 0.0])
    chosen = np.array([0, 1, 2, 3] if backwards else [0, 2, 3])
    rates = np.array([0, 0, spin, -spin])[chosen]
    costs = np.array([UNIT, UNIT + 2, 4, 4])[chosen]
    return Controls(speeds[chosen], rates, least, costs, UNIT // 2)


def omnidirectional_controls(radius: float, least: float, backwards: bool) -> Controls:
    """Make the controls of an omnidirectional robot: eight directions, and turns on the spot. Turns
    are by two heading cells."""
    spin = 2 * 2 * math.pi / HEADINGS / least
    course = np.arange(8) * math.pi / 4
    speeds = np.concatenate([np.cos(course), [0.0, 0.0]]).round(15)
    slides = np.concatenate([np.sin(course), [0.0, 0.0]]).round(15)
    rates = np.concatenate([np.zeros(8), [spin, -spin]])
    return Controls(speeds, rates, least, [UNIT] * 8 + [4] * 2, sideways=slides)


@dataclass(frozen=True, eq=False)
class MotionTable:
    """The motions of all controls from the origin, for each of K initial headings."""

    headings: np.ndarray  # (K,), first + 2 pi k / K, rad
    step: np.ndarray  # (2, K, n), displacements, m
    turns: np.ndarray  # (n,), turns in heading cells
    discs: np.ndarray  # (2, K, n, m), centres of the discs at times of the motion, m
    radii: np.ndarray  # (K, n, m), enlarged to cover the footprint between these times, m

    def along(self, start: float, controls: np.ndarray) -> np.ndarray:
        """Compute the headings (n + 1,), rad, along a sequence of control indices (n,)."""
        turned = np.concatenate([[0], np.cumsum(self.turns[controls])])
        return start + turned * (2 * math.pi / len(self.headings))

    @classmethod
    def of(
        cls, controls: Controls, footprint: Footprint, first: float, headings: int, spacing: float
    ) -> MotionTable:
        """Tabulate the motions of controls.

        spacing: the largest distance between two sampled discs, m.
        """
        turns = controls.turns(headings)
        angles = first + 2 * math.pi * np.arange(headings) / headings
        centers, radii = np.asarray(footprint.centers, float), np.asarray(footprint.radii, float)
        # a bound of the path length of a disc: of the origin, plus of the turn about it
        far = np.hypot(*centers.T)
        way = controls.dt * (
            np.hypot(controls.speeds, controls.sideways)[:, None]
            + np.abs(controls.turn_rates)[:, None] * far
        )
        moments = max(1, math.ceil(way.max() / spacing))
        times = controls.dt * (np.arange(moments) + 0.5) / moments
        x, y = controls.displacements(angles[:, None], times[None])  # (K, moments, n)
        turned = angles[:, None, None] + controls.turn_rates * times[:, None]
        c, s = np.cos(turned)[..., None], np.sin(turned)[..., None]
        a, b = centers.T
        discs = np.stack([x[..., None] + c * a - s * b, y[..., None] + s * a + c * b])
        discs = np.moveaxis(discs, 2, 3).reshape(2, headings, len(turns), -1)
        wide = np.tile(radii + way / (2 * moments), (1, moments))  # (n, moments * discs)
        return cls(
            angles,
            np.stack(controls.displacements(angles, controls.dt)),
            turns,
            discs,
            np.broadcast_to(wide, discs.shape[1:]),
        )
