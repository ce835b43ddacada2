"""The reference: a page for each room, whose entries mkdocstrings fills from the docstrings."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

from docs.generate import tree
from docs.generate.markdown.plain_text import escaped
from docs.generate.reference import rooms

#: pages in addition to the rooms
EXTRA = [
    "- [Registries](registries/index.md): joints, forces, contact laws, constraints, solvers, "
    "sensors, wheels, beams, tasks, methods",
    "- [Command line](command_line.md): `rbjax` and its commands",
    "- [Features](features.md): what works, by subject",
    "- [Robot files](files.md): what of MJCF and URDF is supported",
    "- [Errors](errors.md): exceptions, and failure inside compiled code",
    "",
]


def pages(root: Path) -> tree.Pages:
    """A page for the top level and for each room, and the index of rooms."""
    found: tree.Pages = {"reference/rbjax.md": page("")}
    for room in rooms.all_rooms()[1:]:
        found[path(room)] = page(room)
    found["reference/names.md"] = all_names()
    found["reference/index.md"] = index()
    return found


def path(room: str) -> str:
    """The page of a room, below docs/; a room with inner rooms is a folder."""
    if not room:
        return "reference/rbjax.md"
    base = "reference/" + room.replace(".", "/")
    return f"{base}/index.md" if rooms.inner_rooms(room) else f"{base}.md"


def short(full: str) -> str:
    """A path as a user writes it: rb.control.solve."""
    return re.sub(r"^rbjax\b", "rb", full)


def page(room: str) -> str:
    """The page of a room: its groups of names, each with a table and the entries."""
    package = rooms.package(room)
    title = short(f"rbjax.{room}" if room else "rbjax")
    doc = inspect.getdoc(package) or ""
    lines = [f"# {title}", "", intro(doc, room), ""]
    if inner := rooms.inner_rooms(room):
        lines += ["Modules inside: " + ", ".join(inner_link(room, r) for r in inner) + ".", ""]
    used = {title}
    for head, found in rooms.groups(room).items():
        lines += [f"## {head}", ""] if head not in used else []
        lines += [*table(found), ""]
        for entry in found:
            lines += [*described(entry, room), ""]
    return "\n".join(lines)


def intro(doc: str, room: str) -> str:
    """The paragraphs of the docstring of a room, without its lists of files."""
    if not room:
        return (
            "The functions and classes of the top level, by subject. "
            "`import rbjax as rb` gives them and the modules, which are imported on first use."
        )
    kept = []
    for paragraph in doc.split("\n\n"):
        if re.match(r"(Files|Subpackages|Modules|Rooms)\b|[-*] |\s|[\w/.]+ {2,}", paragraph):
            break
        kept.append(escaped(paragraph))
    return "\n\n".join(kept)


def inner_link(room: str, inner: str) -> str:
    link = Path(path(inner)).relative_to(Path(path(room)).parent).as_posix()
    return f"[`{short('rbjax.' + inner)}`]({link})"


def table(found: list[rooms.Entry]) -> list[str]:
    """Names with the first sentence of their docstrings."""
    rows = [f"| [`{e.name}`][{e.home}] | {cell(e)} |" for e in found if e.kind == "object"]
    return ["| name | |", "|---|---|", *rows] if rows else []


def cell(entry: rooms.Entry) -> str:
    return escaped(entry.summary).replace("|", "\\|")


def described(entry: rooms.Entry, room: str) -> list[str]:
    """The entry of a name: mkdocstrings' for a function or class, else its value."""
    if entry.kind == "module":
        return module_entry(entry, room)
    if entry.kind == "value":
        text = repr(entry.value)
        text = text if len(text) <= 400 and " at 0x" not in text else value_names(entry.value)
        return [f"### {entry.name} {{#{entry.path}}}", "", "```python", text, "```"]
    if entry.home != entry.path:
        return []
    lines = [f"::: {entry.path}", "    options:", f"      heading: {entry.name}"]
    for path, cls in rooms.results().get(id(entry.value), {}).items():
        lines += ["", f"::: {path}", "    options:", f"      heading: {cls.__name__}",
                  "      heading_level: 4"]  # fmt: skip
    return lines


def value_names(value: object) -> str:
    """A long value in short: the names of a dictionary, or the type."""
    if isinstance(value, dict):
        return "\n".join(map(repr, value))
    return type(value).__name__


def module_entry(entry: rooms.Entry, room: str) -> list[str]:
    """A module inside a room: a link to its page, or its functions."""
    name = entry.path.removeprefix("rbjax.")
    if hasattr(entry.value, "__all__"):
        return [f"- {inner_link(room, name)}: {rooms.first_sentence(entry.value.__doc__ or '')}"]
    return [
        f"### {short(entry.path)} {{#{entry.path}}}", "",
        f"::: {entry.value.__name__}", "    options:", "      show_root_heading: false",
        "      show_root_toc_entry: false", "      heading_level: 3",
    ]  # fmt: skip


def index() -> str:
    """The rooms by subject. Their order here is their order in the site."""
    lines = [
        "# Reference", "",
        "Every public name by module, from its docstring; the registries; the command line; "
        "errors; the features of robot files.", "",
        "- [Top level](rbjax.md): load, simulate, dynamics, kinematics, compile",
    ]  # fmt: skip
    for subject, found in rooms.SUBJECTS.items():
        lines += ["", f"## {subject}", ""]
        for room in found:
            doc = escaped(rooms.first_sentence(inspect.getdoc(rooms.package(room)) or ""))
            lines.append(f"- [`rb.{room}`]({path(room).removeprefix('reference/')}): {doc}")
    lines += ["", "## Lists", "", "- [All names](names.md)"]
    return "\n".join(lines + EXTRA)


def all_names() -> str:
    """The list of all public names, with links."""
    lines = ["# All names", "", "Every public name, by room.", ""]
    for room in rooms.all_rooms():
        title = short(f"rbjax.{room}" if room else "rbjax")
        lines += [f"## {title} {{#names-{room.replace('.', '-') or 'rbjax'}}}", ""]
        links = []
        for e in sorted(rooms.entries(room), key=lambda e: e.name.lower()):
            if e.kind == "module" and hasattr(e.value, "__all__"):
                target = path(e.value.__name__.removeprefix("rbjax.")).removeprefix("reference/")
                links.append(f"[`{e.name}`]({target})")
            else:
                links.append(f"[`{e.name}`][{e.home}]")
        lines += [" ".join(links), ""]
    return "\n".join(lines)
