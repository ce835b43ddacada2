"""Checkpoints of policies: a folder with the task, the settings and the parameters.

FOLDER/policy.json      the task's name and options, the settings, the sizes of the networks, and
                        the name of the folder of the arrays
FOLDER/parameters-N     the arrays, by orbax; N counts the checkpoints that were written

A new checkpoint becomes the valid one in a single step, when its policy.json replaces the old one.
"""

from __future__ import annotations

import itertools
import json
import re
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.arguments import file_path, shown
from rbjax.envs.learning.networks import ACTIVATIONS, Network, Normaliser
from rbjax.envs.learning.policy import Policy, as_policy
from rbjax.envs.registry import make, task_function
from rbjax.errors import InputError
from rbjax.optional import require

FORMAT = 1
#: what to do about a checkpoint that cannot be read
AGAIN = "train again with this version of rbjax"
#: names of folders of arrays
ARRAYS = re.compile(r"parameters(-\d+)?")


def _is_count(x: Any) -> bool:
    return isinstance(x, int) and not isinstance(x, bool) and x > 0


#: the entries of "policy" in policy.json: whether a value fits, and the expected one
POLICY: dict[str, tuple[Callable[[Any], bool], str]] = {
    "sizes": (
        lambda x: isinstance(x, list) and len(x) > 1 and all(map(_is_count, x)),
        "sizes of layers",
    ),
    "activation": (
        lambda x: isinstance(x, str) and x in ACTIVATIONS,
        f"one of {list(ACTIVATIONS)}",
    ),
    "actions": (_is_count, "a number of actions"),
    "squash": (lambda x: isinstance(x, bool), "true or false"),
    "normalised": (lambda x: isinstance(x, bool), "true or false"),
    "noise": (lambda x: isinstance(x, bool), "true or false"),
    "limit": (
        lambda x: x is None or (isinstance(x, int | float) and x > 0),
        "a number above zero, or null",
    ),
}


def save_policy(
    path: str | Path,
    policy: Policy,
    task: str,
    options: Mapping[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Path:
    """Write a policy to a folder, with the name of its task.

    Args:
        path: the folder. An earlier checkpoint there is replaced when the new one is written.
        policy: a `Policy` whose network is a `Network`.
        task: name of the task, as for `rb.envs.make`.
        options: options of the task.
        settings: settings of the training, for the record.

    Returns:
        The path of the folder.

    Raises:
        UnknownName: no such task, or an option that it does not have.
        InputError: orbax is not installed, a policy of another kind, or options that JSON cannot
            represent.

    Example:
        >>> import jax, tempfile
        >>> import rbjax as rb
        >>> env = rb.envs.make("cart_pole_balance")
        >>> policy = rb.envs.learning.new_policy(env, jax.random.key(0), (8,))
        >>> folder = tempfile.mkdtemp()
        >>> path = rb.envs.learning.save_policy(folder, policy, "cart_pole_balance")
        >>> env, policy = rb.envs.learning.load_policy(path)
        >>> policy.network.sizes
        (5, 8, 1)
    """
    if not isinstance(policy, Policy) or not isinstance(policy.network, Network):
        kind = type(policy.network if isinstance(policy, Policy) else policy).__name__
        raise InputError(
            f"save_policy: the policy's network is {kind}, expected a Policy with a network of "
            "rb.envs.learning.network"
        )
    for name, given in (("options", options), ("settings", settings)):
        if given is not None and not isinstance(given, Mapping):
            raise InputError(f"save_policy: {name} is {shown(given)}, expected a dict of {name}")
    task_function(task, options or {})  # else load_policy could not make the environment
    folder = _folder("save_policy", path)
    if folder.is_file():
        raise InputError(f"save_policy: {path} is a file, expected a folder")
    head: dict[str, Any] = {
        "format": FORMAT,
        "task": task,
        "options": dict(options or {}),
        "settings": dict(settings or {}),
        "policy": {
            "sizes": policy.network.sizes,
            "activation": policy.network.activation,
            "actions": policy.low.shape[0],
            "squash": policy.squash,
            "limit": None if policy.normaliser is None else policy.normaliser.limit,
            "normalised": policy.normaliser is not None,
            "noise": policy.log_std is not None,
        },
    }
    _json(head)  # before anything is written
    checkpointer = _orbax("save_policy")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"save_policy: the folder {path} cannot be made: {error}") from error
    earlier = _arrays_folders(folder)
    head["arrays"] = f"parameters-{max(earlier.values(), default=0) + 1}"
    checkpointer.save(folder / head["arrays"], _arrays(policy))
    (folder / "policy.json.new").write_text(_json(head))
    (folder / "policy.json.new").replace(folder / "policy.json")
    for name in earlier:  # one that cannot be removed is not read: policy.json names the arrays
        shutil.rmtree(folder / name, ignore_errors=True)
    return folder


def load_policy(path: str | Path) -> tuple[Any, Policy]:
    """Read a policy from a folder that `train` or `save_policy` wrote.

    Args:
        path: the folder.

    Returns:
        env: the `Environment` of the policy's task.
        policy: `Policy`; `policy(obs, key)` returns an action, without a key the mean action.

    Raises:
        UnknownName: the task or an option of it is not registered.
        InputError: not such a folder, files that do not fit, or orbax is not installed.

    See `save_policy` for an example.
    """
    folder = _folder("load_policy", path)
    file = folder / "policy.json"
    if not file.is_file():
        raise InputError(
            f"load_policy: {path} has no policy.json, expected a folder that rbjax train or "
            "save_policy wrote"
        )
    head = read_head(file)
    policy = _like(head["policy"])
    try:
        arrays = _orbax("load_policy").restore(folder / head["arrays"], _arrays(policy))
    except (ValueError, OSError, KeyError) as error:
        raise InputError(
            f"load_policy: {folder / head['arrays']} does not contain the arrays of policy.json: "
            f"{str(error).splitlines()[0]}; {AGAIN}"
        ) from error
    arrays = {name: jnp.asarray(x) for name, x in arrays.items()}
    for name, like in _arrays(policy).items():
        if arrays[name].shape != like.shape:
            raise InputError(
                f"load_policy: {name} has shape {arrays[name].shape}, and policy.json has "
                f"{like.shape}; {AGAIN}"
            )
    network = Network(
        tuple(arrays[f"weight_{k}"] for k in range(len(policy.network.weights))),
        tuple(arrays[f"bias_{k}"] for k in range(len(policy.network.biases))),
        policy.network.activation,
    )
    statistics = policy.normaliser
    if statistics is not None:
        mean, std, count = (arrays[name] for name in ("mean", "std", "count"))
        statistics = Normaliser(mean, std, count, statistics.limit)
    made = Policy(
        network, statistics, arrays.get("log_std"), arrays["low"], arrays["high"], policy.squash
    )
    env = make(head["task"], **head["options"])
    return env, as_policy("load_policy", env, made)


def read_head(file: Path) -> dict[str, Any]:
    """Read policy.json, and check that its entries are those of `save_policy`."""

    def wrong(what: str) -> InputError:
        return InputError(f"load_policy: {file} {what}; {AGAIN}")

    try:
        head = json.loads(file.read_text())
    except ValueError as error:
        raise wrong(f"is not JSON ({error})") from error
    if not isinstance(head, dict):
        raise wrong(f"is {shown(head)}, expected an object")
    if head.get("format") != FORMAT:
        raise wrong(f"has format {head.get('format')}, expected {FORMAT}")
    head.setdefault("arrays", "parameters")
    checks: dict[str, tuple[Callable[[Any], bool], str]] = {
        "task": (lambda x: isinstance(x, str), "a name"),
        "options": (lambda x: isinstance(x, dict), "an object"),
        "policy": (lambda x: isinstance(x, dict), "an object"),
        "arrays": (lambda x: isinstance(x, str) and ARRAYS.fullmatch(x) is not None, "its folder"),
    }
    for name, (fits, expected) in checks.items():
        if not fits(head.get(name)):
            raise wrong(f"has {name} {shown(head.get(name))}, expected {expected}")
    for name, (fits, expected) in POLICY.items():
        if not fits(head["policy"].get(name)):
            found = shown(head["policy"].get(name))
            raise wrong(f"has policy.{name} {found}, expected {expected}")
    if head["policy"]["normalised"] and head["policy"].get("limit") is None:
        raise wrong("has no policy.limit, expected the limit of the normalised observations")
    task_function(head["task"], head["options"])
    return head


def _folder(where: str, path: Any) -> Path:
    return file_path(where, path).expanduser().absolute()


def _like(head: Mapping[str, Any]) -> Policy:
    """Return a policy of the same structure, with zeros."""
    sizes = head["sizes"]
    zeros = tuple(jnp.zeros(n) for n in sizes[1:])
    weights = tuple(jnp.zeros((b, a)) for a, b in itertools.pairwise(sizes))
    na = head["actions"]
    statistics = None
    if head["normalised"]:
        statistics = Normaliser(
            jnp.zeros(sizes[0]), jnp.ones(sizes[0]), jnp.zeros(()), head["limit"]
        )
    noise = jnp.zeros(na) if head["noise"] else None
    net = Network(weights, zeros, head["activation"])
    return Policy(net, statistics, noise, jnp.zeros(na), jnp.zeros(na), head["squash"])


def _arrays(policy: Policy) -> dict[str, np.ndarray]:
    found = {f"weight_{k}": W for k, W in enumerate(policy.network.weights)}
    found |= {f"bias_{k}": b for k, b in enumerate(policy.network.biases)}
    found |= {"low": policy.low, "high": policy.high}
    if policy.normaliser is not None:
        found |= {name: getattr(policy.normaliser, name) for name in ("mean", "std", "count")}
    if policy.log_std is not None:
        found["log_std"] = policy.log_std
    return {name: np.asarray(x) for name, x in found.items()}  # they load on any device


def _orbax(where: str) -> Any:
    return require(where, "orbax.checkpoint").PyTreeCheckpointer()


def _arrays_folders(folder: Path) -> dict[str, int]:
    """Return the folders of arrays, of earlier and of incomplete checkpoints, and their numbers."""
    found = {}
    for path in folder.iterdir():
        match = re.match(r"parameters(?:-(\d+))?(?:\.|$)", path.name)
        if match is not None:
            found[path.name] = int(match.group(1) or 0)
    return found


def _json(head: Mapping[str, Any]) -> str:
    try:
        return json.dumps(head, indent=1, default=_plain) + "\n"
    except TypeError as error:
        raise InputError(f"save_policy: options or settings are not plain data: {error}") from error


def _plain(x: Any) -> Any:
    """Convert an array to lists, for JSON."""
    if hasattr(x, "tolist"):
        return x.tolist()
    raise TypeError(f"{type(x).__name__} {x!r}")
