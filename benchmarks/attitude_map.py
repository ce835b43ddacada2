"""Where each attitude representation fails: a map of error over attitude, and error over time.

`python -m benchmarks.attitude_map [grid]`: one free body (2 kg, no axis principal) by Lagrange's
equations in every minimal representation, and by two formulations that are singular nowhere.

    acceleration  relative error of the twist's rate at attitudes R_x(a) R_y(b), a and b over a turn
    motion        error of pose and twist after 2 s from there, RK4 with steps of 0.02 s; where no
                  representation is near its singularity, that of RK4 itself
    drift         error of the attitude over 10 s of the asymmetric top of the oracles, RK4, 0.005 s

All against Kirchhoff's equations with steps of a quarter. Writes results/attitude-map.npz (log10 of
the errors, maps (a, b)), its picture, and a table; f64.
"""

from __future__ import annotations

import os

os.environ.setdefault("JAX_ENABLE_X64", "1")

import functools
import sys

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from rich.progress import track

from benchmarks.timing import RESULTS, markdown_table, save
from rbjax import body, spatial
from rbjax.rotations import se3, so3
from tests.oracles import load

SECONDS, STEPS = 2.0, 100
DRIFT_SECONDS, DRIFT_STEPS, KEPT = 10.0, 2000, 100
TWIST = np.array([0.9, -0.6, 0.5, 0.3, -0.2, 0.1])
NAMES = (
    "newton_euler",
    "quasi_lagrange",
    *(name for name in body.formulations() if name.startswith("lagrange_")),
)
FLOOR = 1e-17  # for the logarithm of no error at all


def tilted_box() -> body.Situation:
    """A box whose frame is neither at its centre nor along its axes."""
    T = se3.exp(np.array([0.4, -0.3, 0.5, 0.1, 0.2, -0.1]))
    return body.rigid_body(spatial.moved(T, *spatial.shapes.box([0.3, 0.5, 0.8], mass=2.0)))


def free_top() -> tuple[body.Situation, np.ndarray]:
    """The torque-free top of the oracles, and its twist."""
    case = load("torque_free_top")["cases"]["asym_A (I=1,2,3 generic)"]
    inertia = np.diag(np.array(case["I"], float))
    top = body.Situation(body.Body(np.array(1.0), np.zeros(3), inertia))
    return top, np.r_[np.array(case["omega0"], float), np.zeros(3)]


def runge_kutta(f, situation, y, h, steps):
    """The states after each of the steps."""

    def slope(y):
        return f.rate(0.0, y, situation)

    def along(y, k, h):
        return jax.tree.map(lambda a, b: a + h * b, y, k)

    def step(y, _):
        k1 = slope(y)
        k2 = slope(along(y, k1, h / 2))
        k3 = slope(along(y, k2, h / 2))
        k4 = slope(along(y, k3, h))
        mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
        y = along(y, mean, h)
        return y, y

    return jax.lax.scan(step, y, None, length=steps)


@functools.partial(jax.jit, static_argnums=(0, 3))
def mapped(f, situation, poses, steps):
    """Rate of the twist at each pose (n, 4, 4), and pose and twist 2 s later."""

    def one(T):
        y = f.initial(situation.body, T, TWIST)
        rate = f.rate(0.0, y, situation)
        accelerated = jax.jvp(lambda y: f.twist(situation.body, y), (y,), (rate,))[1]
        end, _ = runge_kutta(f, situation, y, SECONDS / steps, steps)
        return accelerated, f.pose(situation.body, end), f.twist(situation.body, end)

    return jax.vmap(one)(poses)


@functools.partial(jax.jit, static_argnums=(0, 3))
def attitudes(f, situation, twist, steps):
    """R (KEPT, 3, 3) at equal times."""
    y = f.initial(situation.body, jnp.eye(4), twist)
    _, ys = runge_kutta(f, situation, y, DRIFT_SECONDS / steps, steps)
    every = jax.tree.map(lambda x: x[steps // KEPT - 1 :: steps // KEPT], ys)
    return jax.vmap(lambda y: f.pose(situation.body, y)[:3, :3])(every)


def slice_of_attitudes(grid: int) -> tuple[np.ndarray, np.ndarray]:
    """Angles (grid,), and the poses (grid^2, 4, 4) of R_x(a) R_y(b)."""
    angles = np.linspace(-np.pi, np.pi, grid)
    a, b = np.meshgrid(angles, angles, indexing="ij")
    x = so3.exp(np.stack([a, 0 * a, 0 * a], -1).reshape(-1, 3))
    y = so3.exp(np.stack([0 * b, b, 0 * b], -1).reshape(-1, 3))
    return angles, np.asarray(se3.pose(so3.compose(x, y), np.zeros(3)))


def log_error(got, want) -> np.ndarray:
    """log10 of the largest deviation of each; what is not finite counts as 1e3."""
    off = np.abs(np.asarray(got) - np.asarray(want)).reshape(len(want), -1).max(-1)
    return np.log10(np.clip(np.where(np.isfinite(off), off, 1e3), FLOOR, 1e3))


def main(grid: int) -> None:
    angles, poses = slice_of_attitudes(grid)
    box, (top, twist) = tilted_box(), free_top()
    kirchhoff = body.formulations()["kirchhoff"]
    rate, pose, after = mapped(kirchhoff, box, poses, 4 * STEPS)
    turned = attitudes(kirchhoff, top, twist, 4 * DRIFT_STEPS)
    data: dict[str, np.ndarray] = {"angles": angles}
    rows = []
    for name in track(NAMES, description="representations"):
        f = body.formulations()[name]
        got = mapped(f, box, poses, STEPS)
        accelerated = log_error(got[0], rate)
        moved = np.maximum(log_error(got[1], pose), log_error(got[2], after))
        drift = log_error(attitudes(f, top, twist, DRIFT_STEPS), turned)
        data |= {
            f"acceleration/{name}": accelerated.reshape(grid, grid).astype(np.float16),
            f"motion/{name}": moved.reshape(grid, grid).astype(np.float16),
            f"drift/{name}": drift.astype(np.float32),
        }
        rows.append(
            {
                "formulation": name,
                "acceleration, median": float(10 ** np.median(accelerated)),
                "acceleration, worst": float(10 ** accelerated.max()),
                "motion, median": float(10 ** np.median(moved)),
                "motion, worst": float(10 ** moved.max()),
                "share that fails": float(np.mean(moved > -4)),
                "drift, worst": float(10 ** drift.max()),
                "singular where": f.attitude.singular_set,
            }
        )
    data["drift_times"] = np.arange(1, KEPT + 1) * DRIFT_SECONDS / KEPT
    RESULTS.mkdir(exist_ok=True)
    np.savez_compressed(RESULTS / "attitude-map.npz", **data)
    picture(data)
    save("attitude-map", rows)
    print(markdown_table(rows, rows[0]))


def picture(data) -> None:
    """Small multiples of the maps of motion; one colour scale."""
    matplotlib.use("Agg")  # no window
    from matplotlib import pyplot as plt

    columns = 6
    lines = -(-len(NAMES) // columns)
    figure, axes = plt.subplots(lines, columns, figsize=(13, 2.25 * lines), layout="constrained")
    for ax in axes.flat:
        ax.set_axis_off()
    for name, ax in zip(NAMES, axes.flat, strict=False):
        ax.set_axis_on()
        shown = ax.imshow(
            data[f"motion/{name}"].T.astype(float), origin="lower", extent=(-180, 180) * 2,
            vmin=-10, vmax=0, cmap="magma",
        )  # fmt: skip
        ax.set_title(name.removeprefix("lagrange_"), fontsize=8)
        ax.set_xticks([-180, 0, 180])
        ax.set_yticks([-180, 0, 180])
        ax.tick_params(labelsize=6)
    figure.colorbar(shown, ax=axes, shrink=0.4, label="log10 of the error after 2 s")
    figure.supxlabel("a (degrees), first attitude R_x(a) R_y(b)")
    figure.supylabel("b (degrees)")
    figure.savefig(RESULTS / "attitude-map.png", dpi=80)
    plt.close(figure)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 37)
