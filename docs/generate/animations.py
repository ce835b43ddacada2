"""The animations: each is one HTML file of at most 300 kB, which plays without a network.

`python -m docs.generate.animations [NAME ...]` simulates the motions, which takes minutes, and
stores them in `docs/generate/motions`. The pages are made of them when the site is built.
"""

from __future__ import annotations

import argparse
import dataclasses
import html
import json
import re
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDER = Path(__file__).parent / "motions"
LARGEST = 300_000

PALM = """<mujoco><option gravity="0 0 0"/><worldbody>
  <geom type="cylinder" size="0.06 0.01" pos="0 0 0.15" rgba="0.45 0.5 0.55 1"/>
  </worldbody></mujoco>"""


def walking(path: Path) -> None:
    """A Go1 follows velocity commands, by the policy of the notebook `walking_policy`."""
    import rbjax as rb
    from rbjax.envs import learning

    env, policy = learning.load_policy(ROOT / "notebooks" / "data" / "go1_policy")
    rb.plotting.animate_policy(env, policy, path, seconds=8.0, fps=25, title="A policy walks")


def grasping(path: Path) -> None:
    """Two fingers press on a cube, and the hand lifts it by friction."""
    import jax
    import jax.numpy as jnp

    import rbjax as rb
    from docs.generate.pictures.motions import GRIPPER

    model = rb.load(GRIPPER)
    t = 0.002 * jnp.arange(1500)
    lift = 0.15 * jnp.clip((t - 0.3) / 0.7, 0.0, 1.0)
    turn, grip = jnp.zeros(1500), jnp.full(1500, 5.0)
    commands = jnp.stack([lift, turn, grip, grip], -1)
    start = model.default_state()
    run = rb.rollout(model, start, commands, 0.002, contact="coulomb", save_every=20)

    def touch(q, v, u):
        return rb.contact.solve(model, rb.State(q, v), u, contact="coulomb").contacts

    given = jnp.concatenate([commands[::20], commands[-1:]])
    found = jax.vmap(touch)(run.q, run.v, given)
    camera = rb.plotting.Camera(-70, 12)
    title = "A gripper lifts a cube"
    rb.plotting.animate(
        model, run, path, source=GRIPPER, contacts=found, camera=camera, title=title
    )


def wheels(path: Path) -> None:
    """A car pulls a trailer round a figure of eight, by Stanley's law."""
    import jax
    import jax.numpy as jnp

    import rbjax as rb

    robot = rb.wheeled.kinds()["car_trailer"].make(motor=rb.wheeled.SpeedServo(2000.0), lag=0.1)
    model = rb.wheeled.at(robot, "reduced")
    s = jnp.linspace(0, 2 * jnp.pi, 400)
    x, y = 11.0 * jnp.sin(s), 5.5 * jnp.sin(2 * s)
    heading = jnp.unwrap(jnp.arctan2(11.0 * jnp.cos(2 * s), 11.0 * jnp.cos(s)))
    eight = jnp.stack([x, y, heading], -1)

    def control(t, state):
        wanted = rb.wheeled.commands(robot, rb.wheeled.stanley(eight, state.q[:3], 4.0, 2.6))
        return jnp.concatenate([wanted.speeds, wanted.angles])

    start = rb.wheeled.start(model, pose=eight[0], twist=[4.0, 0.0, 0.0])
    run = rb.wheeled.rollout(model, start, control, 0.005, steps=3200, save_every=8)
    full = jax.vmap(lambda q, v: rb.wheeled.full_model_state(model, rb.State(q, v), base="free"))(
        run.q, run.v
    )
    shown = dataclasses.replace(run, q=full.q, v=full.v)
    file = rb.wheeled.write_mjcf(robot)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the file's contacts and equalities are not needed
        drawn = rb.load(file, contacts=False)
    camera, title = rb.plotting.Camera(-60, 35), "A car and its trailer"
    rb.plotting.animate(
        drawn, shown, path, source=file, title=title, speed=2.0, camera=camera, trace="chassis"
    )


def beams(path: Path) -> None:
    """Three soft fingers close as their tendons pull."""
    import jax.numpy as jnp
    import numpy as np

    import rbjax as rb
    from rbjax.flexible import beam, circle

    nodes = 0.5 + 0.5 * np.polynomial.legendre.leggauss(7)[0]
    soft = circle(0.009 - 0.003 * nodes, E=4e5, nu=0.48, density=1100.0)
    finger = beam(0.12, soft, {"k_y": 2}, damping=0.05, points=7)
    hand, bending = rb.load(PALM), []
    for a in (0.0, 2 * np.pi / 3, 4 * np.pi / 3):
        out, down = np.array([np.cos(a), np.sin(a), 0.0]), np.array([0.0, 0.0, -1.0])
        axes = np.stack([down, np.cross(out, down), out], -1)
        turned = rb.rotations.quaternion.from_matrix(axes)
        place = 0.045 * out + [0, 0, 0.14]
        hand = hand.with_beam(f"finger {len(bending)}", finger, position=place, orientation=turned)
        bending.append(axes[:, 1])
    steps = 2000
    pull = np.zeros((steps, hand.nb, 6))
    rise = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(steps) / 1000)
    pull[:, :, :3] = 0.009 * rise[:, None, None] * bending
    run = rb.rollout(
        hand, hand.default_state(), None, 2e-3, wrenches=jnp.asarray(pull), integrator="discrete",
        save_every=10,
    )  # fmt: skip
    camera = rb.plotting.Camera(-75, 12)
    rb.plotting.animate(hand, run, path, source=PALM, camera=camera, title="Soft fingers")


def thousands(path: Path) -> None:
    """A thousand double pendulums start at a thousand angles."""
    import jax.numpy as jnp

    import rbjax as rb

    model = rb.load("double_pendulum")
    q = jnp.array([2.0, 2.4]) + jnp.linspace(-0.05, 0.05, 1000)[:, None]
    run = rb.rollout(model, rb.State(q, 0 * q), None, 0.002, steps=2000, save_every=50)
    title = "1,000 double pendulums"
    rb.plotting.animate(
        model, run, path, source="double_pendulum", samples=1000, fps=7.5, title=title
    )


MADE: dict[str, Callable[[Path], None]] = {
    "walking": walking,
    "grasping": grasping,
    "wheels": wheels,
    "beams": beams,
    "thousands": thousands,
}


def pages(root: Path) -> dict[str, str | bytes]:
    """The page of each motion."""
    from rbjax.plotting.web_page import page_text

    found = {name: json.loads((FOLDER / f"{name}.json").read_text()) for name in MADE}
    return {f"animations/{name}.html": page_text(**motion) for name, motion in found.items()}


def motion_of(page: str) -> dict[str, str | dict]:
    """Return the title of a page and the data that its program draws."""
    title = re.search(r"<title>(.*?)</title>", page)
    data = re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL)
    assert title is not None and data is not None
    return {"title": html.unescape(title[1]), "data": json.loads(data[1])}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(MADE), choices=[*MADE, []])
    FOLDER.mkdir(exist_ok=True)
    for name in parser.parse_args().names:
        with tempfile.TemporaryDirectory() as folder:
            page = Path(folder) / f"{name}.html"
            MADE[name](page)
            text = page.read_text()
        size = len(text.encode())
        print(f"{name}.html: {size / 1e3:.0f} kB")
        if size > LARGEST:
            raise SystemExit(f"{name}.html has {size} bytes, more than {LARGEST}: fewer frames")
        (FOLDER / f"{name}.json").write_text(json.dumps(motion_of(text)) + "\n")


if __name__ == "__main__":
    main()
