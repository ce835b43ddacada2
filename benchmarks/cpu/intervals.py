"""How often 95 % intervals hold the truth: simulated experiments with three robots, and with one
robot in eight settings.

`python -m benchmarks.cpu.intervals [ROBOT ...] [--full]` writes
results/cpu-intervals-<robot>-<processor>.json, and `... settings`
results/cpu-intervals-settings-<processor>.json; --full has 500 experiments of a robot and 200 of a
setting, the default 20 and 5, in results of their own. Each experiment is simulated with
the true numbers, gets its own noise, and is fitted from the user's guess, by all that `identify`
does; asked is a share from 0.93 to 0.97. "lowest" and "highest" are of a single unknown, where 500
experiments leave an error of 0.01. The ratio is the scatter of the numbers found over the standard
deviations that the fits claim. The settings (`benchmarks/shared/coverage.py`): models in float32
and float64, noise stated and estimated, 5 % outliers with loss="huber", dry friction.
"""

import argparse
import time
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import rbjax as rb  # noqa: E402
from benchmarks.shared.coverage import SETTINGS, coverage  # noqa: E402
from benchmarks.shared.progress import add_full, progress, sized  # noqa: E402
from benchmarks.shared.timing import markdown_table, save  # noqa: E402
from rbjax.sysid import (  # noqa: E402
    Channel,
    Grid,
    Recording,
    Setup,
    Unknown,
    identify,
    monte_carlo,
)
from rbjax.sysid.simulation.setup import simulate_motion  # noqa: E402

COLUMNS = (
    "robot", "unknowns", "starts", "experiments", "coverage", "lowest", "highest", "ratio",
    "failed", "seconds",
)  # fmt: skip
NOISE = 2e-3


def double_pendulum() -> tuple[Setup, rb.State, Any, dict[str, Any], Grid]:
    """A free swing; damping, and mass and lever of the second link."""
    model = rb.load("double_pendulum")
    start = rb.State(jnp.array([1.0, 0.5]), jnp.zeros(2))
    sought = {
        "damping": Unknown("joints.damping"),
        "mass": Unknown("bodies.mass", 1, positive=True),
        "lever": Unknown("bodies.com", (1, 2)),
    }
    return Setup.of(model), start, np.zeros((200, 0)), sought, Grid(0.01)


def cart_pole() -> tuple[Setup, rb.State, Any, dict[str, Any], Grid]:
    """Pushed to and fro, late; masses, damping, delay, bias of the pole's encoder."""
    model = rb.load("cart_pole")
    t = np.arange(200) * 0.01
    push = 4 * np.sin(2 * np.pi * (1 + t) * t)[:, None]
    start = rb.State(jnp.array([0.0, 3.0]), jnp.zeros(2))
    sought = {
        "mass": Unknown("bodies.mass", positive=True),
        "damping": Unknown("joints.damping"),
        "delay": Unknown("delay", bounds=(0.0, 0.03)),
        "bias": Unknown("sensors.q.bias", 1, scale=0.1),
    }
    return Setup.of(model, delay=0.013), start, push, sought, Grid(0.01, longest_delay=3)


def arm7() -> tuple[Setup, rb.State, Any, dict[str, Any], Grid]:
    """Its servos follow waves from rest; armature and damping of joints, a payload."""
    model = rb.load("arm7")
    model = model.replace(joints=model.joints.replace(
        armature=jnp.full(7, 0.1), damping=jnp.full(7, 0.5)
    ))  # fmt: skip
    t, k = np.arange(200)[:, None] * 0.01, np.arange(7)
    wave = 0.5 * np.sin(2 * np.pi * (0.7 + 0.15 * k) * t + k)
    start = rb.State(jnp.asarray(wave[0]), jnp.zeros(7))
    sought = {
        "armature": Unknown("joints.armature", positive=True),
        "damping": Unknown("joints.damping", positive=True),
        "payload": Unknown("bodies.mass", model.nb - 1, positive=True),
    }
    return Setup.of(model), start, wave, sought, Grid(0.01, 3)


def row(make: Any, experiments: int) -> dict[str, Any]:
    setup, start, ctrl, sought, grid = make()
    begin = time.perf_counter()
    t = np.arange(len(ctrl) + 1) * grid.period
    path = simulate_motion(lambda p: setup, jnp.zeros(1), start, jnp.asarray(ctrl), grid)
    noise = NOISE * np.random.default_rng(1).normal(size=path.q.shape)
    at_rest = make is arm7  # its start is known
    if at_rest:
        noise[0] = 0.0
    channels = {"q": Channel(t, path.q + noise, noise=np.full(setup.model.nq, NOISE))}
    if at_rest:
        v = np.vstack([start.v, np.full((len(t) - 1, 7), np.nan)])
        channels["v"] = Channel(t, v, noise=np.ones(7), dropped="nan")
    if ctrl.shape[1]:
        channels["ctrl"] = Channel(t[:-1], ctrl)
    found = identify(setup, Recording("one", channels), sought, grid=grid)
    again = monte_carlo(found, experiments, progress=True)
    shares = [*again.by_name.values()]
    ratio = again.scatter / np.sqrt((again.sigma**2).mean(0))
    return {
        "robot": make.__name__, "unknowns": len(again.names),
        "starts": found.error.size - len(again.names), "experiments": experiments,
        "coverage": again.coverage, "lowest": min(shares), "highest": max(shares),
        "ratio": f"{ratio.min():.3f} to {ratio.max():.3f}", "failed": again.failed,
        "seconds": time.perf_counter() - begin, "by name": again.by_name,
    }  # fmt: skip


ROBOTS = {make.__name__: make for make in (double_pendulum, cart_pole, arm7)}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    choices = [*ROBOTS, "settings"]
    parser.add_argument("robots", nargs="*", choices=[*choices, []], help="all if left out")
    parser.add_argument("--experiments", type=int, help="another number of them")
    add_full(parser, "500 experiments of a robot, 200 of a setting", "20 and 5")
    args = parser.parse_args()
    of_robot, of_setting = (args.experiments or x for x in ((500, 200) if args.full else (20, 5)))
    full = args.full and not args.experiments
    for name in progress(args.robots or choices):
        if name == "settings":
            rows = [
                coverage(setting, of_setting)
                for setting in progress(SETTINGS, lambda setting: setting.name)
            ]
            print(markdown_table(rows, tuple(rows[0])), flush=True)
            save(sized("cpu-intervals-settings", full), rows)
            continue
        found = row(ROBOTS[name], of_robot)
        print(markdown_table([found], COLUMNS), flush=True)
        save(sized(f"cpu-intervals-{name}", full), [found])
