"""The motion that a viewer shows: of a robot file, a saved trajectory, a task, a policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from rbjax.envs import Environment, make, tasks
from rbjax.errors import UnknownName
from rbjax.loading import load, load_trajectory, scenes
from rbjax.model import Model
from rbjax.motion.trajectory import Trajectory
from rbjax.plotting.animation import animate
from rbjax.plotting.policies import FEW, drawn_source, record_policy, tracked_body
from rbjax.viewer.viewing import Viewer, at_rest, view


class RobotMotion(NamedTuple):
    """A robot and its motion, and how to show them.

    model: the robot.
    trajectory: its motion; None for a posture.
    source: of its shapes.
    contacts: contact forces of the first sample, or None.
    title: text at the top.
    floating_base: as in `rbjax.load`, for a source that is a URDF.
    tracked: name of the body that the camera follows; None for the middle of the robot.
    """

    model: Model
    trajectory: Trajectory | None
    source: Any
    contacts: Any
    title: str
    floating_base: bool = False
    tracked: str | None = None

    def view(self, **options: Any) -> Viewer:
        """Show it in the browser. options: of `rbjax.viewer.view`."""
        given = self._options() | options
        return view(
            self.model, self.trajectory, source=self.source, floating_base=self.floating_base,
            **given,
        )  # fmt: skip

    def animate(self, path: str | Path, **options: Any) -> Path:
        """Write it as an HTML page, a GIF or an MP4. options: of `rbjax.plotting.animate`."""
        motion = at_rest(self.model) if self.trajectory is None else self.trajectory
        samples = len(motion.q) if Path(path).suffix == ".html" else FEW
        given = self._options() | {"samples": samples} | options
        return animate(
            self.model, motion, path, source=self.source, floating_base=self.floating_base, **given
        )

    def _options(self) -> dict[str, Any]:
        return {"title": self.title, "contacts": self.contacts, "tracked": self.tracked}


def motion_of(
    what: str | Path,
    *,
    floating_base: bool = False,
    samples: int = 1,
    seconds: float | None = None,
    seed: int = 0,
) -> RobotMotion:
    """Return the motion of a robot file, a file of a trajectory, or a task by name.

    A task moves with random actions.

    Args:
        what: an MJCF or URDF file or a bundled scene; an .npz of `rb.loading.save_trajectory`; a
            name of `rb.envs.tasks`.
        floating_base: as in `rbjax.load`, for a URDF.
        samples: number of robots of a task.
        seconds: duration of a task; None for one episode, or 10 s of a longer one.
        seed: of the random numbers of a task.

    Raises:
        UnknownName: no such file, scene or task.
        InputError, ModelError: a file that cannot be read.

    Example:
        >>> from rbjax.viewer import motion_of
        >>> motion_of("double_pendulum").model.nq
        2
    """
    text = str(what)
    if text.endswith(".npz"):
        model, trajectory, source = load_trajectory(what)
        shapes = source or drawn_source(model)
        return RobotMotion(model, trajectory, shapes, None, Path(text).stem)
    plain = text.isidentifier() and not Path(text).exists()
    if plain and text not in scenes():
        if text not in tasks():
            both = {"task": [*tasks()], "scene": [*scenes()]}
            raise UnknownName("file, scene or task", text, apart=both)
        options: Any = {"samples": samples, "seconds": seconds, "seed": seed}
        return motion_of_policy(make(text), None, **options)
    model = load(what, floating_base=floating_base or None)
    title = "robot" if text.lstrip().startswith("<") else Path(text).stem
    return RobotMotion(model, None, what, None, title, floating_base)


def motion_of_policy(
    env: Environment,
    policy: Any,
    *,
    samples: int = 1,
    seconds: float | None = None,
    seed: int = 0,
) -> RobotMotion:
    """Return the motion of a policy in its environment.

    Args:
        env: the environment.
        policy: function (observation, key) that returns an action; None for random actions.
        samples: number of robots.
        seconds: duration; None for one episode, or 10 s of a longer one.
        seed: of the random numbers.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.viewer import motion_of_policy
        >>> env = rb.envs.make("cart_pole_balance")
        >>> motion_of_policy(env, None, samples=2, seconds=0.1).trajectory.q.shape
        (2, 11, 2)
    """
    found = record_policy(env, policy, seconds=seconds, samples=samples, seed=seed)
    model, title = env.task.model, env.task.name.replace("_", " ")
    shapes, tracked = drawn_source(model), tracked_body(env)
    return RobotMotion(model, found.trajectory, shapes, found.contacts, title, tracked=tracked)
