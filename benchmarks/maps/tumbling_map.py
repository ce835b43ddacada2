"""Failures of representations of attitude: the error after a tumble, over the first attitude.

`python -m benchmarks.maps.tumbling_map`, some minutes on one core. A free body turns at half a
rad/s for 10 s, from attitudes on a disc of rotation vectors phi = (phi_x, phi_y, 0), |phi| <= pi,
with the identity in its centre and half turns on its rim. Each representation integrates
x' = E^-1(x) omega with Euler's equations for omega. Some formulations of the whole body are
included. All take the same 100 steps of Dormand-Prince 8. Free motion is the same from every
attitude, R(t) = R(0) S(t), so one S, by quaternions at a tenth of the step, is the truth for all.
The results also have the smallest distance to the singularity. They go to results/ and
docs/benchmarks/figures/tumbling_map.png.
"""

from __future__ import annotations

import argparse
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

from benchmarks.shared.charts import PAGE, save_chart, saved
from benchmarks.shared.timing import markdown_table, save
from rbjax import body, spatial
from rbjax.body import Formulation, formulation
from rbjax.plotting import BLUE, GREEN, INK, ORANGE, PURPLE, RED, STYLE, TEAL
from rbjax.rotations import quaternion, representations, se3
from rbjax.rotations.representation import Representation

PICTURE = Path(__file__).parents[2] / "docs" / "benchmarks" / "figures" / "tumbling_map.png"
SECONDS, STEP, ACROSS = 10.0, 0.1, 33
OFF = 1e-3  # offset of the grid, so that no motion starts at a singularity
GOOD = 1e-10  # difference between representations that do not fail
#: a box with three different principal moments, and its body rates
BODY = body.rigid_body(spatial.shapes.box([0.5, 0.9, 1.2], mass=2.0))
OMEGA = np.array([0.26, 0.41, 0.15])
TITLES = {
    "rotation_matrix": "matrix", "unit_quaternion": "quaternion",
    "unit_quaternion_xyzw": "scalar last", "axis_angle": "axis, angle",
    "two_columns": "two columns", "euler_vector": "Euler vector", "gibbs": "Gibbs",
    "cayley": "Cayley", "mrp": "mod. Rodrigues", "wiener_milenkovic": "Milenkovic",
    "roll_pitch_yaw": "roll-pitch-yaw",
    "newton_euler": "Newton-Euler", "quasi_lagrange": "quasi-Lagrange",
    "lagrange_euler_vector": "L., Euler v.", "lagrange_mrp": "L., mod. R.",
    "lagrange_gibbs": "L., Gibbs", "lagrange_roll_pitch_yaw": "L., r-p-y",
    "lagrange_zyz": "L., zyz",
}  # fmt: skip
FORMULATIONS = tuple(TITLES)[-7:]
#: families with their own panel, and its colour
FAMILIES = {
    "more than three numbers": PURPLE, "vectorial": GREEN,
    "Tait-Bryan angles": BLUE, "proper Euler angles": RED,
}  # fmt: skip
VECTORIAL = {
    "euler_vector": GREEN, "gibbs": PURPLE, "cayley": ORANGE, "mrp": BLUE,
    "wiener_milenkovic": TEAL,
}  # fmt: skip

Found = dict[str, tuple[np.ndarray, np.ndarray]]


def family(name: str) -> str:
    """One of `FAMILIES`, or "formulation"."""
    if name in FORMULATIONS:
        return "formulation"
    rep = representations()[name]
    if rep.size > 3:
        return "more than three numbers"
    proper = getattr(rep.formulas, "proper", None)
    if proper is None:
        return "vectorial"
    return "proper Euler angles" if proper else "Tait-Bryan angles"


def disc(across: int = ACROSS) -> np.ndarray:
    """Rotation vectors (n, 3) of a square grid, up to half a turn and a cell; none singular."""
    x = (np.arange(across) + 0.5) * 2 * np.pi / across - np.pi
    phi = np.stack([*np.meshgrid(x, x), np.zeros((across, across))], -1).reshape(-1, 3)
    return phi[np.linalg.norm(phi, axis=1) < np.pi + 2 * np.pi / across] + OFF


def kinematics(rep: Representation, step: float = STEP) -> Any:
    """Quaternions (n, 4) -> those after 10 s, and distances to the singularity at the steps."""
    moments = np.diag(BODY.body.inertia)

    def rate(t: Any, y: Any, args: Any) -> Any:
        x, omega = y
        turning = (rep.inverse_body_rate_matrix(x) * omega).sum(-1)
        return turning, jnp.cross(moments * omega, omega) / moments

    def run(q: jax.Array) -> tuple[jax.Array, jax.Array]:
        x, _ = _steps(diffrax.ODETerm(rate), (rep.from_quaternion(q), jnp.asarray(OMEGA)), step)
        return rep.to_quaternion(x[-1]), jax.vmap(rep.singularity_distance)(x)

    return jax.jit(jax.vmap(run))


def equations(f: Formulation) -> Any:
    """The same by a formulation of the whole body."""

    def run(q: jax.Array) -> tuple[jax.Array, jax.Array]:
        T = se3.pose(quaternion.to_matrix(q), jnp.zeros(3))
        V = jnp.concatenate([jnp.asarray(OMEGA), jnp.zeros(3)])
        ys = _steps(f.term(), f.initial(BODY.body, T, V), STEP)
        R = f.pose(BODY.body, jax.tree.map(lambda x: x[-1], ys))[:3, :3]
        return quaternion.from_matrix(R), jax.vmap(f.singularity_distance)(ys)

    return jax.jit(jax.vmap(run))


def _steps(term: Any, y0: Any, step: float) -> Any:
    """The states after each step."""
    return diffrax.diffeqsolve(
        term, diffrax.Dopri8(), 0.0, SECONDS, step, y0, BODY, saveat=diffrax.SaveAt(steps=True),
        max_steps=round(SECONDS / step), adjoint=diffrax.ForwardMode(), throw=False,
    ).ys  # fmt: skip


def measure(phi: np.ndarray) -> Found:
    """Name -> error (n,) in rad, smallest distance (n,) in rad; a lost motion has the error pi."""
    reps = representations()
    S, _ = kinematics(reps["unit_quaternion"], STEP / 10)(quaternion.identity()[None])
    q0 = quaternion.exp(phi)
    truth = quaternion.multiply(q0, S)
    runs = {name: kinematics(rep) for name, rep in reps.items()}
    runs |= {name: equations(formulation(name)) for name in FORMULATIONS}
    out = {}
    for name, run in runs.items():
        q, distance = (np.array(x) for x in run(q0))
        lost = ~(np.isfinite(q).all(1) & (np.abs(q).max(1) > 0))
        q[lost] = [1.0, 0.0, 0.0, 0.0]
        least = np.where(lost, 0.0, np.nan_to_num(distance, nan=0.0, posinf=np.inf).min(1))
        error = np.where(lost, np.pi, quaternion.distance(truth, q))
        out[name] = np.maximum(error, 1e-16), least
        print(name, f"median {np.median(error):.1e} rad, worst {error.max():.1e} rad", flush=True)
    return out


def draw(phi: np.ndarray, found: Found, shares: dict[str, float], path: Path) -> None:
    """A disc for each with the share of failures; for each family the error by the distance."""
    names = list(found)
    groups = {
        "More than three numbers": (0, 0, names[:5]), "Euler angles by name": (0, 5, names[10:12]),
        "Vectorial": (1, 0, names[5:10]),
        "Intrinsic Tait-Bryan angles": (2, 0, names[12:18]),
        "Intrinsic proper Euler angles": (3, 0, names[18:24]),
        "Extrinsic Tait-Bryan angles": (4, 0, names[24:30]),
        "Extrinsic proper Euler angles": (5, 0, names[30:36]),
        "Formulations of the body: in quaternions, and Lagrange's (L.) in three numbers":
            (6, 0, names[36:]),
    }  # fmt: skip
    with plt.rc_context(STYLE):
        figure = plt.figure(figsize=(PAGE, 17.5), layout="constrained")
        upper, lower = figure.subfigures(2, 1, height_ratios=[11.2, 6])
        discs = upper.subplots(7, 7)
        for axis in discs.flat:
            axis.axis("off")
        for title, (row, column, members) in groups.items():
            for axis, name in zip(discs[row, column:], members, strict=False):
                shown = _disc(axis, phi, found[name][0], shares[name])
                axis.text(0, 192, TITLES.get(name, name.split("_")[-1]), ha="center", fontsize=8.5)
            discs[row, column].text(-184, 262, title, weight="bold", in_layout=False)
        where = {"color": "white", "fontsize": 7, "ha": "center", "va": "center"}
        discs[0, 0].plot(0, 0, "+", color="white")
        discs[0, 0].text(-22, -42, "identity", **where)
        discs[0, 0].text(112, 0, "half\nturn\nby x", **where)
        discs[0, 0].text(0, 118, "half turn\nby y", **where)
        discs[1, 5].text(
            0.1, 0.75, "A plain disc is right to\n14 digits. Below each disc:\nthe share of starts "
            f"that\nend off by more than\n{GOOD:.0e} rad.", va="top", in_layout=False, fontsize=9,
            transform=discs[1, 5].transAxes,
        )  # fmt: skip
        bar = upper.colorbar(shown, ax=discs, location="bottom", shrink=0.6, pad=0.01, aspect=40)
        bar.set_label("error of attitude after 10 s, log$_{10}$ rad")
        laws = lower.subplots(2, 2, sharex=True, sharey=True)
        for law, kind in zip(laws.flat, FAMILIES, strict=True):
            law.set_title(kind[0].upper() + kind[1:])
            for name, (error, least) in found.items():
                if family(name) == kind and np.isfinite(least).all():
                    colour = VECTORIAL.get(name, TEAL if name == "two_columns" else FAMILIES[kind])
                    named = None if kind.endswith("angles") else TITLES[name]
                    law.loglog(np.degrees(least) + 1e-3, error, ".", ms=2, color=colour, alpha=0.5,
                               label=named)  # fmt: skip
            law.set(xlim=(0.1, 400))
            law.axhline(GOOD, color=INK, lw=0.8, ls=":")
            if law.get_legend_handles_labels()[1]:
                law.legend(markerscale=5, loc="lower left", handletextpad=0)
        for law in laws[1]:
            law.set_xlabel("nearest to the singularity on the way [deg]")
        for law in laws[:, 0]:
            law.set_ylabel("error [rad]")
        figure.suptitle(
            "A free body tumbles for 10 s from each attitude on a disc of rotation vectors,\n"
            "by 100 equal steps of order 8", x=0.01, ha="left",
        )  # fmt: skip
        save_chart(figure, path, colors=0)


def _disc(axis: Any, phi: np.ndarray, error: np.ndarray, share: float) -> Any:
    side = 2 * np.pi / ACROSS
    x = (np.arange(ACROSS) + 0.5) * side - np.pi
    column, row = np.rint((phi[:, :2] - OFF - x[0]) / side).astype(int).T
    square = np.full((ACROSS, ACROSS), np.nan)
    square[row, column] = np.log10(error)
    rim = axis.add_patch(Circle((0, 0), 180, fill=False, edgecolor=INK, lw=0.8))
    shown = axis.pcolormesh(*2 * [np.degrees(x)], square, vmin=-14, vmax=0, cmap="magma")
    shown.set_clip_path(rim)
    axis.text(0, -192, f"{share:.1%}", ha="center", va="top", fontsize=8)
    axis.set(aspect="equal", xlim=(-184, 184), ylim=(-235, 310))
    axis.axis("off")
    return shown


def report(found: Found) -> list[dict[str, Any]]:
    """The failures: a row for each representation and formulation."""
    rows = []
    for name, (error, least) in found.items():
        rep = formulation(name).attitude if name in FORMULATIONS else representations()[name]
        failed, far = error > GOOD, least > 0.1
        rows.append({
            "name": name,
            "family": family(name),
            "share_above_1e-10": float(failed.mean()),
            "worst_rad": float(error.max()),
            "median_rad": float(np.median(error)),
            # the largest distance from its singularity of a motion that failed
            "failed_within_rad": float(least[failed].max()) if failed.any() else None,
            "worst_beyond_0.1_rad": float(error[far].max()) if far.any() else None,
            "singular": rep.singular_set,
        })  # fmt: skip
    return rows


def text(values: np.ndarray, digits: int) -> str:
    """Numbers on one line of the results, log10."""
    return " ".join(f"{v:.{digits}f}" for v in np.log10(np.maximum(values, 1e-16)))


def numbers(line: str | None) -> np.ndarray:
    """The numbers of a line of the results, which are their log10; infinity for None."""
    return np.array([np.inf]) if line is None else 10.0 ** np.array(line.split(), float)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draw", action="store_true", help="only draw the saved results again")
    phi = disc()
    if parser.parse_args().draw:
        keys = ("log10_error_rad", "log10_least_distance_rad")
        rows = saved("tumbling-map-*.json")
        kept = {row["name"]: (numbers(row[keys[0]]), numbers(row[keys[1]])) for row in rows}
        draw(phi, kept, {row["name"]: row["share_above_1e-10"] for row in rows}, PICTURE)
        return
    found = measure(phi)
    rows = report(found)
    print(markdown_table(rows, rows[0]))
    draw(phi, found, {row["name"]: row["share_above_1e-10"] for row in rows}, PICTURE)
    for row, (error, least) in zip(rows, found.values(), strict=True):
        row["log10_error_rad"] = text(error, 1)
        near = np.isfinite(least).all()
        row["log10_least_distance_rad"] = text(least, 2) if near else None
    print(save("tumbling-map", rows), PICTURE)


if __name__ == "__main__":
    main()
