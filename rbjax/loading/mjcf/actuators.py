"""The actuators of a compiled model as force elements."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rbjax.forces import Element
from rbjax.forces.actuators.activation import Activation, Filter, Integrator, Recruitment
from rbjax.forces.actuators.actuator import Active, Actuator, Affine, ForceLaw, GainBias, Passive
from rbjax.forces.actuators.dc_motor import DCMotor, Heat, LuGre, Windings
from rbjax.forces.actuators.muscle import Muscle
from rbjax.forces.actuators.orientation_servo import OrientationServo
from rbjax.forces.actuators.pid import INPUTS, PID, Controller
from rbjax.forces.actuators.transmissions import (
    JointAxis,
    JointSum,
    SitePath,
    SitePose,
    SiteWrench,
    SliderCrank,
    Transmission,
)
from rbjax.loading.mjcf.actuator_kinds import (
    Bias,
    Dyn,
    Gain,
    Trn,
    Wrap,
    is_circular,
    is_off,
    what_is_left_out,
)
from rbjax.loading.mjcf.finite import refuse_nan

_VOLTAGE = 8  # mjINPUT_VOLTAGE, a bit of actuator_ctrlspec


def actuator_elements(m: mujoco.MjModel) -> tuple[Element, ...]:
    """All actuators that the file does not switch off and that rbjax has, in the file's order."""
    found = tuple(_element(m, i) for i in _modelled(m))
    for element in found:
        refuse_nan(element)
    return found


def key_states(m: mujoco.MjModel) -> np.ndarray:
    """The states (nk, n) of the actuators in the file's keyframes."""
    index = [
        int(m.actuator_actadr[i]) + k for i in _modelled(m) for k in range(m.actuator_actnum[i])
    ]
    return m.key_act[:, index]


def _modelled(m: mujoco.MjModel) -> list[int]:
    return [i for i in range(m.nactuator) if not (is_off(m, i) or what_is_left_out(m, i))]


def _element(m: mujoco.MjModel, i: int) -> Element:
    first, count = int(m.actuator_ctrladr[i]), int(m.actuator_ctrlnum[i])
    controls = tuple(range(first, first + count))
    clamped = not m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    rows = slice(first, first + count)
    limited = m.actuator_ctrllimited[rows].astype(bool)[:, None] & clamped
    ctrlrange = array(np.where(limited, m.actuator_ctrlrange[rows], [-np.inf, np.inf]))
    if m.actuator_gaintype[i] == Gain.SO3:
        return _orientation_servo(m, i, controls, ctrlrange)
    return Actuator(_transmission(m, i), _law(m, i), ctrlrange, _forcerange(m, i), controls)


def _forcerange(m: mujoco.MjModel, i: int) -> jax.Array:
    """The force range of an actuator, within which its tendon's range is."""
    own = m.actuator_forcerange[i] if m.actuator_forcelimited[i] else np.array([-np.inf, np.inf])
    tendon = m.actuator_trnid[i, 0]
    if m.actuator_trntype[i] == Trn.TENDON and m.tendon_actfrclimited[tendon]:
        return array(np.clip(m.tendon_actfrcrange[tendon], *own))
    return array(own)


def _transmission(m: mujoco.MjModel, i: int) -> Transmission:
    kind, (target, other) = m.actuator_trntype[i], map(int, m.actuator_trnid[i])
    gear = array(m.actuator_gear[m.actuator_outadr[i]])
    if kind in (Trn.JOINT, Trn.JOINTINPARENT):
        return JointAxis(gear, target, bool(kind == Trn.JOINTINPARENT))
    if kind == Trn.SITE:
        return SiteWrench(gear, target) if other < 0 else SitePose(gear, target, other)
    if kind == Trn.SLIDERCRANK:
        return SliderCrank(gear, array(m.actuator_cranklength[i]), target, other)
    return _tendon(m, target, gear)


def _tendon(m: mujoco.MjModel, tendon: int, gear: jax.Array) -> Transmission:
    at = int(m.tendon_adr[tendon])
    rows = slice(at, at + int(m.tendon_num[tendon]))
    kinds, things, given = m.wrap_type[rows], m.wrap_objid[rows], m.wrap_prm[rows]
    if (kinds == Wrap.JOINT).all():
        return JointSum(gear, array(given), tuple(int(j) for j in things))
    segments, divisors, divisor, last = [], [], 1.0, -1
    for kind, thing, number in zip(kinds, things, given, strict=True):
        if kind == Wrap.PULLEY:
            divisor, last = float(number), -1
            continue
        if last >= 0:
            segments.append((last, int(thing)))
            divisors.append(divisor)
        last = int(thing)
    return SitePath(gear, array(divisors), tuple(segments))


def _law(m: mujoco.MjModel, i: int) -> ForceLaw:
    gain, bias = m.actuator_gaintype[i], m.actuator_biastype[i]
    if gain == Gain.PID:
        return _pid(m, i)
    if gain == Gain.DCMOTOR:
        return _dc_motor(m, i)
    strength: Affine | Active
    if gain == Gain.MUSCLE:
        strength = Active(_muscle(m, i, m.actuator_gainprm[i]))
    else:
        strength = Affine(array(m.actuator_gainprm[i, : 3 if gain == Gain.AFFINE else 1]))
    offset: Affine | Passive | None = None
    if bias == Bias.MUSCLE:
        offset = Passive(_muscle(m, i, m.actuator_biasprm[i]))
    elif bias == Bias.AFFINE:
        offset = Affine(array(m.actuator_biasprm[i, :3]))
    early, circular = bool(m.actuator_actearly[i]), is_circular(m, i)
    return GainBias(strength, offset, _activation(m, i), early, circular)


def _muscle(m: mujoco.MjModel, i: int, parameters: np.ndarray) -> Muscle:
    out = m.actuator_outadr[i]
    return Muscle(
        array(parameters[:9]), array(m.actuator_lengthrange[out]), array(m.actuator_acc0[out]),
        scaled=bool(parameters[2] < 0),
    )  # fmt: skip


def _activation(m: mujoco.MjModel, i: int) -> Activation | None:
    kind, given = m.actuator_dyntype[i], m.actuator_dynprm[i]
    limits = _actrange(m, i)
    if kind == Dyn.NONE:
        return None
    if kind == Dyn.INTEGRATOR:
        return Integrator(limits)
    if kind == Dyn.MUSCLE:
        smooth = bool(given[2] >= mujoco.mjMINVAL)
        return Recruitment(limits, array(given[:2]), array(given[2]), smooth)
    return Filter(limits, array(given[0]), bool(kind == Dyn.FILTEREXACT))


def _actrange(m: mujoco.MjModel, i: int) -> jax.Array:
    return array(m.actuator_actrange[i] if m.actuator_actlimited[i] else [-np.inf, np.inf])


def _controller(m: mujoco.MjModel, i: int, gains: list, windup: float, slew: float) -> Controller:
    spec = int(m.actuator_ctrlspec[i])
    inputs = tuple(name for k, name in enumerate(INPUTS) if spec >> k & 1)
    return Controller(
        array(gains), array(_or_infinite(windup)), array(_or_infinite(slew)), inputs,
        slews=bool(slew > 0), integrates=bool(gains[1] > 0),
        circular=is_circular(m, i), clipped=bool(m.actuator_gaintype[i] == Gain.DCMOTOR),
    )  # fmt: skip


def _pid(m: mujoco.MjModel, i: int) -> PID:
    (offset, kp, kv), (windup, slew) = m.actuator_biasprm[i, :3], m.actuator_dynprm[i, :2]
    gains = [-kp, m.actuator_gainprm[i, 0], -kv]
    controller = _controller(m, i, gains, windup, slew)
    return PID(controller, array(offset), _actrange(m, i), bool(m.actuator_actearly[i]))


def _dc_motor(m: mujoco.MjModel, i: int) -> DCMotor:
    R, K, alpha, T0, kp, ki, kd, drive = m.actuator_gainprm[i, :8]
    te, current_rate, RT, C, Ta, s0, s1, slew, windup = m.actuator_dynprm[i, :9]
    cogging, (FC, FS, vS) = m.actuator_biasprm[i, :3], m.actuator_biasprm[i, 3:6]
    windings = Windings(
        resistance=array(R),
        constant=array(K),
        drive=array(_or_infinite(drive)),
        time_constant=array(te),
        current_rate=array(_or_infinite(current_rate)),
        inductive=bool(te > 0),
    )
    commanded = any((kp, ki, kd)) or slew > 0 or int(m.actuator_ctrlspec[i]) & 7
    return DCMotor(
        windings,
        array(cogging),
        _controller(m, i, [kp, ki, kd], windup, slew) if commanded else None,
        Heat(array([RT, C, Ta, alpha, T0])) if RT > 0 else None,
        LuGre(array([s0, s1, FC, FS, vS])) if s0 > 0 else None,
        voltage=bool(int(m.actuator_ctrlspec[i]) & _VOLTAGE),
    )


def _orientation_servo(
    m: mujoco.MjModel, i: int, controls: tuple[int, ...], ctrlrange: jax.Array
) -> OrientationServo:
    target, base = map(int, m.actuator_trnid[i])
    strongest = m.actuator_forcerange[i, 1] if m.actuator_forcelimited[i] else np.inf
    gains = [m.actuator_gainprm[i, 0], m.actuator_biasprm[i, 0], -m.actuator_biasprm[i, 2]]
    where = {"joint": target} if base < 0 else {"site": target, "reference": base}
    early = bool(m.actuator_actearly[i])
    return OrientationServo(
        array(gains), ctrlrange, array(strongest), _activation(m, i), controls, early=early, **where
    )


def _or_infinite(x: float) -> float:
    """A limit, where zero means that there is none."""
    return float(x) if x > 0 else np.inf


def array(x: object) -> jax.Array:
    """As a leaf of a model."""
    return jnp.asarray(np.asarray(x, np.float64))
