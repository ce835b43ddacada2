"""User functions as pytrees, so that equal code with other numbers is compiled once.

    for k in gains:
        rollout(model, state, lambda t, s: -k * s.v, dt, steps=n)

creates a new function each time. `jit` compares functions by identity, so it would compile each.
This module makes a function a pytree. Its leaves are the numbers that it reads. Its static part is
a `Recipe`; two functions that differ only in numbers have equal recipes.

If a function needs the value of a number (`if k > 0`), its floats become part of the recipe, and if
necessary its arrays too. A function that cannot be read (a generator, code with side effects) is
compared by identity, as in `jit`. A user's function that reads values without naming them
(`globals()`, a file) is compiled at each call, with a warning.

`equinox.filter_closure_convert` and `jax.closure_convert` trace a function to find its arrays.
`equinox.internal.closure_to_pytree` reads only cells.
"""

from __future__ import annotations

import functools
import warnings
import weakref
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax

from rbjax.compiling import inside_jit
from rbjax.constraints.formulation import Formulation
from rbjax.contact.soft import SoftContact
from rbjax.motion.closures.reading import (
    FLOATS,
    TRACERS,
    HiddenError,
    Reader,
    Same,
    UnreadableError,
)

T = TypeVar("T")

OPAQUE = TRACERS + 1
#: code site -> level at which to read code that does not run with its floats as operands
_levels: weakref.WeakKeyDictionary[Any, int] = weakref.WeakKeyDictionary()


class UnfitError(Exception):
    """Raised if a function cannot run with the operands that were read. `level` is the next level
    to try: at a higher level, more values are part of the key."""

    def __init__(self, site: Any, level: int) -> None:
        super().__init__(site, level)
        self.site, self.level = site, level


class Recipe:
    """The static part of a function that was read: a key, and how to rebuild the function from
    operands."""

    def __init__(self, f: Callable, reader: Reader) -> None:
        self.key, self.make = reader.read(f)
        self.hash = hash(self.key)
        self.level, self.site = reader.level, _site(f)
        # a cached program keeps its recipe, which must not keep the caller's arrays
        self.source = weakref.ref(f)
        self.known: Any = f if self.make is None else None

    def __hash__(self) -> int:
        return self.hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Recipe) and self.hash == other.hash and self.key == other.key


class Captured(eqx.Module):
    """A function as a pytree: the numbers that it reads, and a static `Recipe` to rebuild it."""

    operands: tuple[jax.Array, ...]
    recipe: Recipe

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        recipe = self.recipe
        try:
            f = recipe.known if recipe.make is None else recipe.make(self.operands, {})
            found = f(*args, **kwargs)
        except Exception as error:
            raise UnfitError(recipe.site, recipe.level + 1) from error
        source = recipe.source()
        if source is not None and getattr(_read(source, recipe.level), "recipe", None) != recipe:
            raise UnfitError(recipe.site, OPAQUE)  # it changed a value that it reads
        return found


def with_captured(call: Callable[..., T], *functions: Any) -> T:
    """Call call(*functions) with each readable function as a pytree. Inside traced code pass the
    functions unchanged."""
    if inside_jit():
        return call(*functions)
    tried = set()
    while True:
        try:
            return call(*(captured(f) if callable(f) else f for f in functions))
        except UnfitError as unfit:
            tried.add(unfit.site)
            _levels[unfit.site] = unfit.level
        except Exception:  # an error of the function itself, not of how it was read
            for site in tried:
                _levels.pop(site, None)
            raise


def captured(f: Callable) -> Callable:
    """Return a function as a pytree, or unchanged if not all values that it reads can be found.
    Formulations and soft contact are unchanged, because they compare by their parameters."""
    if isinstance(f, Formulation | SoftContact):
        return f
    for level in range(_levels.get(_site(f), FLOATS), OPAQUE):
        found = _read(f, level)
        if found is not None:
            return found
    return f


def _read(f: Callable, level: int) -> Any:
    reader = Reader(level)
    try:
        recipe = Recipe(f, reader)
    except HiddenError as error:
        _say(*error.args)
        return lambda *args, **kwargs: f(*args, **kwargs)  # a new object: compiles at each call
    except (UnreadableError, TypeError, ValueError, RecursionError):  # not hashable, or recursive
        return None
    return f if isinstance(recipe.key, Same) else Captured(tuple(reader.operands), recipe)


@functools.cache
def _say(function: str, how: str) -> None:
    warnings.warn(
        f"{function} uses `{how}`: changes of the values that it reads are not detected, so the "
        "function is compiled at each call, which takes seconds; read the values by their names, "
        "or hold them in arguments, closure variables or attributes",
        stacklevel=2,
    )


def _site(f: Any) -> Any:
    """Return the code location of a function, as a cache key."""
    while isinstance(f, functools.partial):
        f = f.func
    f = getattr(f, "__func__", f)
    return getattr(f, "__code__", type(f))
