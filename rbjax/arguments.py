"""Argument checks outside traced code: numbers, integers, arrays, flags, names, objects."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError, UnknownName, listed

#: Whether a type checker takes an argument of type ArrayLike as converted: in the bodies of rbjax
#: (`always_true` of mypy in pyproject.toml), and not in the code of a user.
CONVERTED: Final = False
if not TYPE_CHECKING:
    #: a JAX or NumPy array, a number, or lists of numbers; the function converts it
    ArrayLike = Any
elif not CONVERTED:
    from numpy.typing import ArrayLike as ArrayLike
else:
    ArrayLike = jax.Array

#: dtypes of all computations; half precision has too few digits for dynamics
FLOATS = (jnp.float32, jnp.float64)


def floating_array(
    where: str, name: str, value: Any, fits: Callable[[tuple[int, ...]], bool], expected: str
) -> jax.Array:
    """Convert a value to a JAX array in f32 or f64. Integers become floats.

    Args:
        where: function, for the message.
        name: argument, for the message.
        value: value from the user.
        fits: function that checks a shape.
        expected: accepted shapes, for the message.

    Raises:
        InputError: not an array, another shape or dtype.
    """
    try:
        x = None if isinstance(value, str | bytes) else jnp.asarray(value)
    except (TypeError, ValueError, OverflowError):
        x = None
    if x is None:
        got = type(value).__name__
        raise InputError(f"{where}: {name} is {got}, expected an array of shape {expected}")
    if not fits(x.shape):
        raise InputError(f"{where}: {name} has shape {x.shape}, expected {expected}")
    if jnp.issubdtype(x.dtype, jnp.integer) or x.dtype == bool:
        x = x.astype(jnp.result_type(float))
    if x.dtype not in FLOATS:
        raise InputError(f"{where}: {name} has dtype {x.dtype}, expected float32 or float64")
    return x


def real_array(
    where: str,
    name: str,
    value: Any,
    expected: str | None = None,
    *,
    ndim: int | None = None,
    finite: bool = True,
    complex_numbers: bool = False,
) -> np.ndarray:
    """Convert a value to a float64 array.

    Args:
        where: function, for the message.
        name: argument, for the message.
        value: value from the user.
        expected: expected value, for the message; None for a default text.
        ndim: number of axes; None for any.
        finite: whether NaN and infinity are rejected.
        complex_numbers: whether complex numbers are accepted; the array is then complex128.

    Raises:
        InputError: not real numbers, another number of axes, or values that are not finite.
    """
    numbers = "numbers" if complex_numbers else "real numbers"
    try:
        found = np.asarray(value)
        known = found.dtype.kind in ("biufc" if complex_numbers else "biuf")
        x = found.astype(np.complex128 if complex_numbers else np.float64) if known else np.zeros(0)
    except (TypeError, ValueError, OverflowError):
        known = False
    if not known:
        raise InputError(f"{where}: {name} is {shown(value)}, expected {expected or numbers}")
    if ndim is not None and x.ndim != ndim:
        raise InputError(f"{where}: {name} has shape {x.shape}, expected {ndim} axes")
    if finite and not np.isfinite(x).all():
        at = tuple(map(int, np.argwhere(~np.isfinite(x))[0]))
        place = f"{name}{list(at)}" if at else name
        raise InputError(f"{where}: {place} is {x[at]}, expected {expected or 'finite numbers'}")
    return x


def real_number(
    where: str,
    name: str,
    value: Any,
    expected: str | None = None,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    most: float = math.inf,
    finite: bool = True,
    traced: bool = False,
) -> Any:
    """Convert a value to a float in a range.

    Args:
        where: function, for the message.
        name: argument, for the message.
        value: value from the user.
        expected: expected value, for the message; None for a default text.
        above: exclusive lower limit.
        least: inclusive lower limit.
        most: inclusive upper limit, which requires `least`.
        finite: whether infinity is rejected. NaN is always rejected.
        traced: whether a traced number is accepted and returned unchanged.

    Raises:
        InputError: not a real number, or out of range.
    """
    if traced and isinstance(value, jax.core.Tracer) and value.shape == ():
        return value
    limit = f" above {above:g}".replace("above 0", "above zero") if above > -math.inf else ""
    if least > -math.inf:
        limit += f" of at least {least:g}" if most == math.inf else f" from {least:g} to {most:g}"
    if isinstance(value, bool | np.bool_):
        value = str(value)  # a flag is not a number
    x = real_array(where, name, value, expected, finite=False)
    if x.shape != ():
        raise InputError(
            f"{where}: {name} has shape {x.shape}, expected {expected or f'a number{limit}'}"
        )
    number = float(x)
    if math.isnan(number) or (finite and math.isinf(number)):
        finite_number = f"a finite number{limit}"
        raise InputError(f"{where}: {name} is {number}, expected {expected or finite_number}")
    if not (number > above or above == -math.inf) or not least <= number <= most:
        raise InputError(f"{where}: {name} is {number}, expected {expected or f'a number{limit}'}")
    return number


def check_positive(where: str, **values: Any) -> None:
    """Raise InputError if an untraced number or array is not above zero. None is accepted."""
    for name, x in values.items():
        if x is None or any(isinstance(e, jax.core.Tracer) for e in jax.tree.leaves(x)):
            continue
        numbers = real_array(where, name, x, finite=False)
        if not (numbers > 0).all():
            got = shown(numbers.tolist())
            raise InputError(f"{where}: {name} is {got}, expected a number above zero")


def integer(
    where: str,
    name: str,
    value: Any,
    *,
    least: int | None = None,
    most: int | None = None,
    why: str = "",
) -> int:
    """Convert a value to an int in a range.

    Args:
        where: function, for the message.
        name: argument, for the message.
        value: value from the user.
        least: inclusive lower limit.
        most: inclusive upper limit, which requires `least`.
        why: reason for the limits, appended to the message.

    Raises:
        InputError: not an integer, out of range, or too large for an exact float.
    """
    known = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if known and abs(value) > 2**53:
        raise InputError(f"{where}: {name} is {shown(value)}, expected at most 2**53")
    too_small = known and least is not None and value < least
    if not known or too_small or (known and most is not None and value > most):
        limit = "" if least is None else f" of at least {least}"
        limit = limit if most is None else f" from {least} to {most}"
        raise InputError(f"{where}: {name} is {shown(value)}, expected an integer{limit}{why}")
    return int(value)


def flag(where: str, name: str, value: Any) -> bool:
    """Check that a value is True or False, and return it.

    Raises:
        InputError: any other value.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"{where}: {name} is {shown(value)}, expected True or False")
    return bool(value)


def choice(
    kind: str, name: Any, known: Collection[str], synonyms: Mapping[str, str] | None = None
) -> str:
    """Check that a name is one of the known names, and return it. `synonyms` as in `UnknownName`.

    Raises:
        UnknownName: another name, or not a string.
    """
    if not isinstance(name, str) or name not in known:
        raise UnknownName(kind, name, known, synonyms=synonyms)
    return name


def instance(where: str, name: str, value: Any, kind: Any, public: str) -> None:
    """Raise InputError unless the value is an instance of a class, or of one of several classes.

    public: name of the classes, for the message.
    """
    if not isinstance(value, kind):
        raise InputError(f"{where}: {name} is {shown(value)}, expected {public}")


def batch_shape(where: str, shape: Any) -> tuple[int, ...]:
    """Convert a value to the shape of a batch: a tuple of integers of at least 0, below 2**31."""
    if not isinstance(shape, tuple | list) or len(shape) > 32:
        raise InputError(f"{where}: shape is {shown(shape)}, expected a tuple of integers")
    found = tuple(integer(where, f"shape[{k}]", n, least=0) for k, n in enumerate(shape))
    if math.prod(found) >= 2**31:
        raise InputError(f"{where}: shape is {shown(shape)}, expected fewer than 2**31 samples")
    return found


def file_path(where: str, path: str | os.PathLike[str]) -> Path:
    """Convert a value to a path.

    Raises:
        InputError: neither a text nor a path, or an empty text.
    """
    if not isinstance(path, str | os.PathLike) or not os.fspath(path):
        raise InputError(f"{where}: path is {shown(path)}, expected the path of a file")
    return Path(path)


def new_file(where: str, path: str | os.PathLike[str]) -> Path:
    """Check that the folder of a file exists, and return the path of the file.

    Raises:
        InputError: not a path, or no such folder.
    """
    file = file_path(where, path)
    if not file.absolute().parent.is_dir():
        raise InputError(f"{where}: path is {shown(str(path))}, in a folder that does not exist")
    return file


def random_key(where: str, key: Any) -> None:
    """Raise InputError unless a value is one key of `jax.random`."""
    typed = isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    raw = isinstance(key, jax.Array) and key.dtype == jnp.uint32 and key.ndim > 0
    if not (typed or raw):
        raise InputError(
            f"{where}: key is {shown(key)}, expected a key of jax.random, such as jax.random.key(0)"
        )
    batch = key.shape if typed else key.shape[:-1]
    if batch:
        raise InputError(
            f"{where}: key is a batch of keys of shape {batch}, expected one key; map over a batch "
            "by jax.vmap"
        )


def existing_file(where: str, path: str | os.PathLike[str]) -> Path:
    """Check that a file exists, and return its path.

    Raises:
        InputError: no such file. The message lists the files of that suffix in the folder.
    """
    path = file_path(where, path)
    try:
        exists = path.is_file()
    except (OSError, ValueError) as error:
        text = f"{str(path)[:60]!r} ({type(error).__name__})"
        raise InputError(f"{where}: path is {text}, expected the path of a file") from error
    if not exists:
        others = sorted(p.name for p in path.parent.glob(f"*{path.suffix}"))
        raise InputError(
            f"{where}: no file {path}; in {path.parent} there are: {listed(others, 8) or 'none'}"
        )
    return path


def shown(value: Any) -> str:
    """Format a value for a message; return its type if it is long or has no short text."""
    plain = isinstance(value, bool | str | int | float | complex | list | tuple | np.ndarray)
    text = repr(value) if plain or value is None or isinstance(value, np.generic) else ""
    if 0 < len(text) <= 60:
        return text
    return f"{type(value).__name__} {text[:50]}..." if text else f"of type {type(value).__name__}"
