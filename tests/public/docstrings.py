"""What the docstrings of public names contain: `python -m tests.public.docstrings [ROOM]` lists
what is missing."""

from __future__ import annotations

import ast
import dataclasses
import enum
import inspect
import re
import sys
import textwrap
from collections import Counter
from collections.abc import Iterator
from typing import Any

import rbjax as rb
from docs.generate.reference import rooms

#: a shape: (n,), (..., 3), (T, nq), (), (...)
SHAPE = re.compile(
    r"\((\.\.\.)?\)|\((\.\.\.|\*?[\w +*-]{1,12})(, ?[\w +*-]{1,12})*,\)"
    r"|\((\.\.\.|\*?[\w +*-]{1,12})(, ?(\.\.\.|[\w +*-]{1,12}))+\)"
)
UNIT = re.compile(
    r"(?<![\w.])(m|s|kg|N|rad|Hz|J|W|Pa|V|A|K|deg|dof|SI|m/s|rad/s|N m|kg m|1/s|m/rad)(?![\w(])"
    r"|SI units|without unit|dimensionless|radians|metres|seconds|units? of|unit length|unit vector"
    r"|unit quaternion|\bunits?\b"
)
SECTIONS = "Args|Fields|Attributes|Returns|Yields|Raises|Example"
#: classes that functions make: their fields are not for users
MADE = re.compile(r"that `\w+` builds|made by `\w+`|^A policy ")
#: functions whose calls raise `InputError` for bad arguments
CHECKS = re.compile(
    r"^(check|checked|real_|integer$|choice$|instance$|flag$|take[sn]$|shape_of$|known_array$|index_of$)"
)


def public() -> Iterator[tuple[str, Any]]:
    """Names and values of `rb.__all__`, of the rooms' `__all__` and of the modules in it; results
    of public functions."""
    seen: set[int] = set()

    def of(room: Any, prefix: str) -> Iterator[tuple[str, Any]]:
        for name in getattr(room, "__all__", ()):
            x = getattr(room, name)
            if inspect.ismodule(x):
                if prefix.count(".") < 2:
                    yield from of(x, f"{prefix}{name}.")
            elif callable(x) and id(x) not in seen and getattr(x, "__module__", "rb")[:2] == "rb":
                seen.add(id(x))
                yield prefix + name, x

    yield from of(rb, "")
    for paths in rooms.results().values():
        yield from ((path.removeprefix("rbjax."), cls) for path, cls in paths.items())


def raises(x: Any) -> bool:
    """Whether the body of a function raises, or calls a check of its arguments."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(x))))
    except (OSError, TypeError, SyntaxError):
        return False
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and not ast.unparse(node).startswith("raise _"):
            return True
        if isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if CHECKS.match(name):
                return True
    return False


def arrays_in(x: Any) -> bool:
    """Whether an argument or the result of a function is annotated as an array or a state."""
    kinds = [str(v) for v in getattr(x, "__annotations__", {}).values()]
    return any(re.search(r"Array|ndarray|\bState", k) for k in kinds)


def missing(x: Any) -> list[str]:
    """The parts that the docstring of a function or a class lacks."""
    text = inspect.getdoc(x) or ""
    found = [] if re.match(r".+?[.:](\s|$)", text, re.DOTALL) else ["summary"]
    if re.search(rf"\S\n({SECTIONS}):\n", text):  # mkdocstrings reads no section after a full line
        found.append("blank line")
    if inspect.isclass(x):
        small = issubclass(x, enum.Enum | BaseException) or not fields(x) or bool(MADE.search(text))
        names = [*inspect.signature(x).parameters] if "Args:" in text else fields(x)
        if not small and not all(re.search(rf"\b{name}\b", text) for name in names):
            found.append("fields")
        if not small and arrays(x) and not SHAPE.search(text):
            found.append("shapes")
        if not issubclass(x, BaseException) and ">>>" not in text and made_by_users(x):
            found.append("example")
        return found
    try:
        signature = inspect.signature(x)
    except (TypeError, ValueError):
        return found
    named = [
        n for n, p in signature.parameters.items()
        if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL) and not n.startswith("_")
    ]  # fmt: skip
    if not set(named) <= entries(text):
        found.append("args")
    text, example = text.partition("Example:")[::2]
    if arrays_in(x) and not SHAPE.search(text):
        found.append("shapes")
    if arrays_in(x) and not UNIT.search(text):
        found.append("units")
    result = signature.return_annotation
    if result not in (None, "None") and not re.search("Returns?:|Returns? |Yields?", text):
        found.append("returns")
    if raises(x) and "Raises:" not in text:
        found.append("raises")
    if ">>>" not in example and not re.search(r"See `\S+` for an example", text):
        found.append("example")
    return found


def entries(text: str) -> set[str]:
    """The names of the entries of the section Args: `name: meaning` or `one, two: meaning`."""
    section = re.search(r"^Args:\n((?:    .*\n?|\n)*)", text, re.MULTILINE)
    heads = re.findall(r"^    ([\w*, ]+):", section[1], re.MULTILINE) if section else []
    return {name.strip("* ") for head in heads for name in head.split(",")}


def fields(cls: type) -> list[str]:
    """The public fields of a named tuple or a dataclass, its own ones."""
    names = getattr(cls, "_fields", None) if issubclass(cls, tuple) else None
    if names is None and dataclasses.is_dataclass(cls):
        own = vars(cls).get("__annotations__", {})
        names = [f.name for f in dataclasses.fields(cls) if f.name in own and f.repr]
    return [n for n in names or () if not n.startswith("_")]


def arrays(cls: type) -> bool:
    """Whether a class has a field of arrays."""
    kinds = vars(cls).get("__annotations__", {})
    return any("Array" in str(k) or "ndarray" in str(k) for k in kinds.values())


def made_by_users(cls: type) -> bool:
    """Whether users make objects of a class: not a result, of which functions have the example."""
    return not issubclass(cls, tuple) and "Args:" in (inspect.getdoc(cls) or "")


def main() -> None:
    room = sys.argv[1] if len(sys.argv) > 1 else ""
    rows = {name: missing(x) for name, x in public()}
    for name, parts in rows.items():
        if parts and name.startswith(room) and room:
            print(f"{name}: {', '.join(parts)}")
    good = sum(not parts for parts in rows.values())
    print(f"{good} of {len(rows)} docstrings are complete, {good / len(rows):.1%}")
    print(dict(Counter(part for parts in rows.values() for part in parts)))
    rooms = Counter(n.rpartition(".")[0].partition(".")[0] for n, parts in rows.items() if parts)
    print(dict(rooms.most_common()))


if __name__ == "__main__":
    main()
