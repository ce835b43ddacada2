"""Error against time: Exudyn's planar beams and strain coordinates, in one run.

`python -m benchmarks.flexible.exudyn_comparison [--scenes elastica flying spin_up] [--small]` needs
`pip install exudyn` and writes results/flexible-exudyn-<device>.json. Exudyn's beams are
ObjectBeamGeometricallyExact2D, linear elements, and ObjectANCFCable2D; the cable has neither shear
nor rotary inertia, so the flying beam is not its scene, and a turning clamp of its slope is not
modelled. Exudyn solves "elastica" by its static solver, with the same loads on the way, and motions
by its generalized-alpha method with the same steps. One core; its output is off.
"""

from __future__ import annotations

import benchmarks.shared.one_core  # isort: skip  # noqa: F401

import argparse
import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from benchmarks.flexible.beam_scenes import (
    FLYING_TIMES,
    SPIN_TIMES,
    STEPS,
    Entry,
    Prepared,
    references,
)
from benchmarks.flexible.own_beams import own_beams
from benchmarks.flexible.reference_accuracy import compare, show
from benchmarks.shared.timing import others, save

try:
    import exudyn
    from exudyn import itemInterface as items
except ImportError:
    exudyn = None

NAME = "flexible-exudyn"
SCENES = ("elastica", "flying", "spin_up")
#: EI, EA, GA, mass and rotary inertia per length, length
PROPERTIES = {
    "elastica": (1.0, 1e8, 1e8, 1.0, 0.0, 1.0),
    "flying": (500.0, 1e4, 1e4, 1.0, 10.0, 10.0),
    "spin_up": (1.4e4, 2.8e7, 1e7, 1.2, 6e-4, 10.0),
}


class Beam:
    """A beam of Exudyn in the plane: its system `mbs` and the numbers of its nodes."""

    def __init__(self, scene: str, elements: int, cable: bool):
        EI, EA, GA, rhoA, rhoI, L = PROPERTIES[scene]
        self.system, self.cable = exudyn.SystemContainer(), cable
        mbs = self.mbs = self.system.AddSystem()
        start, angle = (
            (np.array([0.0, 8.0]), -np.arctan2(8, 6)) if scene == "flying" else (0.0, 0.0)
        )
        along, h = np.array([np.cos(angle), np.sin(angle)]), L / elements
        x = start + np.linspace(0, L, elements + 1)[:, None] * along
        if cable:
            make = lambda p: items.NodePoint2DSlope1(referenceCoordinates=[*p, *along])  # noqa: E731
        else:
            make = lambda p: items.NodeRigidBody2D(referenceCoordinates=[*p, angle])  # noqa: E731
        self.nodes = [mbs.AddNode(make(p)) for p in x]
        common = {"length": h, "massPerLength": rhoA, "bendingStiffness": EI, "axialStiffness": EA}
        for pair in zip(self.nodes[:-1], self.nodes[1:], strict=True):
            if cable:
                body = items.ObjectANCFCable2D(nodeNumbers=[*pair], **common)
            else:
                body = items.ObjectBeamGeometricallyExact2D(
                    nodeNumbers=[*pair], crossSectionInertia=rhoI, shearStiffness=GA, **common
                )
            mbs.AddObject(body)

    def clamp(
        self,
        angle: Callable[[float], float] | None = None,
        rate: Callable[[float], float] = lambda t: 0.0,
    ) -> None:
        """Fix the first node; its angle may be a function of time."""
        mbs = self.mbs
        ground = mbs.AddMarker(
            items.MarkerNodeCoordinate(
                nodeNumber=mbs.AddNode(items.NodePointGround()), coordinate=0
            )
        )
        for coordinate in (0, 1, 3 if self.cable else 2):
            marker = mbs.AddMarker(
                items.MarkerNodeCoordinate(nodeNumber=self.nodes[0], coordinate=coordinate)
            )
            driven = {}
            if angle is not None and coordinate == 2:
                driven["offsetUserFunction"] = lambda mbs, t, number, offset: angle(t)
                driven["offsetUserFunction_t"] = lambda mbs, t, number, offset: rate(t)
            mbs.AddObject(items.ObjectConnectorCoordinate(markerNumbers=[ground, marker], **driven))

    def load(
        self, force: list[float], moment: float, share: Callable[[float], float] | None = None
    ) -> None:
        """Load the last node, in a static solution in proportion to its time."""
        mbs, end = self.mbs, self.nodes[-1]
        point = mbs.AddMarker(items.MarkerNodePosition(nodeNumber=end))
        parts: list[Any] = [items.LoadForceVector(markerNumber=point, loadVector=force)]
        if moment:
            rigid = mbs.AddMarker(items.MarkerNodeRigid(nodeNumber=end))
            parts.append(items.LoadTorqueVector(markerNumber=rigid, loadVector=[0, 0, moment]))
        for part in parts:
            if share is not None:
                part.loadVectorUserFunction = lambda mbs, t, v: np.array(v) * share(t)
            mbs.AddLoad(part)

    def watch(self) -> int:
        """Add a sensor of the displacement of the last node."""
        return self.mbs.AddSensor(
            items.SensorNode(
                nodeNumber=self.nodes[-1], storeInternal=True, writeToFile=False,
                outputVariableType=exudyn.OutputVariableType.Displacement,
            )
        )  # fmt: skip

    def settings(self) -> Any:
        """Settings of a solver without output."""
        settings = exudyn.SimulationSettings()
        settings.solutionSettings.writeSolutionToFile = False
        settings.timeIntegration.verboseMode = settings.staticSolver.verboseMode = 0
        settings.parallel.numberOfThreads = 1
        return settings


def spin_angle(t: float) -> float:
    """The clamp's angle, rad."""
    w = 2 * math.pi / 15
    return 0.4 * (t * t / 2 + (math.cos(w * t) - 1) / w**2) if t < 15 else 6 * t - 45


def spin_rate(t: float) -> float:
    """The clamp's angular velocity, rad/s."""
    w = 2 * math.pi / 15
    return 0.4 * (t - math.sin(w * t) / w) if t < 15 else 6.0


def prepare(cable: bool, scene: str, segments: int) -> Prepared | None:
    """A scene with a formulation of Exudyn: its number of coordinates and its solution."""
    if cable and scene != "elastica":
        return None

    def elastica() -> np.ndarray:
        beam = Beam(scene, segments, cable)
        beam.clamp()
        beam.load([0.0, 10.0, 0.0], 0.0)
        beam.mbs.Assemble()
        settings = beam.settings()
        settings.staticSolver.numberOfLoadSteps = 10
        beam.mbs.SolveStatic(settings)
        at = beam.mbs.GetNodeOutput(beam.nodes[-1], exudyn.OutputVariableType.Displacement)
        return np.asarray(at)[:2]

    def motion() -> np.ndarray:
        dt, beam = STEPS[scene](segments), Beam(scene, segments, cable)
        times = FLYING_TIMES if scene == "flying" else SPIN_TIMES
        if scene == "flying":
            # half at the end: its trapezoidal rule then gives the exact impulse
            share = lambda t: 1.0 if t < 2.5 - dt / 4 else 0.5 if t < 2.5 + dt / 4 else 0.0  # noqa: E731
            beam.load([8.0, 0.0, 0.0], -80.0, share)
        else:
            beam.clamp(spin_angle, spin_rate)
        sensor = beam.watch()
        beam.mbs.Assemble()
        settings = beam.settings()
        settings.timeIntegration.endTime = times[-1]
        settings.timeIntegration.numberOfSteps = round(times[-1] / dt)
        settings.solution.sensors.writePeriod = dt
        settings.timeIntegration.generalizedAlpha.spectralRadius = 1 if scene == "flying" else 0.9
        beam.mbs.SolveDynamic(settings)
        stored = beam.mbs.GetSensorStoredData(sensor)
        t, u = stored[:, 0], stored[:, 1:3]  # not on the grid: its solver may shorten steps
        if scene == "spin_up":
            psi, x = np.array([spin_angle(one) for one in t]), u + np.array([10.0, 0.0])
            c, s = np.cos(psi), np.sin(psi)
            u = np.stack([c * x[:, 0] + s * x[:, 1] - 10, c * x[:, 1] - s * x[:, 0]], -1)
        return np.stack([np.interp(times, t, one) for one in u.T], -1)

    each = 4 if cable else 3
    nodes = segments + (scene == "flying")
    return each * nodes, elastica if scene == "elastica" else motion


def exudyn_entries() -> list[Entry]:
    """Exudyn's two planar beams, each as an `Entry`."""
    names = {False: "Exudyn GE beam 2D", True: "Exudyn ANCF cable 2D"}
    return [
        Entry(name, lambda scene, n, cable=cable: prepare(cable, scene, n))
        for cable, name in names.items()
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES)
    parser.add_argument("--small", action="store_true", help="two resolutions, one run")
    parser.add_argument("--references", action="store_true", help="the nodal elements too, minutes")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if exudyn is None:
        raise SystemExit("Exudyn is not installed. Install it by `pip install exudyn`.")
    ours = [one for one in references() if "full" not in one.name and "incr" not in one.name]
    ours = own_beams()[:1] + (ours if given.references else [])
    rows = compare(exudyn_entries() + ours, [*given.scenes], given.small)
    for row in rows:
        row["exudyn"] = exudyn.__version__
    show(rows)
    if not given.small:
        save(NAME, rows + others(NAME, rows, ["scene", "formulation", "segments"]))
