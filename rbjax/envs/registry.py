"""The registry of tasks, and `make`."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from rbjax.arguments import choice, flag
from rbjax.envs.environment import Environment
from rbjax.envs.task import Task
from rbjax.errors import InputError

F = TypeVar("F", bound=Callable[..., Task])

SUITE = "rbjax.envs.suite"
_TASKS: dict[str, Callable[..., Task]] = {}


def register(name: str) -> Callable[[F], F]:
    """Register a function that returns a `Task` (a decorator).

    A function that is defined again, for instance in a notebook, replaces the earlier one.

    Args:
        name: name of the task.

    Returns:
        A decorator that returns the function unchanged.

    Raises:
        InputError: a name that is not a word, or that belongs to another function.

    Example:
        >>> import rbjax as rb
        >>> @rb.envs.register("my_balance")
        ... def my_balance():
        ...     return rb.envs.tasks()["cart_pole_balance"]()
        >>> rb.envs.make("my_balance").action_size
        1
    """
    if not isinstance(name, str) or not name.isidentifier():
        raise InputError(f'register: name is {name!r}, expected a word such as "my_task"')

    def add(f: F) -> F:
        if not f.__module__.startswith(SUITE):
            tasks()  # so that a name of the suite is known to be taken
        old = _TASKS.get(name)
        if old is not None and _origin(old) != _origin(f):
            raise InputError(f"register: {name} is the name of another task, expected a new name")
        _TASKS[name] = f
        return f

    return add


def _origin(f: Callable) -> tuple[str, str]:
    return f.__module__, f.__qualname__


def tasks() -> dict[str, Callable[..., Task]]:
    """Return all tasks by name: functions of options that return a `Task`.

    Example:
        >>> import rbjax as rb
        >>> "cart_pole_balance" in rb.envs.tasks()
        True
    """
    package = importlib.import_module(SUITE)
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"{package.__name__}.{module.name}")
    return dict(sorted(_TASKS.items()))


def make(name: str, *, kernel: bool | None = None, **options: Any) -> Environment:
    """Make the environment of a named task.

    Args:
        name: a name of `rb.envs.tasks`.
        kernel: as in `Environment`.
        options: of the function of the task.

    Returns:
        `Environment`.

    Raises:
        UnknownName: no such task, or an option that it does not have.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.make("cart_pole_balance").observation_size
        5
    """
    env = Environment(task_function(name, options)(**options), kernel=kernel)
    env.name, env.options = name, dict(options)
    return env


def task_function(name: Any, options: Mapping[str, Any]) -> Callable[..., Task]:
    """Return the function of a named task.

    Raises:
        UnknownName: no such task, or an option that it does not have.
        InputError: a flag that is neither True nor False.
    """
    known = tasks()
    choice("task", name, known)
    accepted = inspect.signature(known[name]).parameters
    for option, value in options.items():
        choice(f"option of task {name!r}", option, list(accepted))
        if isinstance(accepted[option].default, bool):
            flag(f"task {name!r}", option, value)
    return known[name]
