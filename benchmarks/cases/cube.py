"""The tossed cube of ContactNets: an acrylic cube of 10 cm on a board, 570 tosses at 148 Hz.

The fit uses the tosses with an even number, the errors are of the odd ones. Each simulation starts
from the first sample of its toss. Recorded velocities are backward differences of positions, so
half a period of free fall is added to them at the start.

Source: Pfrommer, Halm & Posa, *ContactNets*, CoRL 2020.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.sysid import Channel, Derived, Grid, Recording, Shared, Unknown

DATA = Path(__file__).parents[3] / "shared" / "data" / "contactnets_cube"
#: m, one unit of length of the data
UNIT = 0.0524
PERIOD, STEPS = 1 / 148, 4
GRID = Grid(PERIOD, STEPS, "semi_implicit_euler")
#: samples of each toss whose position is compared, 0.53 s
SAMPLES = 80
#: published friction, restitution and half side (m)
PUBLISHED = {"friction": 0.18, "restitution": 0.125, "half side": 0.0524}
#: standard deviations that weigh the samples: m and rad, m/s and rad/s; a cube that rolls over one
#: edge less is 1.6 rad off, and should not outweigh positions
NOISE = {"q": [1e-3] * 3 + [0.1] * 4, "v": [0.1] * 3 + [1.0] * 3}

XML = """<mujoco><option timestep="{step}" cone="elliptic"/><worldbody>
  <geom name="board" type="plane" size="0 0 1"/>
  <body name="cube"><freejoint/>
    <inertial pos="0 0 0" mass="0.37" diaginertia="0.00081 0.00081 0.00081"/>
    <geom name="cube" type="box" size="{half} {half} {half}" priority="1" condim="3"
      friction="{friction} 0 0" solref="{time} {ratio}" solimp="{impedance} 0.95 0.001 0.5 2"/>
  </body></worldbody></mujoco>"""


def model(
    friction: float = 0.18, half: float = 0.0524, solref: tuple[float, float] = (0.02, 1.0),
    impedance: float = 0.9,
) -> rb.Model:  # fmt: skip
    """The cube and the board. `impedance` is the first of solimp: 0.9 is MuJoCo's default, a small
    one makes the force continuous at touch and the gradient unbiased."""
    text = XML.format(
        step=PERIOD / STEPS, half=half, friction=friction, time=solref[0], ratio=solref[1],
        impedance=impedance,
    )  # fmt: skip
    return rb.load(text)


def tosses(numbers: Any, samples: int = SAMPLES) -> np.ndarray:
    """The first samples (tosses, samples, 13) of tosses: q and v in SI."""
    with np.load(DATA / "tosses.npz") as data:
        found = np.stack([data[str(k)][:samples] for k in numbers]).astype(float)
    found[..., :3] *= UNIT
    found[..., 7:10] *= UNIT
    found[:, 0, 9] -= 9.81 * PERIOD / 2
    return found


def recordings(seen: np.ndarray) -> list[Recording]:
    """Recordings of q, each with a known first v."""
    t, found = np.arange(seen.shape[1]) * PERIOD, []
    for k, toss in enumerate(seen):
        v = np.full((len(t), 6), np.nan)
        v[0] = toss[0, 7:]
        channels = {
            "q": Channel(t, toss[:, :7], noise=NOISE["q"]),
            "v": Channel(t, v, noise=NOISE["v"], dropped="nan"),
        }
        found.append(Recording(f"toss {k}", channels))
    return found


def unknowns() -> dict[str, Any]:
    """Friction, stiffness (solref) and size of the cube, and the unit of length of the cameras."""
    sides = tuple(Unknown("geoms.size", (1, axis), positive=True) for axis in range(3))
    return {
        "friction": Unknown("geoms.friction", (1, 0), positive=True),
        "time constant": Unknown("geoms.solref", (1, 0), bounds=(1e-3, 0.1)),
        "damping ratio": Unknown("geoms.solref", (1, 1), positive=True),
        "half side": Shared(sides),
        "unit": Derived((1.0,), _with_unit, positive=True),
    }


def _with_unit(setup: Any, p: Any) -> Any:
    """Scale the readings of positions and linear velocities."""
    scaled = {k: x.replace(scale=x.scale.at[:3].set(p[0])) for k, x in setup.sensors.items()}
    return setup.replace(sensors=scaled)


def simulated(model: rb.Model, seen: Any, unit: Any = 1.0, dynamics: Any = None) -> jax.Array:
    """Simulated readings of q (tosses, samples, 7) from the first samples."""
    n = seen.shape[1]
    lengths = jnp.concatenate([jnp.full(3, 1 / unit), jnp.ones(4)])
    first = jnp.asarray(seen[:, 0])
    state = rb.State(first[:, :7] * lengths, first[:, 7:] * lengths[:6])
    given = {} if dynamics is None else {"dynamics": dynamics}
    path = rb.rollout(
        model, state, None, PERIOD / STEPS, steps=(n - 1) * STEPS, save_every=STEPS, **given
    )
    return path.q / lengths


def distances(q: Any, seen: Any) -> jax.Array:
    """Distances (tosses, samples) in m of simulated and recorded positions."""
    return jnp.linalg.norm(q[..., :3] - seen[..., :3], axis=-1)
