"""Random kinematic trees as MJCF text, and random states for them; a seed is a model.

Every joint type, several joints on one body, welded bodies, tilted frames and axes, full inertias,
anchors off the origin, armature, damping, springs, gravity in any direction, sites, motors. No
contacts. Sizes are kept human (masses 0.2 to 5 kg, lengths 0.1 to 0.6 m, inertias of scattered
points), so that nothing is ill-conditioned by construction.
"""

from __future__ import annotations

import tempfile

import mujoco
import numpy as np

Array = np.ndarray


def _text(values: object) -> str:
    return " ".join(repr(float(x)) for x in np.atleast_1d(values))


def _rotation(rng: np.random.Generator) -> Array:
    """A uniform random unit quaternion (w, x, y, z)."""
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


def _axes(rng: np.random.Generator) -> Array:
    """Three axes (rows) near an orthonormal frame: joints sharing a body stay independent."""
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0] + rng.uniform(-0.15, 0.15, (3, 3))
    return frame / np.linalg.norm(frame, axis=1, keepdims=True)


def _inertial(rng: np.random.Generator) -> str:
    """Mass, com and full inertia of eight random points: consistent because such a body exists."""
    mass = rng.uniform(0.2, 5.0)
    m = rng.dirichlet(np.ones(8)) * mass
    x = rng.uniform(-1, 1, (8, 3)) * rng.uniform(0.1, 0.3, 3) + rng.uniform(-0.15, 0.15, 3)
    com = m @ x / mass
    r = x - com
    second_moment = r.T @ (m[:, None] * r)
    about_com = np.trace(second_moment) * np.eye(3) - second_moment
    about_com += 0.002 * mass * np.eye(3)  # points have some size: bounds the condition number
    full = [about_com[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    return f'<inertial pos="{_text(com)}" mass="{mass!r}" fullinertia="{_text(full)}"/>'


def _joints(rng: np.random.Generator, body: int, kinds: list[str], *, ref: bool) -> list[str]:
    """The joint elements of one body; `kinds` in order, as MuJoCo applies them."""
    axes, out = _axes(rng), []
    for k, kind in enumerate(kinds):
        attributes = {"name": f"j{body}_{k}", "type": kind, "pos": _text(rng.uniform(-0.2, 0.2, 3))}
        if kind != "ball":
            attributes["axis"] = _text(axes[k % 3])
        if len(kinds) > 1 or rng.random() < 0.6:
            attributes["armature"] = _text(rng.uniform(0.02, 0.2))
        if rng.random() < 0.6:
            attributes["damping"] = _text(rng.uniform(0.05, 1.0))
        if rng.random() < 0.4:
            attributes["stiffness"] = _text(rng.uniform(0.5, 10.0))
            if kind != "ball":
                attributes["springref"] = _text(rng.uniform(-0.5, 0.5))
        if ref and kind != "ball" and rng.random() < 0.3:
            attributes["ref"] = _text(rng.uniform(-0.5, 0.5))
        out.append("<joint " + " ".join(f'{k}="{v}"' for k, v in attributes.items()) + "/>")
    return out


def random_tree(
    seed: int,
    *,
    bodies: int | None = None,
    free_root: bool | None = None,
    welded: float = 0.15,
    several: float = 0.25,
    chain: float = 0.4,
    pinocchio_safe: bool = False,
) -> str:
    """MJCF text of a random tree of `bodies` bodies (default 1 to 12); None lets the seed decide.

    welded, several, chain: the share of bodies without a joint, with two or three joints, and hung
    on the body before. pinocchio_safe: leave out what Pinocchio's MJCF parser reads differently
    from MuJoCo (see `PINOCCHIO_TRAPS`); the same seed then gives another tree.
    """
    rng = np.random.default_rng([7919, seed])
    n = int(rng.integers(1, 13)) if bodies is None else bodies
    free = bool(rng.random() < 0.35) if free_root is None else free_root
    parents, children, content, motors = [-1], {i: [] for i in range(-1, n)}, [], []
    for i in range(1, n):
        parents.append(
            i - 1 if rng.random() < chain else int(rng.integers(0 if pinocchio_safe else -1, i))
        )
    for i, parent in enumerate(parents):
        children[parent].append(i)
        lines, kinds = [], []
        if i == 0 and free:
            lines.append('<freejoint name="free" align="false"/>')
        elif i == 0 or rng.random() >= welded:
            draw = rng.random()
            if draw < several:
                count = int(rng.integers(2, 4))
                kinds = list(rng.choice(["hinge", "slide"], count, p=[0.7, 0.3]))
                if count == 2 and rng.random() < 0.3:
                    kinds = ["slide", "ball"]
            else:
                kinds = [str(rng.choice(["hinge", "slide", "ball"], p=[0.6, 0.2, 0.2]))]
            lines += _joints(rng, i, kinds, ref=not pinocchio_safe)
        lines.append(_inertial(rng))
        if rng.random() < 0.5:
            pos, quat = _text(rng.uniform(-0.3, 0.3, 3)), _text(_rotation(rng))
            lines.append(f'<site name="s{i}" pos="{pos}" quat="{quat}"/>')
        for k, kind in enumerate(kinds):
            if rng.random() < 0.5:
                gear = rng.uniform(0.5, 3.0, 3 if kind == "ball" else 1) * rng.choice([-1, 1])
                motors.append(f'<motor name="m{i}_{k}" joint="j{i}_{k}" gear="{_text(gear)}"/>')
        content.append(lines)

    def body(i: int, depth: int) -> list[str]:
        pad = "  " * depth
        offset = rng.normal(size=3)
        offset *= rng.uniform(0.1, 0.6) / np.linalg.norm(offset)
        out = [f'{pad}<body name="b{i}" pos="{_text(offset)}" quat="{_text(_rotation(rng))}">']
        out += [f"{pad}  {line}" for line in content[i]]
        for child in children[i]:
            out += body(child, depth + 1)
        return [*out, f"{pad}</body>"]

    gravity = rng.normal(size=3)
    gravity *= 9.81 / np.linalg.norm(gravity)
    lines = [f'<mujoco model="random_tree_{seed}">', '  <compiler angle="radian"/>']
    lines += [f'  <option timestep="0.001" gravity="{_text(gravity)}"/>', "  <worldbody>"]
    for root in children[-1]:
        lines += body(root, 2)
    lines += [
        "  </worldbody>",
        "  <actuator>",
        *(f"    {m}" for m in motors),
        "  </actuator>",
        "</mujoco>",
    ]
    return "\n".join(lines) + "\n"


def random_state(model: mujoco.MjModel, seed: int) -> tuple[Array, Array]:
    """A random (q, v): quaternions over all SO(3), hinges over a turn, slides within 0.3 m."""
    rng = np.random.default_rng([104729, seed])
    q = np.array(model.qpos0)
    for kind, a in zip(model.jnt_type, model.jnt_qposadr, strict=True):
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            q[a : a + 3] += rng.uniform(-1, 1, 3)
            q[a + 3 : a + 7] = _rotation(rng)
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            q[a : a + 4] = _rotation(rng)
        elif kind == mujoco.mjtJoint.mjJNT_HINGE:
            q[a] += rng.uniform(-np.pi, np.pi)
        else:
            q[a] += rng.uniform(-0.3, 0.3)
    return q, rng.normal(size=model.nv)


PINOCCHIO_TRAPS = {
    "gravity": "option gravity is not read: (0, 0, -9.81) always; `pinocchio_model` sets it",
    "text": "buildModelFromMJCF takes a path, not text",
    "several roots": "only the first body under worldbody is read; the rest is dropped in silence",
    "welded root": "the pose of a top body without a joint is lost, so gravity is turned",
    "ref": "a hinge's ref is misread where its body has several joints (right where it has one)",
    "springs": "stiffness and springref are not read; damping and armature are",
    "names": "several joints on one body become one 'Composite_<first>', in MuJoCo's order of q, v",
}
"""What Pinocchio 4.1's MJCF parser does otherwise than MuJoCo, measured on these trees."""


def to_pinocchio(model: mujoco.MjModel, q: Array, v: Array) -> tuple[Array, Array]:
    """MuJoCo's (q, v) as Pinocchio's: quaternions xyzw, a free joint's velocity in body axes."""
    out = np.array(q, dtype=float)
    for kind, a in zip(model.jnt_type, model.jnt_qposadr, strict=True):
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            out[a + 3 : a + 7] = np.roll(out[a + 3 : a + 7], -1)
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            out[a : a + 4] = np.roll(out[a : a + 4], -1)
    return out, pinocchio_velocity_map(model, q) @ v


def pinocchio_velocity_map(model: mujoco.MjModel, q: Array) -> Array:
    """L (nv, nv) with v_pin = L v. Then M = L' M_pin L and tau = L' tau_pin."""
    out = np.eye(model.nv)
    for kind, a, b in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            world_from_body = np.zeros(9)
            mujoco.mju_quat2Mat(world_from_body, q[a + 3 : a + 7])
            out[b : b + 3, b : b + 3] = world_from_body.reshape(3, 3).T
    return out


def acceleration_to_pinocchio(model: mujoco.MjModel, q: Array, v: Array, a: Array) -> Array:
    """MuJoCo's acceleration as Pinocchio's: L a + dL/dt v, since L turns with a free body."""
    vel_map = pinocchio_velocity_map(model, q)
    out, vp = vel_map @ a, vel_map @ v
    for kind, b in zip(model.jnt_type, model.jnt_dofadr, strict=True):
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            out[b : b + 3] -= np.cross(vp[b + 3 : b + 6], vp[b : b + 3])
    return out


def pinocchio_model(xml: str):
    """MJCF text as a pinocchio.Model with the file's gravity; for pinocchio_safe trees."""
    import pinocchio

    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(xml)
        file.flush()
        model = pinocchio.buildModelFromMJCF(file.name)
    model.gravity.linear = np.array(mujoco.MjModel.from_xml_string(xml).opt.gravity)
    return model
