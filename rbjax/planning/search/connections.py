"""Ends of a search: lower bounds of the price to the target, and the last motions.

`GoalSet` ends the search at any pose near the target. `DirectMotion` adds a motion that ignores
obstacles and ends exactly at the target:

    a car                    the Reeds-Shepp curve; the Dubins curve, if it drives in one gear
    a robot that can turn    turn towards the goal, drive, turn: forwards or backwards
    on the spot
    a robot that can slide   turn, slide

The price of a motion, in the unit of `Controls`, counts lengths and angles at the rate of the
cheapest control of that kind, and changes of gear and of curvature. The shortest motion at the
cheapest rate, without these changes, is an admissible lower bound of the price.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiling import compiled, wide_vectors
from rbjax.errors import InputError
from rbjax.planning.paths import words
from rbjax.planning.paths.curves import shortest
from rbjax.planning.search.controls import Controls

CHUNK = 64  # poses in one call of the compiled program


def _car_curves(gears: int, start: jax.Array, goal: jax.Array, radius: jax.Array) -> jax.Array:
    """Compute the steps (..., 5, 3) of the shortest curves.

    gears: 0 for both directions, 1 for forwards only, -1 for backwards only.
    """
    if gears == 0:
        return shortest(words.REEDS_SHEPP, words.either_way, start, goal, radius).steps
    ends = (start, goal) if gears > 0 else (goal, start)
    steps = shortest(words.DUBINS, words.forwards, *ends, radius).steps
    return steps if gears > 0 else -jnp.flip(steps, -2)


_compiled_curves = compiled(_car_curves, options=wide_vectors, static_argnums=0)


def price_per_metre(where: str, controls: Controls) -> float:
    """Compute the least cost per metre of the controls that drive."""
    way = np.hypot(controls.speeds, controls.sideways) * controls.dt
    if not way.any():
        raise InputError(f"{where}: these controls cannot drive; add one that can")
    return float((controls.costs[way > 0] / way[way > 0]).min())


class GoalSet:
    """Goal set: poses within a distance in m and an angle in rad from the target."""

    def __init__(self, where: str, controls: Controls, tolerance: tuple[float, float]):
        self.near, self.turn = tolerance
        self.rate = price_per_metre(where, controls)

    def __call__(
        self, poses: np.ndarray, goal: np.ndarray, after: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Test which poses (m, 3) are in the goal set. Return bounds, connections and costs like
        `DirectMotion`.

        Lower bounds are 0 (m,) and connections are empty (m, 0, 3). Costs (m,) are 0 in the goal
        set, else inf.
        """
        off = poses - goal
        there = np.hypot(off[:, 0], off[:, 1]) <= self.near
        there &= np.abs(_reduced(off[:, 2])) <= self.turn
        m = len(poses)
        return np.zeros(m), np.zeros((m, 0, 3)), np.where(there, 0.0, np.inf)


class DirectMotion:
    """Motions of a robot to a target that ignore obstacles."""

    near = 0.0

    def __init__(self, where: str, controls: Controls):
        self.controls, steps = controls, controls.steps
        drives, slides, turns = (np.abs(steps[:, i]) > 0 for i in range(3))
        self.spot = turns & ~drives & ~slides
        self.kind = "omni" if slides.any() else "spot" if self.spot.any() else "car"
        way = np.hypot(steps[:, 0], steps[:, 1])
        self.rate = price_per_metre(where, controls)
        if not turns.any():
            raise InputError(f"{where}: these controls cannot turn; add one that can")
        self.turning = float((controls.costs[turns] / np.abs(steps[turns, 2])).min())
        self.separate = not (turns & (way > 0)).any()  # no control does both
        self.radius = self._radius(where) if self.kind == "car" else 0.0
        gears = set(np.sign(steps[drives, 0]))
        self.gears = 0 if len(gears) == 2 else int(gears.pop()) if gears else 0
        self.rates = self._rates()

    def _radius(self, where: str) -> float:
        bend = self.controls.curvatures
        tight = [bend.max(), -bend.min()]
        if not math.isclose(*tight, rel_tol=1e-9):
            raise InputError(
                f"{where}: the tightest curvatures are {tight[0]:.6g} /m to the left and "
                f"{tight[1]:.6g} /m to the right, expected equal ones"
            )
        return 1 / tight[0]

    def _rates(self) -> np.ndarray:
        """Compute the least cost per metre (3, 3) by sign of the speed and sign of the curvature.

        It is infinite if no control has these signs.
        """
        rates = np.full((3, 3), np.inf)
        for step, cost in zip(self.controls.steps, self.controls.costs, strict=True):
            way = math.hypot(step[0], step[1])
            if way:
                at = int(np.sign(step[0])), int(np.sign(step[0] * step[2]))
                rates[at] = min(rates[at], cost / way)
        return rates

    def __call__(
        self, poses: np.ndarray, goal: np.ndarray, after: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute connections from poses (m, 3) to a goal, after controls (m,).

        Returns:
            Lower bounds (m,) of the price to the goal, connections (m, 5, 3), and their prices
            (m,).
        """
        bound, steps = self.connections(poses, goal)
        return bound, steps, self.price(steps, after)

    def connections(self, poses: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute lower bounds (m,) and connections (m, 5, 3) from poses (m, 3) to a goal."""
        if self.kind == "car":
            steps = self._curves(poses, goal)
            return self.rate * np.abs(steps[..., 0]).sum(1), steps
        dx, dy = goal[0] - poses[:, 0], goal[1] - poses[:, 1]
        far, turn = np.hypot(dx, dy), _reduced(goal[2] - poses[:, 2])
        drive, spin = self.rate * far, self.turning * np.abs(turn)
        bound = drive + spin if self.separate else np.maximum(drive, spin)
        return bound, self._straight(poses, far, np.arctan2(dy, dx), turn)

    def price(self, steps: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Compute the prices (m,) of connections (m, n, 3) after controls (m,), -1 for no
        control."""
        way, turn = np.hypot(steps[..., 0], steps[..., 1]), steps[..., 2]
        drives = way > 1e-12 * (1 + way.max(initial=0.0))
        there = drives | (np.abs(turn) > 1e-12)
        ahead = np.where(drives, steps[..., 0], 0.0)
        gear = np.sign(ahead).astype(int)
        bend = turn * drives * gear / np.where(gear == 0, 1.0, np.abs(ahead))
        rates = self._rate(gear, np.where(np.abs(bend) > 1e-9, np.sign(bend), 0).astype(int))
        each = np.where(drives, np.where(drives, rates, 0) * way, self.turning * np.abs(turn))
        total = np.where(there, each, 0.0).sum(1)
        known = after >= 0
        last = np.where(known, np.sign(self.controls.speeds[after]), 0)
        bent = np.where(known, self.controls.curvatures[after], np.nan)
        for i in range(steps.shape[1]):
            on = there[:, i]
            total += on * self.controls.reversal * (last * gear[:, i] < 0)
            differs = ~np.isclose(bent, bend[:, i], rtol=1e-9, atol=1e-12) & ~np.isnan(bent)
            total += on * self.controls.steering * differs
            last, bent = np.where(on, gear[:, i], last), np.where(on, bend[:, i], bent)
        return total

    def _rate(self, gear: np.ndarray, bend: np.ndarray) -> np.ndarray:
        return np.full(gear.shape, self.rate) if self.kind == "omni" else self.rates[gear, bend]

    def _curves(self, poses: np.ndarray, goal: np.ndarray) -> np.ndarray:
        m = len(poses)
        padded = np.resize(poses, (-(-m // CHUNK) * CHUNK, 3)).reshape(-1, CHUNK, 3)
        with jax.enable_x64(True):  # exact ends in any precision of the caller
            rest = jnp.asarray(goal, float), jnp.asarray(self.radius, float)
            parts = [_compiled_curves(self.gears, jnp.asarray(p), *rest) for p in padded]
        return np.concatenate([np.asarray(x) for x in parts])[:m]

    def _straight(
        self, poses: np.ndarray, far: np.ndarray, course: np.ndarray, turn: np.ndarray
    ) -> np.ndarray:
        steps = np.zeros((len(poses), 5, 3))
        if self.kind == "omni":
            steps[:, 0, 2] = turn
            angle = course - (poses[:, 2] + turn)
            steps[:, 1, 0], steps[:, 1, 1] = far * np.cos(angle), far * np.sin(angle)
            return steps
        ahead = _reduced(course - poses[:, 2])
        back = _reduced(ahead + math.pi)
        # in the gear that needs less turning, if the robot has both gears
        rest = [np.abs(a) + np.abs(_reduced(turn - a)) for a in (ahead, back)]
        reverse = (rest[1] < rest[0]) if self.gears == 0 else np.full(len(far), self.gears < 0)
        first = np.where(far == 0, 0.0, np.where(reverse, back, ahead))
        steps[:, 0, 2], steps[:, 2, 2] = first, _reduced(turn - first)
        steps[:, 1, 0] = np.where(reverse, -far, far)
        return steps


def _reduced(angle: np.ndarray) -> np.ndarray:
    """Wrap an angle to [-pi, pi]."""
    return words.either_way(angle, np)
