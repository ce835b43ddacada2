"""A server without a network: it records nodes and controls as plain objects."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any


class Handle(SimpleNamespace):
    def on_click(self, f: Any) -> None:
        self.click = lambda: f(None)


class FalseServer:
    """The part of `viser.ViserServer` that a viewer uses."""

    def __init__(self) -> None:
        self.nodes: dict[str, Handle] = {}
        self.clients: dict[int, Any] = {}
        self.scene, self.gui = self, self

    def atomic(self) -> Any:
        return nullcontext()

    def get_clients(self) -> dict[int, Any]:
        return self.clients

    def _node(self, name: str, given: dict[str, Any]) -> Handle:
        assert name not in self.nodes
        self.nodes[name] = Handle(**given)
        return self.nodes[name]

    def add_frame(self, name: str, **given: Any) -> Handle:
        return self._node(name, {"position": None, "wxyz": None} | given)

    def add_mesh_simple(self, name: str, vertices: Any, faces: Any, **given: Any) -> Handle:
        return self._node(name, {"vertices": vertices, "faces": faces} | given)

    def add_batched_meshes_simple(self, name: str, vertices: Any, faces: Any, **given: Any) -> Any:
        return self._node(name, {"vertices": vertices, "faces": faces} | given)

    def add_arrows(self, name: str, points: Any, colors: Any, **given: Any) -> Handle:
        return self._node(name, {"points": points} | given)

    def add_grid(self, name: str, **given: Any) -> Handle:
        return self._node(name, given)

    def add_folder(self, label: str) -> Any:
        return nullcontext()

    def add_button(self, label: str) -> Handle:
        return Handle(label=label)

    def add_slider(
        self, label: str, min: float, max: float, step: float, initial_value: float, **given: Any
    ) -> Handle:
        return Handle(label=label, min=min, max=max, value=initial_value, **given)

    def add_checkbox(self, label: str, initial_value: bool, **given: Any) -> Handle:
        return Handle(label=label, value=initial_value, **given)

    def add_dropdown(self, label: str, options: Any, initial_value: str, **given: Any) -> Handle:
        return Handle(label=label, options=options, value=initial_value, **given)
