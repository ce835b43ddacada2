"""The drives of a robot file, from its actuators or from motors given by the user.

An actuator on hinges has arms r, gain k and bias b (MuJoCo, *Computation*, actuation):

    tau_j = r_j f,   f = k u + b_0 + b_1 l + b_2 l',   l' = sum r_j v_j
    b = 0              a `TorqueSource` with the split k r
    b = (0, 0, -k)     a `SpeedServo` of gain k with the split r, limited by the force range
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rbjax.errors import InputError
from rbjax.loading.at_rest import FileActuator
from rbjax.wheeled.files.joints import Roles
from rbjax.wheeled.files.wheels import FileWheel, LeftOut
from rbjax.wheeled.robot.motors import Motor, SpeedServo, TorqueSource
from rbjax.wheeled.robot.robot import Drive

#: the wheels of a drive: a name or pattern, or a tuple of them behind one differential
_FIX = "give drives={'a wheel': a Motor, ('left', 'right'): a Motor on a differential}"


def drives_of(
    roles: Roles, wheels: Sequence[FileWheel], given: Any, out: LeftOut
) -> tuple[Drive, ...]:
    """Make drives in the order of `given`, or of the file's actuators if it is None.

    If the file has no actuators on wheels, each wheel except casters has a torque source.

    Raises:
        InputError: an actuator of another law, several on one wheel, no motors.
    """
    if given is None:
        made = [
            _of_actuator(roles, wheels, x, out)
            for x in roles.rest.actuators()
            if any(j in roles.wheels for j in x.arms)
        ]
        free = [i for i, w in enumerate(wheels) if w.kind != "caster"]
        made = made or [Drive((i,)) for i in free]
    else:
        made = _of_user(roles, wheels, given)
    named = [i for drive in made for i in drive.wheels if len(drive.wheels) == 1]
    twice = sorted({roles.name(roles.wheels[i]) for i in named if named.count(i) > 1})
    if twice:
        raise InputError(
            f"from_file: several drives turn only one of the wheels {', '.join(twice)}, expected "
            f"one for each; {_FIX}"
        )
    return tuple(made)


def _of_actuator(
    roles: Roles, found: Sequence[FileWheel], given: FileActuator, out: LeftOut
) -> Drive:
    where = f"from_file: the actuator {given.name!r}"
    others = [roles.name(j) for j in given.arms if j not in roles.wheels]
    if others:
        raise InputError(
            f"{where} turns wheels together with {', '.join(others)}, expected wheels only; {_FIX}"
        )
    if given.odd:
        raise InputError(f"{where} has no motor here: {given.odd}; {_FIX}")
    wheels = tuple(roles.wheels.index(j) for j in given.arms)
    arms = np.array(
        [arm * found[i].sense for i, arm in zip(wheels, given.arms.values(), strict=True)]
    )
    low, high = given.force
    if not any(given.bias):
        if math.isfinite(low) or math.isfinite(high):
            out.found.append(f"{given.name}: limits of its force")
        return Drive(wheels, TorqueSource(), given.gain * arms)
    if given.gain > 0 and given.bias == (0.0, 0.0, -given.gain):
        gain: Any = given.gain
        limit: Any = min(-low, high)
        if limit <= 0:
            raise InputError(
                f"{where} has forces from {low:g} to {high:g}, expected both signs; {_FIX}"
            )
        if math.isfinite(limit) and -low != high:
            out.found.append(f"{given.name}: the larger one of the limits of its force")
        return Drive(wheels, SpeedServo(gain, limit), arms)
    raise InputError(
        f"{where} has the gain {given.gain:g} and the bias {given.bias}, expected a torque (no "
        f"bias) or a servo of the speed (bias 0, 0, {-given.gain:g}); {_FIX}"
    )


def _of_user(roles: Roles, wheels: Sequence[FileWheel], given: Any) -> list[Drive]:
    """Make one drive for each wheel that matches a name or pattern, and one drive for each tuple of
    wheels.

    given: a mapping from names or tuples to motors, or a sequence of names or tuples.
    """
    pairs: Iterable[tuple[Any, Motor]]
    if isinstance(given, Mapping):
        pairs = given.items()
    elif isinstance(given, Iterable):
        pairs = [(x, TorqueSource()) for x in ([given] if isinstance(given, str) else given)]
    else:
        raise InputError(f"from_file: drives is {given!r}, expected names of wheels; {_FIX}")
    made = []
    for names, motor in pairs:
        numbers = [roles.wheels.index(j) for j in roles.wheels_named("drives", names)]
        if isinstance(names, str):
            made += [Drive((i,), motor, [wheels[i].sense]) for i in numbers]
        else:
            # all turn in the direction of the first
            first = wheels[numbers[0]].ahead
            signs = [math.copysign(1.0, wheels[i].ahead @ first) for i in numbers]
            made.append(Drive(tuple(numbers), motor, np.array(signs) / len(signs)))
    return made
