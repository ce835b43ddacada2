"""Controls of a viewer. The loop of the viewer reads them; they call nothing."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics import forward_kinematics, integrate
from rbjax.flexible.strain import StrainBeam
from rbjax.model import Model
from rbjax.plotting.flexible_links import flexible_links, station_poses
from rbjax.rotations import quaternion
from rbjax.viewer.scene import FilmScene

SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
#: seconds at the end of a motion before it begins again
_REST = 0.7


class MotionControls:
    """Play, time, speed, follow, contact forces, ghosts, spread."""

    def __init__(self, server: Any, scene: FilmScene, fps: float):
        self.server, self.scene, self.fps = server, scene, fps
        self.duration = (scene.frames - 1) / fps
        self.time, self.pressed = 0.0, 0
        gui = server.gui
        self.play = gui.add_button("stop")
        self.play.on_click(self._press)
        self.playing = True
        step = max(self.duration / 1000, 1e-4)
        self.slider = gui.add_slider("time [s]", 0.0, max(self.duration, step), step, 0.0)
        self.speed = gui.add_dropdown("speed", SPEEDS, initial_value="1")
        self.follow = gui.add_checkbox("follow", initial_value=scene.film.follow)
        has_forces, has_ghosts = scene.film.arrows is not None, len(scene.p) > 1
        self.forces = gui.add_checkbox("contact forces", True, visible=has_forces)
        label = f"{len(scene.p) - 1:,} ghosts"
        self.ghosts = gui.add_checkbox(label, True, visible=has_ghosts)
        self.spread = gui.add_slider("spread", 0.0, 1.0, 0.01, 0.0, visible=has_ghosts)
        self.written = 0.0
        self.drawn: tuple[float, ...] | None = None
        self.last_middle, self.slow = scene.middle(0.0), 0

    def _press(self, event: Any) -> None:
        self.pressed += 1

    def tick(self, passed: float) -> None:
        """Advance by a time that has passed, s, and draw what has changed."""
        if self.pressed:
            self.playing ^= bool(self.pressed % 2)
            self.pressed = 0
            self.play.label = "stop" if self.playing else "play"
        if abs(self.slider.value - self.written) > 1e-9:  # the user moved it
            self.time, self.playing = float(self.slider.value), False
            self.play.label = "play"
        elif self.playing:
            self.time += passed * float(self.speed.value)
            if self.time > self.duration + _REST * float(self.speed.value):
                self.time = 0.0
        now = min(self.time, self.duration)
        self.written = self.slider.value = round(now, 6)
        wanted = (
            now, self.forces.value, self.ghosts.value, self.spread.value, self.follow.value,
        )  # fmt: skip
        if wanted == self.drawn:
            return
        scene, changed = self.scene, self.drawn is None or wanted[1:] != self.drawn[1:]
        scene.forces_shown, scene.ghosts_shown = bool(wanted[1]), bool(wanted[2])
        scene.spread = 2 * scene.size * float(wanted[3]) ** 2
        self.slow += 1
        few = len(scene.p) <= 300
        scene.show(now * self.fps, ghosts=few or changed or not self.playing or self.slow % 3 == 0)
        self._follow(now * self.fps)
        self.drawn = wanted

    def _follow(self, at: float) -> None:
        middle = self.scene.middle(at)
        moved, self.last_middle = middle - self.last_middle, middle
        if self.follow.value and np.abs(moved).max() > 1e-6:
            for client in self.server.get_clients().values():
                client.camera.position = client.camera.position + moved


class JointSliders:
    """A slider for each velocity coordinate of a robot, from its default state."""

    def __init__(self, server: Any, scene: FilmScene, model: Model):
        self.scene, self.model = scene, model
        self.start = model.default_state().q
        self.integrate = jax.jit(integrate)
        self.kinematics = jax.jit(jax.vmap(forward_kinematics, (None, 0)))
        gui, self.pressed = server.gui, False
        self.reset = gui.add_button("reset")
        self.reset.on_click(self._press)
        self.sliders: list[Any] = []
        names = ("default state", *model.keyframe_names)
        self.keyframe = gui.add_dropdown(
            "state", names, initial_value=names[0], visible=len(names) > 1
        )
        self.chosen = names[0]
        with gui.add_folder("joints"):
            for label, low, high in ranges(model, self.start, scene.size):
                step = (high - low) / 500
                self.sliders.append(
                    gui.add_slider(label, low, high, step, min(max(0.0, low), high))
                )
        self.drawn: tuple[float, ...] | None = None

    def _press(self, event: Any) -> None:
        self.pressed = True

    def tick(self, passed: float) -> None:
        """Draw the posture of the sliders if it has changed."""
        if self.keyframe.value != self.chosen:
            self.chosen, self.pressed = self.keyframe.value, True
            is_default = self.chosen == "default state"
            state = self.model.default_state() if is_default else self.model.keyframe(self.chosen)
            self.start, self.drawn = state.q, None
        if self.pressed:
            self.pressed = False
            for slider in self.sliders:
                slider.value = min(max(0.0, slider.min), slider.max)
        wanted = tuple(float(s.value) for s in self.sliders)
        if wanted != self.drawn:
            self.scene.place(*self.poses(wanted))
            self.drawn = wanted

    def poses(self, moved: Any) -> tuple[np.ndarray, np.ndarray]:
        """Compute positions (1, n, 3) and quaternions (1, n, 4) at a displacement (nv,)."""
        q = self.integrate(self.model, self.start, np.asarray(moved, self.start.dtype))
        R, p = self.kinematics(self.model, q[None])
        R, p = station_poses(
            self.model, np.asarray(R, float), np.asarray(p, float), np.asarray(q)[None]
        )
        return p.astype(np.float32), np.asarray(quaternion.from_matrix(jnp.asarray(R)), np.float32)


def ranges(model: Model, q: Any, size: float) -> list[tuple[str, float, float]]:
    """Return the label, the least and the greatest displacement of each velocity coordinate.

    A hinge and a slide have the range of the file, otherwise half a turn or the size of the
    picture. Displacements are from q (nq,).
    """
    limits, out = np.asarray(model.joints.range, float), []
    lengths = {
        link.body: float(np.ravel(link.joint.named(link.params)["length"])[0])
        for link in flexible_links(model)
        if isinstance(link.joint, StrainBeam)
    }
    top = model.topology
    for j, (name, kind) in enumerate(zip(top.joint_names, top.joint_kinds, strict=True)):
        count = top.joints[j].nv
        if kind in ("hinge", "slide"):
            low, high = limits[j] - float(q[model.q_slice(name)][0])
            reach = math.pi if kind == "hinge" else size
            low, high = (low, high) if np.isfinite([low, high]).all() else (-reach, reach)
            out.append((name, float(low), float(max(high, low + 1e-6))))
        elif kind == "free":
            out += [(f"{name} {axis} [m]", -size, size) for axis in "xyz"]
            out += [(f"{name} turn {axis}", -math.pi, math.pi) for axis in "xyz"]
        elif kind == "ball":
            out += [(f"{name} turn {axis}", -math.pi, math.pi) for axis in "xyz"]
        else:
            reach = math.pi / lengths.get(top.joint_bodies[j], math.pi)
            out += [(f"{name} {k}", -reach, reach) for k in range(count)]
    return out
