"""Which formulation of a tumbling body fails where: the error after 10 s, over the first attitude.

`python -m benchmarks.tumbling_map`: a free body turns at half a rad/s for 10 s, from attitudes on
a disc of rotation vectors phi = (phi_x, phi_y, 0), |phi| <= pi: the identity is its centre, half
turns are its rim. Every formulation takes the same 100 steps of Dormand-Prince 8. Free motion is
the same from every attitude, R(t) = R(0) S(t), so that one S, by quaternions at a tenth of the
step, is the truth for all. Beside the error stands how near the motion came to the singularity of
its coordinates. Written to results/ and docs/tumbling_map.png.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import diffrax
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle

from benchmarks.timing import markdown_table, save
from rbjax import body, spatial
from rbjax.body import Formulation, Situation, formulation
from rbjax.plotting import BLUE, GREEN, INK, ORANGE, PURPLE, RED, STYLE, TEAL
from rbjax.rotations import se3, so3

PICTURE = Path(__file__).parents[1] / "docs" / "tumbling_map.png"
SECONDS, STEP, ACROSS = 10.0, 0.1, 41
OFF = 1e-3  # of the grid, so that zyz does not start at the identity, where it is singular
GOOD = 1e-10  # what the formulations agree to where they hold
V0 = np.array([0.26, 0.41, 0.15, 0.0, 0.0, 0.0])
#: formulation -> title, colour
SHOWN = {
    "newton_euler": ("Newton-Euler, quaternion", INK),
    "quasi_lagrange": ("quasi-Lagrange, quaternion", TEAL),
    "lagrange_euler_vector": ("Lagrange, Euler vector", GREEN),
    "lagrange_mrp": ("Lagrange, modified Rodrigues", BLUE),
    "lagrange_gibbs": ("Lagrange, Gibbs vector", PURPLE),
    "lagrange_roll_pitch_yaw": ("Lagrange, roll-pitch-yaw", ORANGE),
    "lagrange_zyz": ("Lagrange, zyz", RED),
}


def situation() -> Situation:
    """A box with three different principal moments."""
    return body.rigid_body(spatial.shapes.box([0.5, 0.9, 1.2], mass=2.0))


def disc(across: int = ACROSS) -> np.ndarray:
    """Rotation vectors (n, 3) of a square grid, up to half a turn and a cell; none singular."""
    x = (np.arange(across) + 0.5) * 2 * np.pi / across - np.pi
    phi = np.stack([*np.meshgrid(x, x), np.zeros((across, across))], -1).reshape(-1, 3)
    return phi[np.linalg.norm(phi, axis=1) < np.pi + 2 * np.pi / across] + OFF


def motion(f: Formulation, step: float = STEP) -> Any:
    """Poses (n, 4, 4) -> attitudes after 10 s, distances to the singularity at the steps."""
    what = situation()

    def run(T: jax.Array) -> tuple[jax.Array, jax.Array]:
        solution = diffrax.diffeqsolve(
            f.term(), diffrax.Dopri8(), 0.0, SECONDS, step, f.initial(what.body, T, V0), what,
            saveat=diffrax.SaveAt(steps=True), max_steps=round(SECONDS / step),
            adjoint=diffrax.ForwardMode(), throw=False,
        )  # fmt: skip
        last = jax.tree.map(lambda x: x[-1], solution.ys)
        return f.pose(what.body, last)[:3, :3], jax.vmap(f.singularity_distance)(solution.ys)

    return jax.jit(jax.vmap(run))


def measure(phi: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Formulation -> error (n,) in rad, least distance (n,) in rad; a motion lost errs by pi."""
    S, _ = motion(formulation("newton_euler"), STEP / 10)(np.eye(4)[None])
    R0 = so3.exp(phi)
    truth = R0 @ S
    T = se3.pose(R0, np.zeros_like(phi))
    out = {}
    for name in SHOWN:
        R, distance = (np.array(x) for x in motion(formulation(name))(T))
        lost = ~np.isfinite(R).all((1, 2))
        R[lost] = np.eye(3)
        least = np.where(lost, 0.0, distance.min(1))
        turn = so3.log(jnp.swapaxes(truth, 1, 2) @ R)
        error = np.where(lost, np.pi, np.linalg.norm(turn, axis=1))
        out[name] = np.maximum(error, 1e-16), least
        print(name, f"median {np.median(error):.1e} rad, worst {error.max():.1e} rad", flush=True)
    return out


def draw(phi: np.ndarray, found: dict[str, tuple[np.ndarray, np.ndarray]], path: Path) -> None:
    """A disc for each formulation, and error against the least distance for all."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(2, 4, figsize=(13, 6.9), layout="constrained")
        side = 2 * np.pi / ACROSS
        x = (np.arange(ACROSS) + 0.5) * side - np.pi
        column, row = np.rint((phi[:, :2] - OFF - x[0]) / side).astype(int).T
        for axis, (name, (title, _)) in zip(axes.flat, SHOWN.items(), strict=False):
            error = found[name][0]
            square = np.full((ACROSS, ACROSS), np.nan)
            square[row, column] = np.log10(error)
            rim = axis.add_patch(Circle((0, 0), 180, fill=False, edgecolor=INK, lw=1))
            shown = axis.pcolormesh(*2 * [np.degrees(x)], square, vmin=-14, vmax=0, cmap="magma")
            shown.set_clip_path(rim)
            axis.set_title(title)
            axis.text(0, -190, f"{(error > GOOD).mean():.1%} err by more than {GOOD:.0e} rad",
                      ha="center", va="top", fontsize=9)  # fmt: skip
            axis.set(aspect="equal", xlim=(-184, 184), ylim=(-225, 184))
            axis.axis("off")
        where = {"color": "white", "fontsize": 9, "ha": "center", "va": "center"}
        axes[0, 0].plot(0, 0, "+", color="white")
        axes[0, 0].text(0, 18, "identity", **where)
        axes[0, 0].text(125, 0, "half a turn\nabout x", **where)
        axes[0, 0].text(0, 145, "half a turn\nabout y", **where)
        law = axes.flat[-1]
        for name, (title, colour) in SHOWN.items():
            error, least = found[name]
            if np.isfinite(least).all():
                law.loglog(np.degrees(least) + 1e-3, error, ".", ms=2, color=colour, alpha=0.6,
                           label=title.split(", ")[1])  # fmt: skip
        law.set(xlabel="nearest to the singularity [deg]", ylabel="error [rad]",
                title="The nearer, the worse", xlim=(0.1, 250))  # fmt: skip
        law.legend(markerscale=5, loc="lower left", fontsize=8, handletextpad=0)
        bar = figure.colorbar(shown, ax=axes, location="left", shrink=0.6, pad=0.02, aspect=30)
        bar.set_label("error of attitude after 10 s, log$_{10}$ rad")
        figure.suptitle(
            "A free body tumbles for 10 s from each attitude on a disc of rotation vectors; "
            "100 equal steps of order 8", x=0.01, ha="left",
        )  # fmt: skip
        figure.savefig(path)
        plt.close(figure)


def text(values: np.ndarray) -> str:
    """Numbers on one line of the results, log10."""
    return " ".join(f"{v:.2f}" for v in np.log10(np.maximum(values, 1e-16)))


def main() -> None:
    phi = disc()
    found = measure(phi)
    rows = [
        {
            "formulation": name,
            "attitudes": len(phi),
            "median_rad": float(np.median(error)),
            "worst_rad": float(error.max()),
            "share_above_1e-10": float((error > GOOD).mean()),
            # of motions that keep a tenth of a radian and more away from the singularity
            "worst_beyond_0.1_rad": float(error[least > 0.1].max()),
            "log10_error_rad": text(error),
            "log10_least_distance_rad": text(least),
        }
        for name, (error, least) in found.items()
    ]
    print(markdown_table(rows, list(rows[0])[:6]))
    draw(phi, found, PICTURE)
    print(save("tumbling-map", rows), PICTURE)


if __name__ == "__main__":
    main()
