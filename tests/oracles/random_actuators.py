"""Random actuators on random trees, as MJCF text; a seed is a model.

Every transmission that rbjax has, every activation, gain and bias, PID controllers, DC motors,
muscles and orientation servos, with ranges of controls, states and forces, joint force ranges, and
actuators' own damping and armature. Gains are human, so that 50 steps are no chaos.
"""

from __future__ import annotations

import re

import mujoco
import numpy as np

from benchmarks.cases.random_trees import _rotation, _text, random_tree

Array = np.ndarray
_OFF = '<flag contact="disable" constraint="disable" eulerdamp="disable"/>'


def random_actuated(seed: int, count: int = 12) -> str:
    """MJCF text of a tree of three to five bodies with so many actuators."""
    rng = np.random.default_rng([6421, seed])
    tree = random_tree(seed, bodies=int(rng.integers(3, 6)), welded=0.1, several=0.15)
    tree = re.sub(r"\n *<motor [^>]*/>", "", tree)

    def site(found: re.Match) -> str:
        k = next(names)
        pos, quat = _text(rng.uniform(-0.3, 0.3, 3)), _text(_rotation(rng))
        return f'<site name="p{k}" pos="{pos}" quat="{quat}"/>\n{found[0]}'

    names = iter(range(99))
    text = re.sub(r" *<inertial", site, tree)
    text = text.replace("<worldbody>", '<worldbody><site name="base" pos="0.1 0.2 -0.3"/>')
    limited = r'\1 actuatorfrcrange="-9 8"'
    text = re.sub(r'(<joint name="[^"]*_0" type="(hinge|slide)")', limited, text)
    text = re.sub(r"<option ([^>]*)/>", rf'<option \1 integrator="Euler">{_OFF}</option>', text)
    m = mujoco.MjModel.from_xml_string(text)
    sites = ["base", *(f"p{k}" for k in range(next(names)))]
    scalars = [m.joint(j).name for j in range(m.njnt) if m.jnt_type[j] >= 2]
    tendons, actuators = _tendons(rng, sites, scalars), []
    for i in range(count):
        actuators.append(_actuator(rng, i, m, sites, [name for name, _ in tendons]))
    extra = "".join(text for _, text in tendons)
    text = text.replace("<actuator>", f"<tendon>{extra}</tendon>\n<actuator>")
    return text.replace("</actuator>", "\n".join(actuators) + "\n</actuator>")


def _tendons(rng: np.random.Generator, sites: list, scalars: list) -> list[tuple[str, str]]:
    """Name and text of a spatial tendon with a pulley, and of a fixed one where joints allow."""
    path = [f'<site site="{s}"/>' for s in rng.permutation(sites)[:4]]
    path.insert(2, f'<pulley divisor="{_text(rng.uniform(1.5, 3))}"/>')
    out = [("rope", f'<spatial name="rope">{"".join(path)}</spatial>')]
    if len(scalars) > 1:
        joints = "".join(
            f'<joint joint="{j}" coef="{_text(rng.uniform(-1, 1))}"/>' for j in scalars[:3]
        )
        out.append(("band", f'<fixed name="band">{joints}</fixed>'))
    return out


def _transmission(rng, m: mujoco.MjModel, sites: list, tendons: list) -> tuple[str, bool, float]:
    """Text of a transmission; whether it is one joint; a length that it has."""
    pick = rng.choice(["joint", "joint", "parent", "site", "pose", "turn", "crank", "tendon"])
    a, b = rng.choice(len(sites), 2, replace=False)
    site, other = sites[a], sites[b]
    gear = rng.uniform(0.3, 1.5, 6) * rng.choice([-1, 1], 6)
    if pick in ("joint", "parent"):
        joint = m.joint(int(rng.integers(m.njnt)))
        n = {0: 6, 1: 3}.get(int(joint.type[0]), 1)
        word = "joint" if pick == "joint" else "jointinparent"
        return f'{word}="{joint.name}" gear="{_text(gear[:n])}"', True, 0.0
    if pick == "site":
        return f'site="{site}" gear="{_text(gear)}"', False, 0.0
    if pick == "pose":
        return f'site="{site}" refsite="{other}" gear="{_text(gear)}"', False, 0.0
    if pick == "turn":
        gear[:3] = 0
        return f'site="{site}" refsite="{other}" gear="{_text(gear)}"', False, 0.0
    if pick == "crank":
        rod = _text(rng.choice([0.02, 3.0]))
        text = f'cranksite="{site}" slidersite="{other}" cranklength="{rod}"'
        return f'{text} gear="{_text(gear[0])}"', False, -3.0 * gear[0]
    name = rng.choice(tendons)
    return f'tendon="{name}" gear="{_text(gear[0])}"', False, gear[0] if name == "rope" else 0.0


def _actuator(rng, i: int, m: mujoco.MjModel, sites: list, tendons: list) -> str:
    target, at_joint, length = _transmission(rng, m, sites, tendons)

    def some(text: str, share: float = 0.4) -> str:
        return text if rng.random() < share else ""

    def numbers(low: float, high: float, n: int = 1) -> str:
        return _text(rng.uniform(low, high, n))

    common = f'name="a{i}" ' + some('ctrlrange="-0.7 0.9" ')
    plain = common + some('forcerange="-2 3" ')
    law = rng.choice(["general", "general", "muscle", "pid", "dcmotor", "orientation"])
    if at_joint and law != "orientation":
        target += some(f' damping="{numbers(0.05, 0.2)}"', 0.2)
        target += some(f' armature="{numbers(0.02, 0.1)}"', 0.2)
    if law == "muscle" and target.startswith("site="):
        law = "general"
    if law == "muscle":
        band = _text([length - 0.7, length + 0.9])
        form = f'lengthrange="{band}" force="{numbers(1, 4)}" vmax="{numbers(2, 5)}" '
        form += some('tausmooth="0.3"')
        return f"<muscle {plain} {target} {form}/>"
    if law == "pid":
        inputs = str(rng.choice(["pos vel", "pos", "pos ff", "pos vel ff", "vel", "vel ff"]))
        common += f'input="{inputs}" kp="{numbers(0.5, 3)}" kv="{numbers(0, 0.3)}" '
        if "pos" in inputs:
            common += some(f'ki="{numbers(0.3, 2)}" imax="0.2" ')
            common += some(f'slewmax="{numbers(1, 9)}" ')
        common += some('forcerange="-2 3"')
        return f"<pid {common} {target}/>"
    if law == "dcmotor":
        inputs = str(rng.choice(["voltage", "pos vel", "pos ff voltage", "vel", "none"]))
        form = f'input="{inputs}" motorconst="{numbers(0.3, 0.6, 2)}" resistance="2" '
        form += some(f'inductance="{numbers(0.1, 0.4)} 0" ')
        form += some('thermal="2 3 0 0.004 25 20" ') + some('saturation="0.8" ')
        form += some('cogging="0.1 4 0.3" ') + some('lugre="3 0.1 0.3 0.4 0.2" ')
        if inputs not in ("voltage", "none"):
            ki = numbers(0.2, 1) if "pos" in inputs else "0"
            form += f'controller="{numbers(0.5, 2)} {ki} 0.2 {rng.choice([0, 5])} 0.2 6" '
        return f'<dcmotor name="a{i}" {form} {target}/>'
    balls = [m.joint(j).name for j in range(m.njnt) if m.jnt_type[j] == 1]
    if law == "orientation":
        a, b = rng.choice(len(sites), 2, replace=False)
        where = f'site="{sites[a]}" refsite="{sites[b]}"'
        if balls and rng.random() < 0.5:
            where = f'joint="{rng.choice(balls)}"'
        if rng.random() < 0.5:
            common += some('input="quat" ') + some('forcerange="0 1" ')
            return f'<orientation {common} {where} kp="{numbers(0.5, 2)}" kv="0.1"/>'
        form = 'gaintype="so3" biastype="so3" dyntype="integrator" '
        form += 'gainprm="1.2" biasprm="0.1 -1.2 -0.1" '
        form += some('actearly="true" ') + some('actrange="-0.4 0.5"')
        return f"<general {common} {where} {form}/>"
    dynamics = str(rng.choice(["none", "integrator", "filter", "filterexact", "muscle"]))
    gain, bias = rng.choice(["fixed", "affine"]), rng.choice(["none", "affine", "servo"])
    form = f'dyntype="{dynamics}" gaintype="{gain}" gainprm="{numbers(-1, 1, 3)}" '
    if bias == "servo":  # on an angle its setpoints lie on a circle
        form = f'dyntype="{dynamics}" gainprm="2" biastype="affine" biasprm="0 -2 -0.1" '
    elif bias == "affine":
        form += f'biastype="affine" biasprm="{numbers(-1, 1, 3)}" '
    if dynamics != "none":
        form += f'dynprm="{numbers(0.02, 0.2, 2)} 0" '
        form += some('actrange="-0.3 0.4" ') + some('actearly="true" ')
    return f"<general {plain} {target} {form}/>"


def random_act(m: mujoco.MjModel, rng: np.random.Generator) -> Array:
    """States of the actuators, also beyond their ranges."""
    return rng.normal(size=m.na) * rng.choice([0.1, 0.6])
