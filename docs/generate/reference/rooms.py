"""The public names of rbjax by room, grouped by subject, in the order of the reference.

A room is a package or module with `__all__`. A name that several rooms export is described in the
outermost one; the others have a link.
"""

from __future__ import annotations

import contextlib
import enum
import importlib
import inspect
import re
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import rbjax
from docs.generate.reference.headings import HEADINGS

#: rooms by subject, in the order of the reference; the top level comes first
SUBJECTS = {
    "Robots": ("loading", "model", "joints", "flexible"),
    "Motion": ("dynamics", "forces", "constraints", "contact", "sensors"),
    "Mathematics": ("rotations", "spatial", "body", "lanes"),
    "Solvers": ("solvers", "stability", "recommend"),
    "Control and learning": ("kinematics", "control", "envs"),
    "Wheels and plans": ("wheeled", "planning"),
    "Estimation": ("estimation", "sysid"),
    "Pictures and checks": ("plotting", "viewer", "validation"),
    "Compilation": ("compiler",),
}
#: rooms that the page of the command line describes
COMMAND_LINE = ("cli", "demo")

#: the top level: subjects and their names
TOP = {
    "Load and write robots": (
        "load", "scenes", "ModelBuilder", "write_mjcf", "write_back",
    ),
    "Model and state": ("Model", "State", "Frame"),
    "Simulate": (
        "step", "rollout", "simulate", "simulate_impacts", "acceleration", "Trajectory",
        "ImpactTrajectory",
    ),
    "Linearise": ("linearise", "Linear"),
    "Dynamics": (
        "forward_dynamics", "inverse_dynamics", "mass_matrix", "inverse_mass_matrix",
        "bias_forces", "gravity_forces", "coriolis_matrix", "forward_dynamics_derivatives",
        "inverse_dynamics_derivatives", "lagrange_coefficients", "inertial_regressor",
        "inertial_parameters",
    ),
    "Kinematics": (
        "forward_kinematics", "Poses", "body_velocities", "frame_pose", "frame_velocity",
        "frame_bias_acceleration", "jacobian", "jacobian_rate", "integrate", "difference",
    ),
    "Energy and momentum": (
        "kinetic_energy", "potential_energy", "center_of_mass", "centroidal_momentum",
    ),
    "Forces, tendons and sensors": (
        "applied_forces", "tendon_lengths", "tendon_jacobian", "sense",
    ),
    "Compile": ("threads", "compile", "compiler_options", "operation_count"),
    "Errors": (
        "RbjaxError", "InputError", "ModelError", "UnknownName", "UnsupportedFeature",
        "MissingPackage",
    ),
}  # fmt: skip

#: modules that come first in a room, in this order; the others follow as `__all__` has them
FIRST = {
    "constraints": (
        "rows.pairs", "rows.couplings", "rows.rolling", "rows.curve", "rows.functions",
        "rows.tendons", "rows.soft", "rows.row", "rows.geometry", "formulation", "methods.method",
        "methods.recursive", "methods.dense", "methods.soft", "methods.differential_algebraic",
        "reactions", "assembly",
    ),
    "contact": ("registry", "soft", "coulomb", "compliant", "impacts", "contact_solution",
                "solution", "geometry"),
    "control": ("optimal.problem", "optimal.solver", "optimal.solution", "optimal.terms",
                "optimal.clearances", "optimal.registry", "optimal.system"),
    "envs": ("registry", "environment", "episode", "task", "transition", "actions"),
    "envs.learning": ("proximal", "short_horizon", "through_time", "training"),
    "dynamics": ("algorithms.kinematics", "algorithms.frames", "algorithms.rnea",
                 "algorithms.crba", "algorithms.aba"),
    "forces": ("element", "joints", "springs", "actuators"),
    "joints": ("registry", "joint", "lower_pairs"),
    "planning": ("planner", "maps", "paths", "search", "timing"),
    "plotting": ("animation", "web_page", "film", "stick_figure", "drawing"),
    "sensors": ("model_sensors", "protocol", "joints", "actuators", "inertial", "frames",
                "bodies", "contacts", "volumes", "rangefinder", "cameras"),
    "solvers": ("registry", "runge_kutta", "rosenbrock", "multistep", "second_order",
                "splitting", "lie", "groups"),
    "stability": ("theory.linear_analysis", "theory.regions", "runs.linearisation"),
    "sysid": ("data", "simulation.setup", "parameters.unknowns", "estimators.identification",
              "estimators.identified", "estimators", "judgement"),
    "wheeled": ("robot.catalogue", "robot", "registry", "models", "motion", "kinematics",
                "tyres"),
}  # fmt: skip


@dataclass(frozen=True)
class Entry:
    """A public name: its path, its value, and whether another room describes it."""

    path: str
    value: Any
    home: str  # path under which the name is described

    @property
    def name(self) -> str:
        return self.path.rpartition(".")[2]

    @property
    def kind(self) -> str:
        if inspect.ismodule(self.value):
            return "module"
        return "object" if is_documented(self.value) else "value"

    @property
    def summary(self) -> str:
        """The first sentence of the docstring."""
        if self.kind == "value":
            return ""
        return first_sentence(inspect.getdoc(self.value) or "")


def is_documented(value: Any) -> bool:
    """Whether a value is a function or a class, whose docstring is its own."""
    return inspect.isclass(value) or inspect.isroutine(value) or hasattr(value, "__wrapped__")


def first_sentence(text: str) -> str:
    paragraph = " ".join(text.strip().split("\n\n")[0].split())
    found = re.match(r"(.*?[.!?])(?:\s+(?:[A-Z`(]|\w+: )|$)", paragraph)
    return (found[1] if found else paragraph).strip()


def names(room: str) -> list[str]:
    """Public names of a room: "" is the top level, "control.optimal" an inner room."""
    return list(package(room).__all__)


def package(room: str) -> Any:
    return importlib.import_module(f"rbjax.{room}" if room else "rbjax")


@cache
def inner_rooms(room: str) -> tuple[str, ...]:
    """Rooms inside a room, at any depth: packages and modules with `__all__`."""
    folder = Path(rbjax.__file__).parent / room.replace(".", "/")
    found = []
    for file in sorted(folder.rglob("*.py")) if room else ():
        below = file.relative_to(folder).with_suffix("").parts
        inner = ".".join((room, *below[: -1 if below[-1] == "__init__" else None]))
        if inner != room and re.search(r"^__all__ = ", file.read_text(), re.MULTILINE):
            found.append(inner)
    return tuple(found)


def outer_rooms() -> list[str]:
    """All rooms at the top, in the order of the reference."""
    return [room for rooms in SUBJECTS.values() for room in rooms]


def all_rooms() -> list[str]:
    """All rooms, the top level first, each before its inner rooms."""
    return ["", *(r for outer in outer_rooms() for r in (outer, *inner_rooms(outer)))]


@cache
def homes() -> dict[int, str]:
    """The path under which each function and class is described, by its id."""
    found: dict[int, str] = {}
    for room in sorted(all_rooms(), key=lambda r: r.count(".") + bool(r)):
        for name in names(room):
            value = getattr(package(room), name)
            path = f"rbjax.{room}.{name}" if room else f"rbjax.{name}"
            if is_documented(value):
                found.setdefault(id(value), path)
    return found | {id(cls): path for paths in results().values() for path, cls in paths.items()}


@cache
def results() -> dict[int, dict[str, type]]:
    """Results without a public name: path -> class, by the id of the first public function that
    returns them, after which they are described."""
    values = [getattr(package(room), name) for room in all_rooms() for name in names(room)]
    public = list({id(x): x for x in values if is_documented(x)}.values())
    seen = {id(x) for x in public}
    found: dict[int, dict[str, type]] = {}
    for value in (x for x in public if not inspect.isclass(x)):
        paths, queue = found.setdefault(id(value), {}), [value]
        while queue:
            for cls in returned(queue.pop(0)):
                if id(cls) not in seen and not cls.__name__.startswith("_"):
                    seen.add(id(cls))
                    paths[f"{cls.__module__}.{cls.__qualname__}"] = cls
                    queue.append(cls)
    return found


def returned(value: Any) -> Iterator[type]:
    """The classes of rbjax that a function returns. Of a class: those of its fields, properties and
    methods that are results, which show themselves, of the same room."""
    if not inspect.isclass(value):
        yield from classes_in(hints(inspect.unwrap(value)).get("return"))
        return
    home = value.__module__.split(".")[:2]
    found = list(hints(value).values())
    for name, member in vars(value).items():
        member = getattr(member, "fget", getattr(member, "func", member))
        if not name.startswith("_") and inspect.isfunction(member):
            found.append(hints(member).get("return"))
    for cls in classes_in(*found):
        shown = hasattr(cls, "_repr_html_") or hasattr(cls, "_fields")
        if cls.__module__.split(".")[:2] == home and shown:
            yield cls


def hints(value: Any) -> dict[str, Any]:
    """Annotations; none if they have names that only type checkers import."""
    with contextlib.suppress(NameError, TypeError):
        return typing.get_type_hints(value)
    return {}


def classes_in(*notes: Any) -> Iterator[type]:
    """The classes of rbjax in annotations, such as X in dict[str, X] and in X | None."""
    for note in notes:
        if inspect.isclass(note) and note.__module__.startswith("rbjax."):
            yield note
        yield from classes_in(*typing.get_args(note))


def entries(room: str) -> list[Entry]:
    """The public names of a room."""
    described = homes()
    prefix = f"rbjax.{room}." if room else "rbjax."
    values = {name: getattr(package(room), name) for name in names(room)}
    return [Entry(prefix + n, x, described.get(id(x), prefix + n)) for n, x in values.items()]


def groups(room: str) -> dict[str, list[Entry]]:
    """The names of a room by heading: the subject of the module that defines them."""
    found = entries(room)
    if not room:
        by_name = {e.name: e for e in found}
        grouped = {head: [by_name.pop(n) for n in chosen] for head, chosen in TOP.items()}
        rest = [e for e in by_name.values() if e.kind != "module"]
        return grouped | ({"Other": rest} if rest else {})
    modules: dict[str, list[Entry]] = {}
    for entry in found:
        if entry.kind == "object":
            modules.setdefault(entry.value.__module__, []).append(entry)
    rank = {name: i for i, name in enumerate(FIRST.get(room, ()))}

    def order(module: str) -> int:
        below = module.removeprefix(f"rbjax.{room}.")
        ranks = [i for name, i in rank.items() if below == name or below.startswith(f"{name}.")]
        return min(ranks, default=len(rank))

    grouped: dict[str, list[Entry]] = {}
    for module in sorted(modules, key=order):
        grouped.setdefault(heading(module), []).extend(modules[module])
    if inner := [e for e in found if e.kind == "module"]:
        grouped["Modules"] = inner
    if values := [e for e in found if e.kind == "value"]:
        grouped["Values"] = values
    return grouped


def heading(module: str) -> str:
    """The subject of a module: the first clause of its docstring."""
    if not module.startswith("rbjax"):
        return "Types"
    if known := HEADINGS.get(module.removeprefix("rbjax.")):
        return known
    sentence = first_sentence(importlib.import_module(module).__doc__ or module)
    sentence = re.sub(r"^`[^`]*`(?: and `[^`]*`)?[:,] ", "", sentence).rstrip(".")
    short = re.split(r"[:;] | \(", sentence)[0]
    if len(short) > 56:
        parts = re.split(r"(?=, | for | by | in | with | from | as a | that | at )", short)
        short = parts[0]
        for part in parts[1:]:
            if len(short + part) > 56 and len(short.split()) > 2:
                break
            short += part
        short = re.sub(r",?(?: (?:or|and|each|made|called|solved|together|the same))*$", "", short)
    return short[0].upper() + short[1:]


def links() -> dict[str, str]:
    """The path under which each public function, class or value is described, by its paths."""
    found = (e for room in all_rooms() for e in entries(room))
    return {e.path: e.home for e in found if e.kind != "module"}


def signatures() -> dict[str, list[tuple[str, str, str | None, str | None]]]:
    """The parameters of the constructors of public classes and of results, by their sources."""
    found = {}
    public = [e.value for room in all_rooms() for e in entries(room)]
    for cls in (*public, *(cls for paths in results().values() for cls in paths.values())):
        if not inspect.isclass(cls) or issubclass(cls, BaseException | enum.Enum):
            continue
        with contextlib.suppress(ValueError, TypeError):
            parameters = inspect.signature(cls).parameters.values()
            found[f"{cls.__module__}.{cls.__qualname__}"] = [_parameter(cls, p) for p in parameters]
    return found


def _parameter(cls: type, p: inspect.Parameter) -> tuple[str, str, str | None, str | None]:
    """Name, kind, annotation and default. A field that is converted has the field's annotation."""
    notes = [inspect.get_annotations(c) for c in cls.__mro__]
    note = next((n[p.name] for n in notes if p.name in n), p.annotation)
    note = note if isinstance(note, str) else getattr(note, "__name__", "")
    default = None if p.default is p.empty else repr(p.default)
    if default is not None and (inspect.isclass(p.default) or inspect.isfunction(p.default)):
        default = p.default.__name__
    elif default is not None and (len(default) > 40 or "<" in default or "Array(" in default):
        default = "..."
    return p.name, p.kind.description, None if note in ("", "_empty") else note, default


def everything() -> set[str]:
    """Paths of all public names, also of those rooms that the command line's page describes."""
    found = {f"rbjax.{name}" for name in rbjax.__all__}
    for room in all_rooms()[1:]:
        found |= {f"rbjax.{room}.{name}" for name in names(room)}
    return found
