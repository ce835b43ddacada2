"""Robots with sensors of every kind on every object, for MuJoCo and rbjax."""

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from benchmarks.cases.random_trees import random_tree
from tests.robots import load_quietly

KIND, OBJECT = mujoco.mjtSensor, mujoco.mjtObj
AT_SITE = ["ACCELEROMETER", "VELOCIMETER", "GYRO", "FORCE", "TORQUE", "MAGNETOMETER", "TOUCH"]
OF_FRAME = [
    "FRAMEPOS",
    "FRAMEQUAT",
    "FRAMEXAXIS",
    "FRAMEYAXIS",
    "FRAMEZAXIS",
    "FRAMELINVEL",
    "FRAMEANGVEL",
]
OF_RATES = ["FRAMELINACC", "FRAMEANGACC"]
OF_TREE = ["SUBTREECOM", "SUBTREELINVEL", "SUBTREEANGMOM"]
OF_JOINT = ["JOINTPOS", "JOINTVEL", "JOINTACTFRC"]
OF_LIMIT = ["JOINTLIMITPOS", "JOINTLIMITVEL"]
OF_BALL = ["BALLQUAT", "BALLANGVEL"]
OF_TENDON = ["TENDONPOS", "TENDONVEL", "TENDONACTFRC"]
OF_ACTUATOR = ["ACTUATORPOS", "ACTUATORVEL", "ACTUATORFRC"]
ALONE = ["CLOCK", "E_POTENTIAL", "E_KINETIC"]


def add(spec, kind, objtype=None, name="", base=None, **given):
    """Add a sensor of a kind, such as "GYRO"; base: (type, name) of the reference."""
    spec.add_sensor(
        name=f"s{len(spec.sensors)}",
        type=getattr(KIND, f"mjSENS_{kind}"),
        objtype=OBJECT.mjOBJ_UNKNOWN if objtype is None else getattr(OBJECT, f"mjOBJ_{objtype}"),
        objname=name,
        **({} if base is None else
           {"reftype": getattr(OBJECT, f"mjOBJ_{base[0]}"), "refname": base[1]}),
        **given,
    )  # fmt: skip


def equip(spec: mujoco.MjSpec, rng: np.random.Generator) -> mujoco.MjSpec:
    """Add sensors of every kind on every object of a spec."""
    for site in spec.sites:
        for kind in AT_SITE:
            add(spec, kind, "SITE", site.name)
    frames = [("SITE", x.name) for x in spec.sites]
    frames += [(kind, x.name) for x in spec.bodies[1:] for kind in ("BODY", "XBODY")]
    frames += [("GEOM", x.name) for x in spec.geoms] + [("CAMERA", x.name) for x in spec.cameras]
    for kind in OF_FRAME:
        for frame in frames:
            base = frames[rng.integers(len(frames))]
            add(spec, kind, *frame)
            add(spec, kind, *frame, base)
    for kind in OF_RATES:
        for frame in frames:
            add(spec, kind, *frame)
    for kind in OF_TREE:
        for body in spec.bodies:
            add(spec, kind, "BODY", body.name)
    for joint in spec.joints:
        kinds = {2: OF_JOINT, 3: OF_JOINT, 1: OF_BALL}.get(int(joint.type), [])
        limited = bool(joint.range[1] > joint.range[0])
        for kind in [*kinds, *(OF_LIMIT if limited else [])]:
            add(spec, kind, "JOINT", joint.name)
    for kind in OF_TENDON:
        for tendon in spec.tendons:
            add(spec, kind, "TENDON", tendon.name)
    for tendon in spec.tendons:
        if tendon.range[1] > tendon.range[0]:
            for kind in ("TENDONLIMITPOS", "TENDONLIMITVEL"):
                add(spec, kind, "TENDON", tendon.name)
    for kind in OF_ACTUATOR:
        for actuator in spec.actuators:
            add(spec, kind, "ACTUATOR", actuator.name)
    for kind in ALONE:
        add(spec, kind)
    return spec


def named(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Give a name to every object without one."""
    for kind in ("bodies", "joints", "sites", "geoms", "tendons", "actuators", "cameras"):
        for i, x in enumerate(getattr(spec, kind)):
            x.name = x.name or f"{kind}{i}"
    return spec


def tree(seed: int, every: int = 1) -> mujoco.MjModel:
    """A random tree with sensors of every kind; every: keep one of so many sensors."""
    spec = named(mujoco.MjSpec.from_string(random_tree(seed)))
    rng = np.random.default_rng(seed)
    bodies = spec.bodies
    for k in range(3):
        body = bodies[int(rng.integers(len(bodies)))]
        body.add_site(name=f"x{k}", pos=rng.normal(size=3) * 0.2, quat=unit(rng))
        body.add_geom(
            name=f"g{k}", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0], mass=0.0,
            pos=rng.normal(size=3) * 0.2, quat=unit(rng), contype=0, conaffinity=0,
        )  # fmt: skip
    bodies[-1].add_camera(name="eye", pos=rng.normal(size=3) * 0.1, quat=unit(rng))
    left = [x for k, x in enumerate(equip(spec, rng).sensors) if k % every]
    for sensor in left:
        spec.delete(sensor)
    return spec.compile()


def unit(rng):
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


def loaded(m: mujoco.MjModel, **options) -> rb.Model:
    return load_quietly(m, **options)


def sensed_by_mujoco(m, state, ctrl, t=0.3) -> tuple[dict, mujoco.MjData]:
    """The sensordata of MuJoCo by name."""
    d = mujoco.MjData(m)
    d.qpos, d.qvel, d.ctrl, d.time = state.q, state.v, ctrl, t
    if m.na:
        d.act[:] = state.x
    mujoco.mj_forward(m, d)
    return {m.sensor(i).name: d.sensor(i).data.copy() for i in range(m.nsensor)}, d


def random_motion(model: rb.Model, seed: int, nu: int):
    state = model.random_state(jax.random.key(seed))
    rng = np.random.default_rng(seed)
    if state.x is not None:
        state = state.replace(x=jnp.asarray(rng.uniform(0, 1, model.nx)))
    return state, jnp.asarray(rng.normal(size=nu))


RICH = Path(__file__).with_name("rich.xml")
DATA = 63  # all values of a rangefinder: distance, direction, origin, point, normal, depth


def rich(*kinds: str) -> mujoco.MjModel:
    """The robot of rich.xml with sensors of every kind; kinds: only of these kinds."""
    spec = equip(mujoco.MjSpec.from_file(str(RICH)), np.random.default_rng(0))
    sites = [x.name for x in spec.sites]
    for site in sites:
        add(spec, "RANGEFINDER", "SITE", site, intprm=[DATA, 0, 0])
        add(spec, "RANGEFINDER", "SITE", site, intprm=[1, 0, 0], cutoff=0.3)
        for frame in (("XBODY", "puck"), ("GEOM", "palm"), ("SITE", "hip")):
            add(spec, "INSIDESITE", *frame, ("SITE", site))
    for camera in spec.cameras:
        for site in sites:
            add(spec, "CAMPROJECTION", "SITE", site, ("CAMERA", camera.name))
    add(spec, "GYRO", "SITE", "tip", cutoff=0.2)
    kept = [sensor for sensor in spec.sensors if kinds and sensor.type.name[7:] not in kinds]
    for sensor in kept:
        spec.delete(sensor)
    return spec.compile()
