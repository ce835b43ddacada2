"""The registries of rbjax as tables, read from the code."""

from __future__ import annotations

import functools
import importlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rbjax as rb
from docs.generate import tree
from docs.generate.markdown.plain_text import escaped
from docs.generate.markdown.table import table
from docs.generate.reference import rooms
from rbjax.motion.integrators import INTEGRATORS, TABLEAUS


def pages(root: Path) -> tree.Pages:
    """A page for each registry, and their index."""
    found: tree.Pages = {f"reference/registries/{name}.md": make() for name, make in MADE.items()}
    lines = ["# Registries", "", "What a name in an argument may be, read from the code.", ""]
    for name, make in MADE.items():
        lines.append(f"- [{title(make())}]({name}.md): {sentence(make)}")
    found["reference/registries/index.md"] = "\n".join([*lines, ""])
    return found


def title(text: str) -> str:
    return text.split("\n", 1)[0].removeprefix("# ")


def function(value: Any) -> Any:
    """The function in partials and in wrappers of partials."""
    while isinstance(value, functools.partial) or isinstance(
        getattr(value, "__wrapped__", None), functools.partial
    ):
        value = value.func if isinstance(value, functools.partial) else value.__wrapped__
    return value


def sentence(value: Any) -> str:
    """The first sentence of the docstring of a function, a class, or the class of an object."""
    value = function(value)
    if not (inspect.isclass(value) or inspect.isroutine(value)):
        value = type(value)
    return escaped(rooms.first_sentence(inspect.getdoc(value) or "")).rstrip(":")


def linked(value: Any) -> str:
    """The name of a function or class, with a link if the reference has it."""
    value = function(value)
    if not (inspect.isclass(value) or inspect.isroutine(value)):
        value = type(value)
    home = rooms.homes().get(id(value))
    name = f"`{value.__name__}`"
    return f"[{name}][{home}]" if home else name


def page(head: str, text: str, *parts: str | list[str]) -> str:
    lines = [f"# {head}", "", text, ""]
    for part in parts:
        lines += [part] if isinstance(part, str) else part
    return "\n".join(lines)


def yes(flag: Any) -> str:
    return "yes" if flag else ""


def joints() -> str:
    """Kinds of joints, with the sizes of their coordinates."""
    rows = []
    importlib.import_module("rbjax.flexible.reference")  # which registers two kinds
    for name, kind in rb.joints.kinds().items():
        rows.append((f"`{name}`", str(kind.nq), str(kind.nv), sentence(kind)))
    return page(
        "Kinds of joints",
        "The joints of `rb.joints.kinds`. MJCF files have hinge, slide, ball and free joints; "
        "`model.with_joint` adds any kind, and `rb.joints.register` a kind of your own.",
        table(("kind", "nq", "nv", ""), rows),
    )


def forces() -> str:
    """Force elements, and the actuators and tyres that are elements."""
    found = [
        (rb.forces, "rb.forces"), (rb.contact, "rb.contact"), (rb.flexible, "rb.flexible"),
        (rb.flexible.modal, "rb.flexible.modal"), (rb.wheeled, "rb.wheeled"),
    ]  # fmt: skip
    rows = []
    for room, name in found:
        for cls in classes(room):
            if issubclass(cls, rb.forces.Element) and cls is not rb.forces.Element:
                rows.append((linked(cls), f"`{name}`", sentence(cls)))
    return page(
        "Force elements",
        "The elements that `model.with_forces` adds to a robot. To add a force of your own, write "
        "a class with one method: [a force element](../../develop/extending.md).",
        table(("element", "room", ""), rows),
    )


def classes(room: Any) -> list[type]:
    values = (getattr(room, name) for name in room.__all__)
    return [value for value in values if inspect.isclass(value)]


def contact_laws() -> str:
    """Laws of contact, and the pairs of shapes that may touch."""
    laws = [(f"`{name}`", law_class(name)) for name in rb.contact.laws()]
    pairs = [(f"`{a}`", f"`{b}`") for a, b in sorted(rb.contact.pairs())]
    return page(
        "Contact laws",
        "The values of `contact=` in `rb.step` and `rb.rollout`, and the pairs of geoms whose "
        "contacts are found. [Contacts](../../guides/contacts.md) compares the laws.",
        table(("name", "law"), laws),
        ["`rb.contact.CompliantContact` is a force element instead, and needs no name.", ""],
        ["## Pairs of geoms", ""],
        table(("geom", "geom"), pairs),
    )


def law_class(name: str) -> str:
    known = {
        "mujoco": rb.contact.SoftContact,
        "coulomb": rb.contact.CoulombContact,
        "impulse": rb.contact.MoreauContact,
    }
    return f"{linked(known[name])}: {sentence(known[name])}"


def constraints() -> str:
    """Kinds of constraints, with the number of their rows."""
    rows = []
    for cls in rb.constraints.kinds().values():
        size = getattr(cls, "size", None)
        rows.append((linked(cls), str(size) if isinstance(size, int) else "", sentence(cls)))
    return page(
        "Kinds of constraints",
        "The constraints of `rb.constraints.kinds`, which `model.with_constraints` adds to a "
        "robot. An empty number of rows depends on the arguments.",
        table(("constraint", "rows", ""), rows),
    )


def formulations() -> str:
    """Formulations of constrained motion: how constraints are enforced."""
    rows = []
    for name, found in rb.constraints.formulations().items():
        feedback = linked(found.feedback) if found.feedback is not None else ""
        projection = linked(found.projection) if found.projection is not None else ""
        rows.append(
            (f"`{name}`", linked(found.method), feedback, projection, sentence(found.method))
        )
    return page(
        "Formulations of constraints",
        "The values of `constraints=` in `rb.rollout`, `rb.simulate` and `rb.step`. "
        "[Formulations](../../guides/formulations.md) compares them; "
        "`rb.recommend.formulation` chooses one.",
        table(("name", "method", "feedback", "projection", ""), rows),
    )


def integrators() -> str:
    """Methods of fixed steps of `rollout`."""
    rows = []
    for name, method in INTEGRATORS.items():
        order = str(TABLEAUS[name].order) if name in TABLEAUS else ""
        rows.append((f"`{name}`", order, sentence(method)))
    return page(
        "Integrators of rollout",
        "The values of `integrator=` in `rb.rollout` and `rb.step`, with fixed steps. "
        "`rb.rollout` says when to use which.",
        table(("name", "order", ""), rows),
    )


def solvers() -> str:
    """Solvers of differential equations for `simulate`, to choose by order, kind and stiffness."""
    rows = []
    for name, entry in rb.solvers.all().items():
        flags = (yes(entry.implicit), yes(entry.adaptive))
        rows.append((f"`{name}`", linked(entry.make), str(entry.order), entry.kind, *flags))
    return page(
        "Solvers of simulate",
        "The solvers of `rb.solvers.all`, for `solver=` of `rb.simulate`, as in "
        "`solver=rb.solvers.all()['radau_iia3'].make()`. `rb.recommend.solver` chooses one for a "
        "robot by measurement. Implicit solvers are for stiff motions. `rb.simulate` takes any "
        "other solver of diffrax, too.",
        table(("name", "made by", "order", "kind", "implicit", "adaptive"), rows),
    )


def sensors() -> str:
    """Kinds of sensors."""
    rows = []
    for name, kind in rb.sensors.kinds().items():
        rows.append((f"`{name}`", linked(kind.sensor), sentence(kind.sensor)))
    return page(
        "Kinds of sensors",
        "The kinds of `rb.sensors.kinds`: names in a `Setup.with_sensors` of `rb.sysid`, and the "
        "sensors of an MJCF file, which `rb.sense` reads.",
        table(("kind", "sensor", ""), rows),
    )


def wheels() -> str:
    """Wheeled robots, their fidelities and tyre laws."""
    kinds = [(f"`{n}`", sentence(k.make)) for n, k in rb.wheeled.kinds().items()]
    levels = [(f"`{n}`", linked(c), sentence(c)) for n, c in rb.wheeled.fidelities().items()]
    base = rb.wheeled.Tyre
    found = [c for c in classes(rb.wheeled) if issubclass(c, base) and c is not base]
    tyres = [(linked(c), sentence(c)) for c in found]
    return page(
        "Wheeled robots and tyres",
        "The robots of `rb.wheeled.kinds`, the fidelities of `rb.wheeled.at`, and the tyre laws.",
        ["## Robots", ""],
        table(("kind", ""), kinds),
        ["## Fidelities", ""],
        table(("fidelity", "class", ""), levels),
        ["## Tyre laws", ""],
        table(("tyre", ""), tyres),
    )


def beams() -> str:
    """Beams, cross-sections, and the elements of the literature with which they are compared."""
    sections = [rb.flexible.circle, rb.flexible.tube, rb.flexible.rectangle, rb.flexible.ellipse,
                rb.flexible.section]  # fmt: skip
    strains = [(f"`{s}`", STRAINS[s]) for s in rb.flexible.strain.STRAINS]
    reference = [(linked(c), sentence(c)) for c in classes(rb.flexible.reference)]
    bodies = (getattr(rb.flexible.modal, name) for name in rb.flexible.modal.__all__)
    modal = [(linked(x), sentence(x)) for x in bodies if callable(x)]
    return page(
        "Beams and elastic bodies",
        "`model.with_beam` adds a `rb.flexible.Beam`; `rb.flexible.modal` adds bodies by modes.",
        ["## Cross-sections", ""],
        table(("section", ""), [(linked(f), sentence(f)) for f in sections]),
        ["## Strains", "", "A beam has polynomials of some of these along its length.", ""],
        table(("strain", ""), strains),
        ["## Elastic bodies by modes", ""],
        table(("name", ""), modal),
        ["## Elements of the literature", "", "For comparison, not as links of a robot.", ""],
        table(("class", ""), reference),
    )


STRAINS = {
    "k_x": "twist about the axis of the beam, rad/m",
    "k_y": "curvature about y of the section, rad/m",
    "k_z": "curvature about z of the section, rad/m",
    "e_x": "extension",
    "g_y": "shear along y",
    "g_z": "shear along z",
}


def tasks() -> str:
    """Tasks of environments."""
    rows = [(f"`{name}`", sentence(make)) for name, make in rb.envs.tasks().items()]
    return page(
        "Tasks",
        "The names of `rb.envs.tasks`, for `rb.envs.make`, `rbjax train` and `rbjax play`. "
        "[Environments](../../guides/environments.md) tells how to write a task.",
        table(("task", ""), rows),
    )


def control_methods() -> str:
    """Methods of optimal control."""
    rows = []
    for name, m in rb.control.methods().items():
        flags = (yes(m.constraints), yes(m.differentiable))
        rows.append((f"`{name}`", *flags, escaped(m.description)))
    return page(
        "Methods of optimal control",
        "The values of `method=` in `rb.control.solve`. `rb.recommend.control_method` compares "
        "them on a problem.",
        table(("method", "constraints", "differentiable", ""), rows),
    )


def identification() -> str:
    """Estimators of parameters from recordings."""
    found = [
        rb.sysid.identify, rb.sysid.many_starts, rb.sysid.prediction_error, rb.sysid.squares,
        rb.sysid.torque.regress, rb.sysid.torque.consistent, rb.sysid.torque.regress_with_zeros,
        rb.estimation.kalman_filter, rb.estimation.kalman_smoother,
    ]  # fmt: skip
    rows = [(linked(f), sentence(f)) for f in found]
    weights = [(f"`{n}`", sentence(f)) for n, f in rb.sysid.torque.regression.METHODS.items()]
    terms = [(f"`{n}`",) for n in rb.sysid.torque.JOINT_TERMS]
    return page(
        "Methods of identification",
        "Estimators of the parameters of a robot, by simulated motion, by torques, with noise.",
        table(("function", ""), rows),
        ["## Least squares of torques", "", "`method=` of `rb.sysid.torque.regress`.", ""],
        table(("method", ""), weights),
        ["## Terms of a joint", "", "Friction and armature that the regressor of torques has.", ""],
        table(("term",), terms),
    )


def attitudes() -> str:
    """Representations of attitude, and formulations of one body's motion."""
    rows = [(f"`{name}`", str(r.size)) for name, r in rb.rotations.representations().items()]
    bodies = [(f"`{n}`", linked(f), sentence(f)) for n, f in rb.body.formulations().items()]
    return page(
        "Attitudes and formulations of one body",
        "The names of `rb.rotations.representations` and `rb.body.formulations`.",
        ["## Representations of attitude", ""],
        table(("name", "numbers"), rows),
        ["## Formulations of one body's motion", ""],
        table(("name", "class", ""), bodies),
    )


def planning() -> str:
    """Methods of planning in the plane, and drives."""
    rows = [(linked(f), sentence(f)) for f in rb.planning.methods().values()]
    drives = [(f"`{n}`", linked(f), sentence(f)) for n, f in rb.planning.drives().items()]
    return page(
        "Methods of planning",
        "The values of `method=` in `rb.planning.plan`, and the sets of controls of its drives.",
        table(("method", ""), rows),
        ["## Drives", ""],
        table(("drive", "function", ""), drives),
    )


def scenes() -> str:
    """Bundled robots that `load` knows by name."""
    rows = []
    for name in rb.scenes():
        model = rb.load(name)
        rows.append((f"`{name}`", str(model.nq), str(model.nv), str(model.nu)))
    return page(
        "Bundled scenes",
        "The names of `rb.scenes`, which `rb.load` takes in place of a path.",
        table(("scene", "nq", "nv", "nu"), rows),
    )


MADE: dict[str, Callable[[], str]] = {
    "joints": joints,
    "forces": forces,
    "contact_laws": contact_laws,
    "constraints": constraints,
    "formulations": formulations,
    "integrators": integrators,
    "solvers": solvers,
    "sensors": sensors,
    "wheels": wheels,
    "beams": beams,
    "tasks": tasks,
    "control_methods": control_methods,
    "identification": identification,
    "attitudes": attitudes,
    "planning": planning,
    "scenes": scenes,
}
