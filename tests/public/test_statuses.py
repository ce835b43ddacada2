"""Each status of a solver, planner or estimator is reached by a test.

The tables have, for each member of a status and each result with a flag `success`, a test that
reaches it, and words of that test that only it can have there.
"""

from __future__ import annotations

import ast
import dataclasses
import enum
import functools
import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from pathlib import Path

import pytest

import rbjax as rb

ROOT = Path(__file__).parents[2] / "tests"
OUTCOMES = "control/test_outcomes.py::"
VERDICTS = "stability/runs/test_verdicts.py::"
LEAST_SQUARES = "sysid/test_least_squares.py::test_each_end_of_a_search"
#: class.member -> test, words
REACHED = {
    "Status.GOING": ("control/test_search_state.py::test_with_constraints_a_search_at_rest_gets_"
                     "new_multipliers", "GOING"),
    "Status.CONVERGED": (f"{OUTCOMES}CASES", "CONVERGED"),
    "Status.BUDGET": (f"{OUTCOMES}CASES", "BUDGET"),
    "Status.INFEASIBLE": (f"{OUTCOMES}CASES", "INFEASIBLE"),
    "Status.STUCK": (f"{OUTCOMES}CASES", "STUCK"),
    "Status.NOT_FINITE": (f"{OUTCOMES}CASES", "NOT_FINITE"),
    "Status.FINISHED": (f"{OUTCOMES}CASES", "FINISHED"),
    "TickStatus.PLANNED": ("control/test_mpc.py::test_failing_plans_keep_the_last_and_then_fall_"
                           "back", "PLANNED"),
    "TickStatus.KEPT": ("control/test_mpc.py::test_failing_plans_keep_the_last_and_then_fall_back",
                        "KEPT"),
    "TickStatus.FALLBACK": ("control/test_mpc.py::test_failing_plans_keep_the_last_and_then_fall_"
                            "back", "FALLBACK"),
    "TickStatus.VIOLATED": ("control/test_mpc_constraints.py::test_a_start_beyond_the_limit_is_"
                            "said_and_led_back", "VIOLATED"),
    "LinearStatus.success": (f"{OUTCOMES}LINEAR", "success"),
    "LinearStatus.not_finite": (f"{OUTCOMES}LINEAR", "not_finite"),
    "LinearStatus.indefinite_control_cost": (f"{OUTCOMES}LINEAR", "indefinite_control_cost"),
    "LinearStatus.not_stabilisable": (f"{OUTCOMES}LINEAR", "not_stabilisable"),
    "LinearStatus.no_stabilising_solution": (f"{OUTCOMES}LINEAR", "no_stabilising_solution"),
    "LinearStatus.not_stable": (f"{OUTCOMES}test_every_result_of_a_linear_solver_is_reached",
                                "not_stable"),
    "Outcome.HOLDS": (f"{VERDICTS}test_holds_with_its_largest_error", "HOLDS"),
    "Outcome.BLOWS_UP": (f"{VERDICTS}test_blows_up_at_the_first_bad_state", "BLOWS_UP"),
    "Outcome.NO_ROOT": (f"{VERDICTS}test_what_the_solver_says_of_its_end", "NO_ROOT"),
    "Outcome.OUT_OF_STEPS": (f"{VERDICTS}test_what_the_solver_says_of_its_end", "OUT_OF_STEPS"),
    "Outcome.OFF_MANIFOLD": (f"{VERDICTS}test_leaves_the_manifold", "OFF_MANIFOLD"),
    "Outcome.DRIFTS": (f"{VERDICTS}test_drifts_by_the_invariant_that_does", "DRIFTS"),
    "Outcome.LOST": (f"{VERDICTS}test_loses_the_motion", "LOST"),
}  # fmt: skip
#: statuses that are texts or integers: class.status -> test, words
REACHED_TEXTS = {
    "ImpactTrajectory, too many": ("motion/test_impacts.py", "TOO_MANY"),
    "ImpactTrajectory, failed": ("motion/test_impacts.py", "FAILED"),
    "Plan, found": ("planning/test_statuses.py::CASES", "found"),
    "Plan, no path": ("planning/test_statuses.py::CASES", "no path"),
    "Plan, start in collision": ("planning/test_statuses.py::CASES", "start in collision"),
    "Plan, goal in collision": ("planning/test_statuses.py::CASES", "goal in collision"),
    "Plan, count exhausted": ("planning/test_statuses.py::CASES", "count exhausted"),
    "Refined": ("planning/test_refined_statuses.py::test_every_status_of_refine", "infeasible"),
    "SmoothedPath": ("planning/test_refined_statuses.py::test_every_status_of_smooth", "status"),
    "estimators, converged": (LEAST_SQUARES, '"converged"'),
    "estimators, budget": (LEAST_SQUARES, "not converged"),
    "estimators, stuck": (LEAST_SQUARES, "stuck"),
    "estimators, infeasible": (LEAST_SQUARES, "border"),
    "estimators, not finite": (LEAST_SQUARES, "not finite"),
}
#: class with a flag `success` -> a test in which it is False, words
FAILED = {
    "Arrival": ("solvers/test_events.py", "not stiff.success"),
    "Assembly": ("constraints/test_assembly.py", "not found.success"),
    "Consistent": ("sysid/test_regression_statistics.py", "not sysid.torque.consistent"),
    "ContactSolution": ("contact/test_solve.py", "not bool(early.success)"),
    "Experiment": ("sysid/test_experiments.py", "not found.success"),
    "FastRotation": ("flexible/modal/test_stiffening.py", "not found.success"),
    "Gains": ("control/test_riccati.py", "not found.success"),
    "HeldOut": ("sysid/test_verdict.py", "not found.success"),
    "Identified": ("sysid/test_fit_file.py", "not cut.success"),
    "Impulse": ("contact/test_impulse.py", "not few.success"),
    "ImpactTrajectory": ("motion/test_impacts.py", "few.status == FAILED"),
    "InverseKinematics": ("kinematics/test_inverse_kinematics.py", "not found.success"),
    "LawTrial": ("contact/test_recommend.py", "accuracy decides: mujoco slips"),
    "LimitCycle": ("stability/runs/test_limit_cycles.py", "not found.success"),
    "Lyapunov": (f"{OUTCOMES}test_every_result_of_a_linear_solver_is_reached", "not_stable"),
    "ManyStarts": ("sysid/test_fit_file.py", "not cut.success"),  # that of the best `Identified`
    "MethodTrial": ("control/test_recommend.py", "none converges"),
    "Minimum": (LEAST_SQUARES, "least.success =="),
    "Newton": ("flexible/reference/test_dynamics.py::test_failure_of_newton_is_said",
               "did not converge"),
    "Predicted": ("sysid/test_prediction_error.py::test_each_end_of_a_search", "found.success =="),
    "Refined": ("planning/test_refined_statuses.py::test_every_status_of_refine", "infeasible"),
    "Regression": ("sysid/test_regression.py", "not tired.success"),
    "Regulator": (f"{OUTCOMES}LINEAR", "not_stabilisable"),
    "Report": ("validation/test_compare.py", "not report(1e-8).success"),
    "Solution": (f"{OUTCOMES}check", "bool(found.success) =="),
    "SolverTrial": ("test_recommend.py", "not found.success"),
    "SteadyFilter": ("control/test_observer.py", "not_stabilisable"),
    "TimeScaled": ("planning/test_time_scaling.py", "success.tolist() == [True, True, False]"),
    "Tracking": ("control/test_tracking.py", "not without_cost.success"),
    "Trajectory": ("motion/test_rollout.py", "not bool(out.success)"),
    "Trial": ("constraints/test_recommend.py", "if x.success"),
    "Verdict": ("sysid/test_verdict.py", "not found.success"),
    "WithZeros": ("sysid/test_regression_statistics.py", "not regress_with_zeros"),
}  # fmt: skip
#: base classes of results
BASES = {"HasStatus"}


def classes() -> Iterator[type]:
    """All classes of rbjax, each in the module that defines it."""
    for module in pkgutil.walk_packages(rb.__path__, "rbjax."):
        if not module.name.endswith("__main__"):
            found = vars(importlib.import_module(module.name)).values()
            yield from (x for x in found if getattr(x, "__module__", None) == module.name
                        and isinstance(x, type))  # fmt: skip


@functools.cache
def source(test: str) -> str:
    """The text of a test file, or of one function or table in it."""
    name, _, part = test.partition("::")
    text = (ROOT / name).read_text()
    if not part:
        return text
    for node in ast.parse(text).body:
        names = [x.id for x in getattr(node, "targets", []) if isinstance(x, ast.Name)]
        if part in [getattr(node, "name", None), *names]:
            first = min([node.lineno, *(x.lineno for x in getattr(node, "decorator_list", []))])
            return "\n".join(text.splitlines()[first - 1 : node.end_lineno])
    raise AssertionError(f"{name} has no {part}")


EVERY = REACHED | REACHED_TEXTS | {f"{name}: success": x for name, x in FAILED.items()}


@pytest.mark.parametrize("status", EVERY)
def test_a_test_reaches_it(status: str) -> None:
    test, words = EVERY[status]
    assert words in source(test), f"{test} has no {words!r}"


def test_no_status_is_missing() -> None:
    members = set()
    for kind in classes():
        if issubclass(kind, enum.Enum):
            members |= {f"{kind.__name__}.{member.name}" for member in kind}
        elif type(kind) is type(rb.control.LinearStatus):
            members |= {f"{kind.__name__}.{name}" for name in vars(kind)["_name_to_item"]}
    assert members == REACHED.keys()


def test_no_flag_is_missing() -> None:
    """`success` as a field or a property, inherited ones too."""
    found = set()
    for kind in classes():
        fields = {f.name for f in dataclasses.fields(kind)} if dataclasses.is_dataclass(kind) else (
            set(getattr(kind, "_fields", ())))  # fmt: skip
        flag = inspect.getattr_static(kind, "success", None)
        if "success" in fields or isinstance(flag, property):
            found.add(kind.__name__)
    assert found - BASES == FAILED.keys()
