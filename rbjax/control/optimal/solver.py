"""`solve`: the entry point of all optimal control methods.

Most parameters of a model are zeros and ones. As compile-time constants they remove half of the
operations, but each set of constants needs its own compilation. So the parameters of the first
robots of each structure are constants, and later robots of that structure are arguments
(`ConstantRobots`).
"""

from __future__ import annotations

import functools
from collections.abc import Hashable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance, integer, real_number
from rbjax.compiler import threads
from rbjax.compiling import compiled, inside_jit
from rbjax.control.optimal.derivatives.implicit import differentiable
from rbjax.control.optimal.first_guess import Guess, first_guess, follow, guess_of
from rbjax.control.optimal.objective import constraint_violations, motion_cost, rows_along
from rbjax.control.optimal.problem import Knot, Problem
from rbjax.control.optimal.registry import METHODS, method_of, name_of
from rbjax.control.optimal.shooting.expansion import largest_gap
from rbjax.control.optimal.shooting.search import gap_tolerance
from rbjax.control.optimal.solution import (
    SearchResult,
    Solution,
    SolveOptions,
    StoppingRule,
    solution_of,
)
from rbjax.control.status import CONVERGED, FINISHED, INFEASIBLE, NOT_FINITE, STUCK
from rbjax.errors import InputError
from rbjax.lanes.arrays import select
from rbjax.motion.closures.captured import with_captured
from rbjax.progress import Say, progress_line

#: number of robots of each structure whose parameters become constants
ROBOTS = 2
#: size of the caches
REMEMBERED = 64


class StaticPytree:
    """A pytree that is hashed and compared by value, for use as a static argument."""

    def __init__(self, leaves: list, tree: Any):
        self.leaves, self.tree = leaves, tree
        self._key = tuple(
            (x.shape, x.dtype.str, x.tobytes()) if isinstance(x, np.ndarray) else x
            for x in (np.asarray(x) if eqx.is_array(x) else x for x in leaves)
        )
        self._hash = hash((tree, self._key))

    def unflatten(self) -> Any:
        """Return the pytree whose leaves are hashed."""
        return jax.tree.unflatten(self.tree, self.leaves)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        return (
            isinstance(other, StaticPytree) and self._hash == other._hash
            and self.tree == other.tree and self._key == other._key
        )  # fmt: skip


class ConstantRobots:
    """Cache of the robots that are compile-time constants. The cache key is the identity of a
    robot's arrays, because reading arrays from a GPU takes longer than a call."""

    def __init__(self) -> None:
        self._seen: dict[tuple, StaticPytree] = {}
        self._forms: dict[Hashable, list[StaticPytree]] = {}

    def constants(self, robot: Any) -> StaticPytree | None:
        """Return a robot as constants, or None to pass it as an argument.

        None: its arrays are traced, it cannot be hashed, or the limit of constant robots of its
            structure is reached.
        """
        leaves, tree = jax.tree.flatten(robot)
        if any(isinstance(x, jax.core.Tracer) for x in leaves):
            return None
        key = (tree, *map(id, leaves))
        found = self._seen.get(key)
        if found is None:
            try:
                found = StaticPytree(leaves, tree)
            except TypeError:  # a leaf without a hash
                return None
            _forget(self._seen)
            self._seen[key] = found  # keeps the arrays alive, so their ids stay unique
        form = (tree, *(x.shape if eqx.is_array(x) else x for x in leaves))
        same = self._forms.get(form)
        if same is None:
            _forget(self._forms)
            same = self._forms[form] = []
        for other in same:
            if other == found:
                return other
        if len(same) >= ROBOTS:
            return None
        same.append(found)
        return found


def _forget(found: dict) -> None:
    """Remove the oldest entries of a cache, to make space for one more."""
    while len(found) >= REMEMBERED:
        del found[next(iter(found))]


def solve(
    problem: Problem,
    start: Any,
    *,
    method: Any = "ddp",
    states: Any = None,
    ctrl: Any = None,
    parameters: Any = None,
    guess: Solution | None = None,
    iterations: int = 200,
    tolerance: float = 1e-9,
    violation: float = 1e-6,
    seed: Any = 0,
    progress: bool = False,
) -> Solution:
    """Minimise the cost of a problem from a start.

    min  sum_k h L(t_k, x_k, u_k) + Phi(x_N)   with the constraints of the `Problem`.

    Args:
        problem: `Problem`.
        start: `State` of a model or a wheeled robot, (n,) of `Equations`. Free coordinates of it
            are a first guess.
        method: a name from `rb.control.methods()`, or a `Sampling`.
        states: a first guess of the states, with a leading axis N + 1, which need not obey the
            dynamics. If None: the start at all knots; or, if ctrl is given, the motion under them
            if it costs less, or if the model has contacts.
        ctrl: a first guess (N, nu) of the controls; zeros if None.
        parameters: a first guess of the design parameters and, last, of the final time.
        guess: the `Solution` of a similar problem, instead of these three. The search starts from
            its motion, rolled out with its gains from the new start, and from its multipliers.
        iterations: maximum number of iterations.
        tolerance: the search converges if the predicted change of the cost is below this, relative
            to the larger of |cost| and min(|cost of the first guess|, 1); at least 10 eps of the
            dtype.
        violation: largest accepted constraint violation, in the units of the constraints; at least
            10 eps of the dtype. float32 has too few digits for some end states of long or unstable
            motions, such as a swing-up: these searches end without convergence near the optimum.
        seed: integer seed of methods that draw samples; use `jax.vmap` over it for many attempts.
        progress: if true, print the iterations on a terminal; ignored in traced code.

    Returns:
        `Solution`. `success` is true if it converged; `summary()` explains its `status`. Its
        states, controls, parameters, cost and multipliers are differentiable, forward and reverse,
        with respect to all arrays of the problem, arrays that its functions close over, and the
        start, also with active bounds and constraints (`derivatives`). Its gains and the record of
        the iterations are constants for differentiation.

    Raises:
        InputError: wrong types or shapes; outside of traced code also values that are not finite.
        UnknownName: no such method.

    Source: Mastalli et al., *Crocoddyl*, ICRA 2020 (`ddp`).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> still = rb.control.StateError(model.default_state())
        >>> problem = rb.control.Problem(model, 20, 0.05, running=[still, rb.control.Control()],
        ...                              terminal=[still])
        >>> pushed = rb.State(model.default_state().q + 0.2, model.default_state().v)
        >>> found = rb.control.solve(problem, pushed)
        >>> rb.control.Status(int(found.status)).name, bool(found.success)
        ('CONVERGED', True)
    """
    instance("solve", "problem", problem, Problem, "an rb.control.Problem")
    if problem.constraints and not method_of(method).constraints:
        able = [name for name, m in METHODS.items() if m.constraints]
        raise InputError(f"solve: method {method!r} does not support constraints; these do: {able}")
    integer("solve", "iterations", iterations, least=1)
    for name, value in (("tolerance", tolerance), ("violation", violation)):
        real_number("solve", name, value, least=0.0, finite=False, traced=True)
    for name, value in (("start", start), ("states", states), ("ctrl", ctrl),
                        ("parameters", parameters)):  # fmt: skip
        _check_finite(name, value)
    if not isinstance(seed, jax.core.Tracer):
        _check_seed(seed)
    inside = inside_jit()
    show = progress and not inside
    number = jnp.asarray if inside else _as_number
    began = guess_of(problem, guess, states, ctrl, parameters)
    least = 10 * float(jnp.finfo(problem.dt.dtype).eps)
    largest = jnp.maximum(violation, least) if inside else max(float(violation), least)
    rule = StoppingRule(number(tolerance), number(largest), number(iterations))
    options = SolveOptions(
        rule, jnp.asarray(seed, jnp.uint32), began.multipliers, _report if show else None
    )
    began = began._replace(multipliers=None)
    if not all(map(eqx.is_array_like, jax.tree.leaves(start))):
        start = problem.system.checked("solve", start)  # raises
    leaves, tree = jax.tree.flatten(problem)
    places = [i for i, x in enumerate(leaves) if callable(x)]
    program, robot = (_solve if inside else _compiled), len(jax.tree.leaves(problem.system))

    def run(*functions: Any) -> Solution:
        filled = list(leaves)
        for i, f in zip(places, functions, strict=True):
            filled[i] = f
        parts = filled[:robot], filled[robot:]
        constants = None if inside else _robots.constants(parts[0])
        numeric, rest = eqx.partition(parts[constants is not None :], eqx.is_array)
        others, other_tree = jax.tree.flatten(rest)
        key = (tree, constants, other_tree, *others)
        found, off, ts, parameters = program(
            numeric, start, began, options, key, method, int(iterations)
        )
        return solution_of(problem, found, off, ts, parameters, name_of(method))

    if not show:
        return with_captured(run, *(leaves[i] for i in places))
    with progress_line(f"solve ({method})") as line:
        _lines.append(line)
        try:
            return jax.block_until_ready(with_captured(run, *(leaves[i] for i in places)))
        finally:
            jax.effects_barrier()
            _lines.pop()


def _check_finite(name: str, value: Any) -> None:
    """Raise InputError if a value is not finite. Traced values and arrays on a GPU are not read;
    for them the status is `NOT_FINITE`."""
    for x in jax.tree.leaves(value):
        if name != "start" and isinstance(x, str | bytes):  # `checked` raises for a start
            raise InputError(f"solve: {name} is {x!r}, expected numbers")
        if isinstance(x, jax.core.Tracer) or (isinstance(x, jax.Array) and not _on_host(x)):
            continue
        try:
            whole = np.isfinite(np.asarray(x, float)).all()
        except (TypeError, ValueError):  # another check reports the type
            continue
        if not whole:
            raise InputError(f"solve: {name} has numbers that are not finite, expected finite ones")


def _check_seed(seed: Any) -> None:
    """Raise InputError unless a seed consists of integers from 0 to 2^32 - 1."""
    x = np.asarray(seed)
    if x.dtype.kind not in "iu" or (x.size and not (0 <= x.min() <= x.max() < 2**32)):
        raise InputError(f"solve: seed is {seed!r}, expected an integer from 0 to 2^32 - 1")


def _on_host(x: jax.Array) -> bool:
    return all(d.platform == "cpu" for d in x.devices())


_lines: list[Say] = []  # progress lines of the running searches


def _report(iterations: Any, cost: Any, violation: Any) -> None:
    """Print the progress of a search. All searches share this function, which is part of a cache
    key."""
    if _lines:
        held = f", violation {float(violation):.2g}" if violation else ""
        _lines[-1](f"iteration {int(iterations)}, cost {float(cost):.8g}{held}")


_robots = ConstantRobots()


def _as_number(x: Any) -> Any:
    """Convert x to an array. Python numbers are unchanged."""
    return x if isinstance(x, int | float) else jnp.asarray(x)


def _solve(
    numeric: Any,
    start: Any,
    guess: Guess,
    options: SolveOptions,
    key: tuple,
    method: Any,
    history: int,
) -> tuple[SearchResult, jax.Array, jax.Array, jax.Array]:
    """Solve a problem. Return the result, the violation of each constraint, the times and the
    parameters."""
    tree, constants, other_tree, *others = key
    parts = eqx.combine(numeric, jax.tree.unflatten(other_tree, others))
    if constants is not None:
        parts = (constants.unflatten(), *parts)
    problem = jax.tree.unflatten(tree, [x for part in parts for x in part])
    start = problem.system.checked("solve", start)
    knots, ctrls = first_guess(problem, start, *guess[:4])
    found, off = _search(problem, start, knots, ctrls, options, method, history)
    parameters = found.knots.parameters[0]
    ks = jnp.arange(problem.horizon + 1, dtype=found.ctrl.dtype)
    ts = problem.time(ks, problem.at(parameters)[1])
    return found, off, ts, parameters


def _search(
    problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, options: SolveOptions, method: Any,
    history: int,
) -> tuple[SearchResult, jax.Array]:  # fmt: skip
    """Run a method, and correct its status for violated constraints and nan values."""
    used = method_of(method)

    def search(problem: Problem, start: Any, *guess: Any) -> SearchResult:
        found = used.solve(problem, start, *guess, history)
        return _motion_if_stuck(problem, start, found) if used.gaps else found

    if used.differentiable:
        found = differentiable(search, problem, start, knots, ctrls, options)
    else:
        found = _without_derivative(search(problem, start, knots, ctrls, options))
    if found.violations is not None:
        return found, found.violations
    off = constraint_violations(problem, *rows_along(problem, found.knots, found.ctrl))
    # a penalty method may converge to a point that violates constraints
    rests = (found.status == CONVERGED) | (found.status == FINISHED)
    broken = (off > options.rule.violation).any() & rests
    status = jnp.where(broken, INFEASIBLE, found.status)
    status = jnp.where(jnp.isfinite(found.cost + found.gap), status, NOT_FINITE)
    return found._replace(status=status), off


def _motion_if_stuck(problem: Problem, start: Any, found: SearchResult) -> SearchResult:
    """Return a result. If it is stuck with gaps between its states, roll out its feedback
    instead."""

    def motion() -> SearchResult:
        run = threads(functools.partial(follow, problem))
        knots, ctrl = run(start, found.knots, found.ctrl, -found.K)
        off = constraint_violations(problem, *rows_along(problem, knots, ctrl)).max(initial=0.0)
        new = found._replace(
            knots=knots, ctrl=ctrl, cost=motion_cost(problem, knots, ctrl), violation=off,
            gap=largest_gap(problem, start, knots, ctrl),
        )  # fmt: skip
        return select(jnp.isfinite(new.cost + new.gap), new, found)

    stuck = (found.status == STUCK) & (found.gap > gap_tolerance(found.cost.dtype))
    return jax.lax.cond(stuck, motion, lambda: found)


@jax.custom_jvp
def _without_derivative(found: SearchResult) -> SearchResult:
    """Return the result of a method without derivatives; differentiating it raises InputError."""
    return found


@_without_derivative.defjvp
def _refuse(primals: Any, tangents: Any) -> Any:
    able = [name for name, m in METHODS.items() if m.differentiable]
    raise InputError(
        "solve: this method gives no derivative of its optimum; solve again by one of the methods "
        f"{able}, from the states and controls found"
    )


_compiled = compiled(_solve, static_argnames=("key", "method", "history"))
