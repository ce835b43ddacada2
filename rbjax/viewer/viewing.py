"""`view`: a robot, a motion or a batch in the browser."""

from __future__ import annotations

import threading
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance, integer
from rbjax.model import Model
from rbjax.motion.trajectory import Trajectory
from rbjax.optional import require
from rbjax.plotting.arguments import check_film
from rbjax.plotting.contact_arrows import with_arrows
from rbjax.plotting.drawing import shapes_of
from rbjax.plotting.film import Camera, Film, film, frames
from rbjax.viewer.controls import JointSliders, MotionControls
from rbjax.viewer.scene import FilmScene

_FIELD = np.radians(45.0)


class Viewer:
    """A web server that shows a robot. `view` makes it.

    Attributes:
        url: the address to open in a browser.
        scene: the nodes.
        controls: buttons and sliders.

    `wait()` blocks until an interrupt (Ctrl-C); `stop()` ends the server.
    """

    def __init__(self, server: Any, scene: FilmScene, controls: Any, fps: float):
        self.server, self.scene, self.controls, self.fps = server, scene, controls, fps
        self.url = f"http://{server.get_host()}:{server.get_port()}"
        self._stopped = threading.Event()
        self._error: Exception | None = None
        double = jnp.zeros(()).dtype == jnp.float64  # the flag belongs to a thread
        self._thread = threading.Thread(target=self._run, args=(double,), daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Block until an interrupt, then end the server."""
        try:
            while self._thread.is_alive():
                self._thread.join(0.2)
        except KeyboardInterrupt:
            pass
        self.stop()

    def stop(self) -> None:
        """End the server. If its loop had failed, raise the error of the loop."""
        self._stopped.set()
        self._thread.join()
        self.server.stop()
        if self._error is not None:
            raise self._error

    def _run(self, double: bool) -> None:
        last = time.perf_counter()
        with jax.enable_x64(double):
            while not self._stopped.wait(1 / self.fps):
                now = time.perf_counter()
                try:
                    self.controls.tick(now - last)
                except Exception as error:  # shown by `stop` and `wait`
                    self._error = error
                    return
                last = now


def view(
    model: Model,
    trajectory: Trajectory | None = None,
    *,
    source: Any = None,
    floating_base: bool = False,
    samples: int = 1000,
    contacts: Any = None,
    title: str = "rbjax",
    fps: float = 30.0,
    camera: Camera | None = None,
    follow: bool | None = None,
    tracked: str | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> Viewer:
    """Show a robot in the browser, with joint sliders, or a motion with play, speed and time.

    The package viser is required: `pip install "rbjax[viewer]"`. `rbjax.plotting.animate` writes
    the same view as an HTML page, without viser and without a server.

    Args:
        model: the robot.
        trajectory: of `rollout` or `simulate`; of a batch, the first sample is drawn in full colour
            and the others are ghosts. None shows a posture with a slider for each coordinate.
        source: the argument of `rbjax.load`, to draw the file's geoms, also the model itself. None
            draws rods and ellipsoids of inertia.
        floating_base: as in `rbjax.load`, for a source that is a URDF.
        samples: the largest number of samples of a batch to show.
        contacts: contact forces at the times of the trajectory, as in `rbjax.plotting.animate`.
        title: text above the controls.
        fps: frames per second.
        camera: the line of sight; None chooses one.
        follow: whether the camera moves with the robot; None: only if the robot moves far.
        tracked: name of the body that the camera follows; None for the middle of the robot.
        host: address of the server; "0.0.0.0" lets other machines connect.
        port: its port, or the next free one.

    Returns:
        `Viewer`, whose `url` a browser opens. It runs in the background: call `wait()` at the end
        of a script.

    Raises:
        InputError: viser is not installed, or a trajectory of another model.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> viewer = rb.viewer.view(model, source="double_pendulum")  # doctest: +SKIP
        >>> viewer.stop()  # doctest: +SKIP
    """
    motion = at_rest(model) if trajectory is None else trajectory
    check_film(
        "view", model, motion, fps=fps, speed=1.0, samples=samples, camera=camera, follow=follow,
        tracked=tracked, trace=(), title=title, floating_base=floating_base,
    )  # fmt: skip
    instance("view", "host", host, str, "the address of the server, such as '127.0.0.1'")
    integer("view", "port", port, least=0, most=65535)
    shapes = shapes_of(model, source, floating_base)
    if trajectory is None:
        ts, q = np.zeros(1), np.asarray(model.default_state().q)[None, None]
    else:
        ts, q = frames(model, trajectory, fps, 1.0, samples)
    shown = film(model, ts, q, shapes, camera=camera, follow=follow, tracked=tracked)
    if trajectory is not None:
        shown = with_arrows("view", shown, model, contacts, np.asarray(trajectory.ts, float))
    server = _server(title, host, port)
    scene = FilmScene(server, shown)
    _look(server, shown)
    controls: Any = (
        JointSliders(server, scene, model)
        if trajectory is None
        else MotionControls(server, scene, fps)
    )
    return Viewer(server, scene, controls, fps)


def at_rest(model: Model) -> Trajectory:
    """Return a trajectory of one time: the default state."""
    state = model.default_state()
    return Trajectory(jnp.zeros(1), state.q[None], state.v[None], jnp.array(True))


def check_viser() -> Any:
    """Import viser.

    Raises:
        MissingPackage: it is not installed; the message has the command.
    """
    return require(
        "view",
        "viser",
        "write an HTML page without it: rbjax view ... --out page.html, or rb.plotting.animate",
    )


def _server(title: str, host: str, port: int) -> Any:
    server = check_viser().ViserServer(host=host, port=port, label=title, verbose=False)
    server.scene.set_up_direction("+z")
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def _look(server: Any, shown: Film) -> None:
    """Place the camera of new browsers so that the picture fits."""
    half = 0.6 * float(shown.size.max())
    eye = shown.camera.axes[2] * (half / np.tan(_FIELD / 2) + half)
    server.initial_camera.look_at = shown.centre[0]
    server.initial_camera.position = shown.centre[0] + eye
    server.initial_camera.fov = float(_FIELD)
