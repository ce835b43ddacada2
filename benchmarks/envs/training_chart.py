"""The chart of the trainings: reward of an episode against seconds, with compiling.

    python -m benchmarks.envs.training_chart

reads results/training-*.json of the first of some devices that has one, and writes
docs/guides/figures/training.png.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.shared.timing import RESULTS
from rbjax.style import STYLE

FIGURES = Path(__file__).parents[2] / "docs" / "guides" / "figures"
TITLES = {
    "go1_joystick_flat": "Go1 follows velocity commands",
    "g1_joystick": "G1 follows velocity commands",
    "panda_pick_cube": "Panda brings a cube to a place",
    "cart_pole_swing_up": "Cart-pole swings up",
}
DEVICES = {"nvidia-h200": "H200", "nvidia-h100-80gb-hbm3": "H100"}
NAMES = {"ppo": "PPO (Brax)", "shac": "SHAC"}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--devices", nargs="+", default=list(DEVICES), choices=DEVICES)
    devices = parser.parse_args().devices
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(2, 2, figsize=(9, 5.6), layout="constrained")
        for ax, (task, title) in zip(axes.flat, TITLES.items(), strict=True):
            for algorithm, name in NAMES.items():
                stem = f"training-{task}-{algorithm}".replace("_", "-")
                found = [d for d in devices if (RESULTS / f"{stem}-{d}.json").exists()]
                if not found:
                    continue
                path = RESULTS / f"{stem}-{found[0]}.json"
                (row,) = json.loads(path.read_text())["rows"]
                curve = [p for p in row["curve"] if p["reward"] is not None]
                t, y = (np.array([p[k] for p in curve], float) for k in ("seconds", "reward"))
                keep = np.isfinite(y)
                ax.plot(
                    t[keep], y[keep], marker="o", markersize=3, label=f"{name}, {DEVICES[found[0]]}"
                )
            ax.set(title=title, xlabel="s, with compiling", ylabel="reward of an episode")
            ax.set_xlim(left=0)
            ax.legend()
        figure.savefig(FIGURES / "training.png")


if __name__ == "__main__":
    main()
