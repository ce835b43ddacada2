"""Conversion of actuator force laws between MuJoCo's parameters and rbjax records.

The tables give the index of each parameter in `gainprm`, `biasprm` and `dynprm`.
"""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

from rbjax.forces.actuators.activation import (
    Activation,
    ControlIntegral,
    Filter,
    Muscle,
    Recruitment,
)
from rbjax.forces.actuators.actuator import Active, Affine, ForceLaw, GainBias, Passive
from rbjax.forces.actuators.dc_motor import DCMotor, Heat, LuGre, Windings
from rbjax.forces.actuators.pid import INPUTS, PID, PIDController
from rbjax.loading.mjcf.fields import Bias, Dyn, Gain, is_circular, leaf
from rbjax.loading.write.draft import text

Table = dict[str, tuple[str, ...]]

_VOLTAGE = 8  # mjINPUT_VOLTAGE, a bit of actuator_ctrlspec

# A minus sign marks a parameter that is stored with the opposite sign.
_PID: Table = {
    "gainprm": ("ki",), "biasprm": ("offset", "-kp", "-kv"), "dynprm": ("windup", "slew"),
}  # fmt: skip
_DC_MOTOR: Table = {
    "gainprm": ("resistance", "constant", "alpha", "T0", "kp", "ki", "kv", "drive"),
    "dynprm": ("time_constant", "current_rate", "RT", "C", "Ta", "s0", "s1", "slew", "windup"),
    "biasprm": ("amplitude", "poles", "phase", "FC", "FS", "vS"),
}
SERVO: Table = {"biasprm": ("constant", "-kp", "-kv"), "gainprm": ("kp",)}
_HEAT, _LUGRE = ("RT", "C", "Ta", "alpha", "T0"), ("s0", "s1", "FC", "FS", "vS")
#: limits that MJCF stores as zero if there is no limit
_LIMITS = ("windup", "slew", "drive", "current_rate")


def parameters(m: mujoco.MjModel, i: int, table: Table) -> SimpleNamespace:
    """Read the parameters of actuator i by name. A limit that is not set is infinite."""
    found: dict[str, float] = {}
    for key, names in table.items():
        for name, x in zip(names, getattr(m, f"actuator_{key}")[i], strict=False):
            found[name.lstrip("-")] = -x if name[0] == "-" else x
    found |= {k: x if x > 0 else np.inf for k, x in found.items() if k in _LIMITS}
    return SimpleNamespace(**found)


def attributes(table: Table, **given: Any) -> dict[str, str]:
    """Return the attributes of an actuator with given parameters; missing parameters are zero."""
    given = {k: x if np.isfinite(x) or k not in _LIMITS else 0.0 for k, x in given.items()}

    def entry(name: str) -> Any:
        return -given[name[1:]] if name[0] == "-" else given.get(name, 0.0)

    return {key: " ".join(text(entry(name)) for name in names) for key, names in table.items()}


def limits_text(name: str, limits: Any) -> dict[str, str]:
    """Return the attribute of a range, or no attribute if it is infinite."""
    return {name: text(limits)} if np.isfinite(limits).any() else {}


def read_law(m: mujoco.MjModel, i: int) -> ForceLaw:
    """Read the force law of actuator i."""
    gain, bias = m.actuator_gaintype[i], m.actuator_biastype[i]
    if gain == Gain.PID:
        given = parameters(m, i, _PID)
        early = bool(m.actuator_actearly[i])
        return PID(_controller(m, i, given), leaf(given.offset), _actrange(m, i), early)
    if gain == Gain.DCMOTOR:
        return _read_dc_motor(m, i)
    strength: Affine | Active
    if gain == Gain.MUSCLE:
        strength = Active(_muscle(m, i, m.actuator_gainprm[i]))
    else:
        strength = Affine(leaf(m.actuator_gainprm[i, : 3 if gain == Gain.AFFINE else 1]))
    offset: Affine | Passive | None = None
    if bias == Bias.MUSCLE:
        offset = Passive(_muscle(m, i, m.actuator_biasprm[i]))
    elif bias == Bias.AFFINE:
        offset = Affine(leaf(m.actuator_biasprm[i, :3]))
    early, circular = bool(m.actuator_actearly[i]), is_circular(m, i)
    return GainBias(strength, offset, read_activation(m, i), early, circular)


def _muscle(m: mujoco.MjModel, i: int, given: np.ndarray) -> Muscle:
    out = m.actuator_outadr[i]
    lengths, acceleration = m.actuator_lengthrange[out], m.actuator_acc0[out]
    return Muscle(leaf(given[:9]), leaf(lengths), leaf(acceleration), scaled=bool(given[2] < 0))


def read_activation(m: mujoco.MjModel, i: int) -> Activation | None:
    """Read the activation of actuator i; None if it has no state."""
    kind, given = m.actuator_dyntype[i], m.actuator_dynprm[i]
    limits = _actrange(m, i)
    if kind == Dyn.NONE:
        return None
    if kind == Dyn.INTEGRATOR:
        return ControlIntegral(limits)
    if kind == Dyn.MUSCLE:
        smooth = bool(given[2] >= mujoco.mjMINVAL)
        return Recruitment(limits, leaf(given[:2]), leaf(given[2]), smooth)
    return Filter(limits, leaf(given[0]), bool(kind == Dyn.FILTEREXACT))


def _actrange(m: mujoco.MjModel, i: int) -> Any:
    return leaf(m.actuator_actrange[i] if m.actuator_actlimited[i] else [-np.inf, np.inf])


def _controller(m: mujoco.MjModel, i: int, given: SimpleNamespace) -> PIDController:
    spec = int(m.actuator_ctrlspec[i])
    return PIDController(
        leaf([given.kp, given.ki, given.kv]),
        leaf(given.windup),
        leaf(given.slew),
        tuple(name for k, name in enumerate(INPUTS) if spec >> k & 1),
        slews=bool(np.isfinite(given.slew)),
        integrates=bool(given.ki > 0),
        circular=is_circular(m, i),
        clipped=bool(m.actuator_gaintype[i] == Gain.DCMOTOR),
    )


def _read_dc_motor(m: mujoco.MjModel, i: int) -> DCMotor:
    own, spec = parameters(m, i, _DC_MOTOR), int(m.actuator_ctrlspec[i])
    commanded = any((own.kp, own.ki, own.kv)) or np.isfinite(own.slew) or spec & 7
    names = ("resistance", "constant", "drive", "time_constant", "current_rate")
    windings: dict[str, Any] = {name: leaf(getattr(own, name)) for name in names}
    return DCMotor(
        Windings(**windings, inductive=bool(own.time_constant > 0)),
        leaf([own.amplitude, own.poles, own.phase]),
        _controller(m, i, own) if commanded else None,
        Heat(leaf([getattr(own, name) for name in _HEAT])) if own.RT > 0 else None,
        LuGre(leaf([getattr(own, name) for name in _LUGRE])) if own.s0 > 0 else None,
        voltage=bool(spec & _VOLTAGE),
    )


def write_law(law: ForceLaw) -> tuple[dict[str, str], tuple[str, ...], ForceLaw] | None:
    """Return the attributes of a law, the names of its inputs, and the law as `load` will read it.
    Return None if MJCF has no such law."""
    if isinstance(law, PID):
        return _write_pid(law), law.controller.inputs, law
    if isinstance(law, DCMotor):
        own = () if law.controller is None else law.controller.inputs
        inputs = (*own, *["voltage"] * law.voltage)
        return _write_dc_motor(law, inputs), inputs, law
    if isinstance(law, GainBias):
        law = _unscaled(law)
        return _write_gain_bias(law), ("pos",), law
    return None


def write_activation(activation: Activation | None, early: bool) -> dict[str, str]:
    """Return the attributes of an activation."""
    if activation is None:
        return {}
    out = limits_text("actrange", activation.limits) | ({"actearly": "true"} if early else {})
    if isinstance(activation, ControlIntegral):
        return out | {"dyntype": "integrator"}
    if isinstance(activation, Recruitment):
        width = activation.width if activation.smooth else 0.0
        return out | {"dyntype": "muscle", "dynprm": text([*activation.time_constants, width])}
    assert isinstance(activation, Filter)
    kind = "filterexact" if activation.exact else "filter"
    return out | {"dyntype": kind, "dynprm": text(activation.time_constant)}


def _unscaled(law: GainBias) -> GainBias:
    """Set the peak force of muscles to its value.

    MuJoCo computes it from an acceleration that a file does not contain.
    """

    def unscaled(curve: Any) -> Any:
        if not isinstance(curve, (Active, Passive)) or not curve.muscle.scaled:
            return curve
        muscle = curve.muscle
        p: Any = np.array(muscle.parameters)
        p[2] = p[3] / max(float(muscle.acceleration), mujoco.mjMINVAL)
        return type(curve)(dataclasses.replace(muscle, parameters=p, scaled=False))

    return dataclasses.replace(law, gain=unscaled(law.gain), bias=unscaled(law.bias))


def _write_gain_bias(law: GainBias) -> dict[str, str]:
    out, gain, bias = write_activation(law.activation, law.early), law.gain, law.bias
    muscles = [x.muscle for x in (gain, bias) if isinstance(x, (Active, Passive))]
    if muscles:
        out["lengthrange"] = text(muscles[0].lengthrange)
    if isinstance(gain, Affine):
        constant = len(gain.coefficients) == 1
        out |= {} if constant else {"gaintype": "affine"}
        if not (constant and gain.coefficients[0] == 1):
            out["gainprm"] = shortened(gain.coefficients)
    else:
        out |= {"gaintype": "muscle", "gainprm": text(gain.muscle.parameters)}
    if isinstance(bias, Affine):
        out |= {"biastype": "affine", "biasprm": text(bias.coefficients)}
    elif bias is not None:
        out |= {"biastype": "muscle", "biasprm": text(bias.muscle.parameters)}
    return out


def shortened(x: Any) -> str:
    """Remove the trailing zeros of an array."""
    return text(np.trim_zeros(x, "b") if np.any(x) else 0.0)


def _gains(own: PIDController) -> dict[str, Any]:
    kp, ki, kv = own.gains
    return {"kp": kp, "ki": ki, "kv": kv, "windup": own.windup, "slew": own.slew}


def _write_pid(law: PID) -> dict[str, str]:
    own = law.controller
    out = {"gaintype": "pid", "biastype": "affine", "input": " ".join(own.inputs)}
    out |= limits_text("actrange", law.limits)
    out |= attributes(_PID, **_gains(own), offset=law.offset)
    if not own.size:
        return out | {"dynprm": "0"}
    early = {"actearly": "true"} if law.early else {}
    return out | early | {"dyntype": "pid", "actdim": str(own.size)}


def _write_dc_motor(law: DCMotor, inputs: tuple[str, ...]) -> dict[str, str]:
    windings = {f.name: getattr(law.windings, f.name) for f in dataclasses.fields(Windings)}
    if not windings.pop("inductive"):
        windings["time_constant"] = 0.0
    given = windings | ({} if law.controller is None else _gains(law.controller))
    for names, part in ((_HEAT, law.heat), (_LUGRE, law.bristles)):
        given |= {} if part is None else dict(zip(names, part.numbers, strict=True))
    given |= dict(zip(("amplitude", "poles", "phase"), law.cogging, strict=True))
    out = dict.fromkeys(("dyntype", "gaintype", "biastype"), "dcmotor")
    out |= {"input": " ".join(inputs) or "none", "actlimited": "false", "actearly": "true"}
    out |= attributes(_DC_MOTOR, **given)
    return out | ({"actdim": str(law.size)} if law.size else {})
