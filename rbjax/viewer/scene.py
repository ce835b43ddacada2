"""The nodes of a film on a viser server: bodies, ghosts, tubes, arrows of contacts, ground."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.plotting.film import Film
from rbjax.plotting.solid_shapes import Solid
from rbjax.plotting.surfaces import Surface, surface
from rbjax.plotting.web_page import CROWD
from rbjax.rotations import quaternion
from rbjax.style import RED

Array = np.ndarray
#: with more ghosts their flexible links are not drawn
TUBES = 32
#: opacity of ghosts at the place of the robot, and share of white of their flexible links
_GHOSTLY, _PALE = 0.3, 0.55
#: step between two frames, relative to the picture, that is a reset and not a motion
_JUMP = 0.5


class FilmScene:
    """The robot and the ghosts of a film on a server.

    Args:
        server: a `viser.ViserServer`.
        film: poses, shapes and forces.
    """

    def __init__(self, server: Any, film: Film):
        self.server, self.film = server, film
        self.p = film.p.astype(np.float32)
        self.q = np.asarray(quaternion.from_matrix(jnp.asarray(film.R)), np.float32)
        self.size = float(film.size.max())
        self.ghosts_shown = self.forces_shown = True
        self.spread = 0.0
        first = film.R[0, 0], film.p[0, 0]
        self.bodies = [
            server.scene.add_frame(f"/robot/{k}", show_axes=False) for k in range(self.p.shape[2])
        ]
        for (body, color, alpha), merged in _groups(film.shapes, *first).items():
            name = f"/world/{id(merged)}" if body < 0 else f"/robot/{body}/{id(merged)}"
            self._mesh(name, merged.points, merged.triangles, color, alpha)
        self.tubes, self.ghosts = self._tubes(first), []
        if len(self.p) > 1:
            coarse = len(self.p) > CROWD
            for (body, color, _), merged in _groups(film.shapes, *first, coarse=coarse).items():
                if body >= 0:
                    self.ghosts.append((body, self._crowd(body, color, merged)))
        self.arrows = server.scene.add_arrows(
            "/forces", np.zeros((1, 2, 3)), _bytes(RED), shaft_radius=0.006 * self.size,
            head_radius=0.016 * self.size, head_length=0.04 * self.size, visible=False,
        )  # fmt: skip
        self._ground()
        self.show(0.0)

    @property
    def frames(self) -> int:
        return self.p.shape[1]

    def show(self, at: float, *, ghosts: bool = True) -> None:
        """Show the film at a time in frames; a fraction interpolates between two frames.

        ghosts: whether the ghosts move too.
        """
        k = min(int(at + 1e-6), self.frames - 1)
        after, share = min(k + 1, self.frames - 1), at - k
        p, q = (self._between(k, after, share, slice(0, 1)) if not ghosts or len(self.p) == 1
                else self._between(k, after, share, slice(None)))  # fmt: skip
        self.place(p, q, None if self.film.arrows is None else self.film.arrows[k])

    def place(self, p: Array, q: Array, arrows: Array | None = None) -> None:
        """Place bodies: positions (S, n, 3) and quaternions (S, n, 4), and arrows (n, 2, 3) of the
        first sample, nan for none. With S = 1 the ghosts keep their places."""
        with self.server.atomic():
            for body, node in enumerate(self.bodies):
                node.position, node.wxyz = p[0, body], q[0, body]
            offsets = np.pad(self._offsets(len(p)), ((0, 0), (0, 1)))
            for tube in self.tubes:
                tube.show(p + offsets[:, None], q, ghosts=self.ghosts_shown)
            for body, node in self.ghosts:
                node.visible = self.ghosts_shown
                node.opacity = None if self.spread else _GHOSTLY
                if len(p) > 1 and self.ghosts_shown:
                    node.batched_positions = p[1:, body] + offsets[1:]
                    node.batched_wxyzs = q[1:, body]
            real = None if arrows is None else arrows[~np.isnan(arrows[:, 0, 0])]
            self.arrows.visible = bool(self.forces_shown and real is not None and len(real))
            if self.arrows.visible and real is not None:
                self.arrows.points = real.astype(np.float32)

    def middle(self, at: float) -> Array:
        """Return the middle (3,) of the robot at a time in frames."""
        middle = self.film.centre if self.film.middle is None else self.film.middle
        k = min(int(at), self.frames - 1)
        after = min(k + 1, self.frames - 1)
        return middle[k] + (at - k) * (middle[after] - middle[k])

    def _between(self, k: int, after: int, share: float, samples: slice) -> tuple[Array, Array]:
        p0, p1, q0, q1 = (x[samples, f] for x in (self.p, self.q) for f in (k, after))
        far = np.linalg.norm(p1 - p0, axis=-1, keepdims=True) > _JUMP * self.size
        part = np.where(far, 0.0, share).astype(np.float32)
        q1 = np.where((q0 * q1).sum(-1, keepdims=True) < 0, -q1, q1)
        q = q0 + part * (q1 - q0)
        return p0 + part * (p1 - p0), q / np.linalg.norm(q, axis=-1, keepdims=True)

    def _offsets(self, samples: int) -> Array:
        """Return places (S, 2) on a grid, about that of the first sample."""
        columns = int(np.ceil(np.sqrt(samples)))
        middle = (samples // columns // 2) * columns + columns // 2
        order = np.r_[middle, np.delete(np.arange(max(samples, middle + 1)), middle)][:samples]
        cells = np.stack([order % columns, order // columns], -1)
        return (self.spread * (cells - cells[0])).astype(np.float32)

    def _mesh(self, name: str, points: Array, triangles: Array, color: Any, alpha: float) -> Any:
        return self.server.scene.add_mesh_simple(
            name, points.astype(np.float32), triangles.astype(np.uint32), color=_bytes(color),
            opacity=None if alpha >= 0.99 else alpha, side="double" if alpha >= 0.99 else "front",
        )  # fmt: skip

    def _crowd(self, body: int, color: Any, merged: Surface) -> Any:
        return self.server.scene.add_batched_meshes_simple(
            f"/ghosts/{id(merged)}", merged.points.astype(np.float32),
            merged.triangles.astype(np.uint32), batched_positions=self.p[1:, 0, body],
            batched_wxyzs=self.q[1:, 0, body], batched_colors=_bytes(color), lod="off",
            cast_shadow=False, opacity=_GHOSTLY,
        )  # fmt: skip

    def _tubes(self, first: tuple[Array, Array]) -> list[_Tube]:
        parts: dict[Any, list[Surface]] = defaultdict(list)
        for s in self.film.shapes:
            made = surface(s, *first) if s.end is not None else None
            if made is not None:
                parts[s.color].append(made)
        copies = len(self.p) - 1 if len(self.p) - 1 <= TUBES else 0
        return [_Tube(self, color, _merged(found), copies) for color, found in parts.items()]

    def _ground(self) -> None:
        cell = 10.0 ** np.floor(np.log10(self.size / 2))
        self.server.scene.add_grid(
            "/ground", infinite_grid=True, cell_size=cell, section_size=5 * cell,
            cell_color=(217, 222, 227), section_color=(190, 198, 206), plane_opacity=0.0,
            fade_distance=20 * self.size, position=(0.0, 0.0, self.film.floor),
        )  # fmt: skip


class _Tube:
    """The flexible links of one colour, of the first sample and some ghosts, as meshes in world
    axes whose vertices move."""

    def __init__(self, scene: FilmScene, color: Any, merged: Surface, copies: int):
        self.merged, self.copies = merged, copies
        self.nodes = [
            scene._mesh(
                f"/tubes/{id(self)}/{k}", merged.points, merged.triangles,
                color if k == 0 else tuple(_PALE + (1 - _PALE) * x for x in color), 1.0,
            )
            for k in range(copies + 1)
        ]  # fmt: skip

    def show(self, p: Array, q: Array, *, ghosts: bool) -> None:
        """Move the vertices with the bodies at p (S, n, 3) and q (S, n, 4)."""
        R = np.asarray(quaternion.to_matrix(jnp.asarray(q[: 1 + self.copies])), np.float32)
        bodies, points = self.merged.bodies, self.merged.points
        for node in self.nodes[1:]:
            node.visible = ghosts
        for node, places, turns in zip(self.nodes, p, R, strict=False):
            moved = places[bodies] + np.einsum("nij,nj->ni", turns[bodies], points)
            node.vertices = moved.astype(np.float32)


def _groups(
    shapes: Sequence[Solid], R: Array, p: Array, *, coarse: bool = False
) -> dict[tuple[int, Any, float], Surface]:
    """Merge the surfaces of rigid solids by body, colour and opacity."""
    parts: dict[tuple[int, Any, float], list[Surface]] = defaultdict(list)
    for s in shapes:
        made = surface(s, R, p, coarse=coarse) if s.end is None else None
        if made is not None:
            parts[s.body, tuple(map(float, s.color)), float(s.alpha)].append(made)
    return {key: _merged(found) for key, found in parts.items()}


def _merged(parts: Sequence[Surface]) -> Surface:
    starts = np.cumsum([0, *(len(x.points) for x in parts)])
    triangles = [x.triangles + k for x, k in zip(parts, starts, strict=False)]
    points, normals, bodies = (
        np.concatenate([getattr(x, name) for x in parts])
        for name in ("points", "normals", "bodies")
    )
    return Surface(points, normals, bodies, np.concatenate(triangles))


def _bytes(color: Any) -> tuple[int, int, int]:
    if isinstance(color, str):
        return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)
    red, green, blue = (round(255 * min(max(float(x), 0.0), 1.0)) for x in color)
    return red, green, blue
