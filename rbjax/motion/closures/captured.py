"""Functions of a user as pytrees, so that equal code with other numbers is compiled once.

    for k in gains:
        rollout(model, state, lambda t, s: -k * s.v, dt, steps=n)

creates a new function each time. `jit` compares functions by identity, so it would compile each.
Here a function is a pytree. Its leaves are the numbers that it reads. Its static part is a
`Recipe`; two functions that differ only in numbers have equal recipes.

A function that needs the value of a number (`if k > 0`) is read again with its floats in the
recipe, and if necessary with its arrays too. A function that cannot be read (a generator, code that
writes as it runs) stays an object that equals only itself, as for `jit`: it is compiled when it is
new. A user's function that reads values without naming them (`globals()`, a file) is compiled at
each call, with a warning.

`equinox.filter_closure_convert` and `jax.closure_convert` trace a function to find its arrays, and
`equinox.internal.closure_to_pytree` looks into cells only.
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
#: of code that does not run with its floats as operands, how it is read
_levels: weakref.WeakKeyDictionary[Any, int] = weakref.WeakKeyDictionary()


class UnfitError(Exception):
    """A function does not run as it was read; it is to be read at another level."""

    def __init__(self, site: Any, level: int) -> None:
        super().__init__(site, level)
        self.site, self.level = site, level


class Recipe:
    """A maker of a function from operands, equal to another that makes an equal function."""

    def __init__(self, f: Callable, reader: Reader) -> None:
        self.key, self.make = reader.read(f)
        self.hash = hash(self.key)
        self.level, self.site = reader.level, _site(f)
        # a program that is kept keeps its recipe, which does not keep the caller's arrays
        self.source = weakref.ref(f)
        self.known: Any = f if self.make is None else None

    def __hash__(self) -> int:
        return self.hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Recipe) and self.hash == other.hash and self.key == other.key


class Captured(eqx.Module):
    """A function as a pytree: the numbers that it reads, and the rest."""

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
            raise UnfitError(recipe.site, OPAQUE)  # it wrote what it reads
        return found


def with_captured(call: Callable[..., T], *functions: Any) -> T:
    """call(*functions), with each function as a pytree if it can be read; unchanged inside a
    program."""
    if inside_jit():
        return call(*functions)
    tried = set()
    while True:
        try:
            return call(*(captured(f) if callable(f) else f for f in functions))
        except UnfitError as unfit:
            tried.add(unfit.site)
            _levels[unfit.site] = unfit.level
        except Exception:  # the function's own: it says nothing of how to read its code
            for site in tried:
                _levels.pop(site, None)
            raise


def captured(f: Callable) -> Callable:
    """A function as a pytree if everything that it reads is found; otherwise the function. A
    formulation is compared by its parameters already."""
    if isinstance(f, Formulation):
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
        return lambda *args, **kwargs: f(*args, **kwargs)  # equals no function of an earlier call
    except (UnreadableError, TypeError, ValueError, RecursionError):  # no hash, no order, no end
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
    """A key that the functions from one place of the caller's code share."""
    while isinstance(f, functools.partial):
        f = f.func
    f = getattr(f, "__func__", f)
    return getattr(f, "__code__", type(f))
