"""An extension of griffe: docstrings as Markdown, and signatures of classes from the runtime.

griffe reads sources and does not import them: it does not see the constructor that equinox makes
from the fields of a class.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from griffe import Class, Extension, Function, Parameter, ParameterKind, Parameters

from docs.generate.markdown.plain_text import markdown, with_fields

#: written by `python -m docs.generate`: a name as text, and the path under which it is described
LINKS = Path(__file__).parents[3] / ".cache" / "links.json"
#: the same for the parameters of classes, each (name, kind, annotation, default)
SIGNATURES = LINKS.with_name("signatures.json")


class Docstrings(Extension):
    """Changes each object when griffe has read it."""

    def __init__(self) -> None:
        self.links = json.loads(LINKS.read_text()) if LINKS.exists() else {}
        self.signatures = json.loads(SIGNATURES.read_text()) if SIGNATURES.exists() else {}

    def on_object(self, *, obj: Any, **rest: Any) -> None:
        if obj.is_alias:
            return
        if obj.docstring is not None and isinstance(obj, Class):
            obj.docstring.value = with_fields(obj.docstring.value, obj.members)
        if obj.docstring is not None:
            obj.docstring.value = markdown(obj.docstring.value, self.links)
        found = self.signatures.get(obj.path)
        if isinstance(obj, Class) and "__init__" not in obj.members and found is not None:
            obj.set_member("__init__", constructor(found))


def constructor(found: list[list[str | None]]) -> Function:
    """A constructor without a docstring of its own."""
    parameters = [
        Parameter(name, kind=ParameterKind(kind), annotation=annotation, default=default)
        for name, kind, annotation, default in found
    ]
    itself = Parameter("self", kind=ParameterKind.positional_or_keyword)
    return Function("__init__", parameters=Parameters(itself, *parameters))
