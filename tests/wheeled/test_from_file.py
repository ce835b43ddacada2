"""Wheeled robots from files: against MuJoCo's own matrices of the whole file, rolling."""

import functools
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rbjax import wheeled
from rbjax.errors import InputError, UnknownName, UnsupportedFeature
from rbjax.loading.sources import compile_model
from rbjax.model import State
from rbjax.wheeled import DCMotor, SpeedServo, TorqueSource
from rbjax.wheeled.kinematics.parameters import parameters_of
from tests.oracles.rolling_mujoco import RollingFile, Touch, ackermann
from tests.tolerances import relative_error
from tests.wheeled.test_full_model import full_rates, stacked

upkie_description = pytest.importorskip("upkie_description")

FILES = Path(__file__).parent / "files"
RACECAR, HUSKY = FILES / "racecar.xml", FILES / "four_wheels.urdf"
CART = FILES / "cart_with_trailer.xml"
UPKIE = Path(upkie_description.__file__).parent / "urdf" / "upkie.urdf"
#: as the reference's: its derivative of fourth order and its least squares leave 1e-11
ORACLE = 1e-10


@dataclass(frozen=True)
class Case:
    """A file, what `from_file` is given, and the same for the oracle."""

    source: Any
    given: dict[str, Any]
    touches: list[Touch]
    moves: tuple[str, ...] = ()
    steers: tuple[str, ...] = ()
    skidding: float | None = None
    held: dict[str, float] = field(default_factory=dict)


def _four(**others) -> list[Touch]:
    names = [f"{a}_{b}_wheel" for a in ("front", "rear") for b in ("left", "right")]
    return [Touch(n, f"{n}_link", 0.1651, **others) for n in names]


def _upkie() -> str:
    """Without the two virtual links that put a gramme off each axle."""
    text = UPKIE.read_text()
    for link in ("left_contact", "left_wheel_center", "right_contact", "right_wheel_center"):
        text = re.sub(rf'(<link name="{link}">.*?<mass value=")0.001', r"\g<1>0", text, flags=re.S)
    return text


MECANUM = {"front_left*": -0.8, "front_right*": 0.8, "rear_left*": 0.8, "rear_right*": -0.8}
POSE = {"left_hip": 0.5, "left_knee": -1.0, "right_hip": -0.5, "right_knee": 1.0}
STEERING = ("left_steering", "right_steering")
REAR = [Touch("rear_left", "trailer_left", 0.1), Touch("rear_right", "trailer_right", 0.1)]
CASES = {
    "upkie": Case(
        _upkie(), {"wheels": "*_wheel", "q": POSE},
        [Touch(f"{s}_wheel", f"{s}_wheel_center", 0.05) for s in ("left", "right")], held=POSE,
    ),
    "skid_steer": Case(
        HUSKY, {"wheels": "*_wheel", "skids": True}, _four(skids=True), skidding=0.0
    ),
    "mecanum": Case(
        HUSKY, {"wheels": "*_wheel", "rollers": MECANUM},
        [Touch(t.joint, t.centre, t.radius, roller=a)
         for t, a in zip(_four(), MECANUM.values(), strict=True)],
    ),
    "car": Case(
        RACECAR, {"wheels": "*_wheel", "steerings": [STEERING]},
        [Touch(f"{n}_wheel", n, 0.05)
         for n in ("left_rear", "right_rear", "left_front", "right_front")],
        STEERING, STEERING,
    ),
    "caster_and_trailer": Case(
        CART, {"wheels": ["left", "right", "roll", "rear_*"], "casters": "swivel",
               "trailers": "hitch", "q": {"arm": 0.3}},
        [Touch("left", "left_body", 0.1), Touch("right", "right_body", 0.1),
         Touch("roll", "small", 0.05), *REAR],
        ("swivel", "hitch"), held={"arm": 0.3},
    ),
}  # fmt: skip
every_case = pytest.mark.parametrize("name", CASES)


def racecar(*changes: tuple[str, str]) -> str:
    text = RACECAR.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text


KEYS = (re.search("<keyframe>.*</keyframe>", RACECAR.read_text(), re.S)[0], "")


@functools.cache
def made(name: str) -> wheeled.Robot:
    case = CASES[name]
    return wheeled.from_file(case.source, **case.given, strict=True)


@functools.cache
def reference(name: str) -> RollingFile:
    case = CASES[name]
    m = compile_model(case.source, floating_base=None)
    return RollingFile(m, case.touches, case.moves, case.steers, case.skidding)


def start(name: str) -> np.ndarray:
    """The configuration that is held, with the chassis' heading 0, at the origin."""
    m, held = reference(name).m, CASES[name].held
    q = m.qpos0.copy()
    q[:2], q[3:7] = 0.0, [1, 0, 0, 0]
    for joint, value in held.items():
        q[m.jnt_qposadr[m.joint(joint).id]] = value
    return q


def to_file(name: str, q: np.ndarray, rates: np.ndarray, b: tuple[np.ndarray, np.ndarray]):
    """q and v of the file, and rates of its steerings' rates, by coordinates and rates of the
    robot, and angles and rates of its steerings."""
    robot, m = made(name), reference(name).m
    layout, there, v, steering = robot.layout, start(name), np.zeros(m.nv), []
    there[:2] = q[:2]
    there[3:7] = [np.cos(q[2] / 2), 0.0, 0.0, np.sin(q[2] / 2)]
    v[:2], v[5] = rates[:2], rates[2]

    def put(joint: str, angle: float, rate: float, sign: float = 1.0) -> None:
        j = m.joint(joint).id
        there[m.jnt_qposadr[j]] += sign * angle
        v[m.jnt_dofadr[j]] = sign * rate

    for shaft, i in enumerate(layout.setters):
        at = layout.shafts.start + shaft
        put(robot.wheels[i].shaft, q[at], rates[at], sense(robot.wheels[i]))
    for k, joint in enumerate(n for n in CASES[name].moves if n == "hitch"):
        put(joint, q[layout.trailers.start + k], rates[layout.trailers.start + k], -1.0)
    for k, joint in enumerate(n for n in CASES[name].moves if n == "swivel"):
        put(joint, q[layout.casters.start + k], rates[layout.casters.start + k], -1.0)
    if CASES[name].steers:
        for joint, y, sign in zip(STEERING, (0.1, -0.1), (1.0, -1.0), strict=True):
            angle, rate, bent = ackermann(b[0][0], b[1][0], 0.325, y)
            put(joint, angle, rate, sign)
            steering.append(sign * bent)
    return there, v, np.array(steering)


def laws(robot: wheeled.Robot, fidelity: str):
    """The robot's rates of coordinates, and the rates of its full velocities, at a fidelity."""
    reduced, law = wheeled.at(robot, "reduced"), wheeled.at(robot, fidelity)

    def found(q, v, u):
        context = reduced.context(State(q, v), u)
        n = context.n
        w = reduced.full_velocities(context)
        if fidelity == "constrained":
            rates = stacked(law.accelerations(replace(context, v=w)))
        else:
            rates = stacked(full_rates(n, context, w, law.accelerations(context)))
        return stacked(reduced.coordinate_rates(context)), rates

    return jax.jit(found)


@pytest.mark.parametrize(
    "fidelity",
    ["dynamical"]
    + [pytest.param(f, marks=pytest.mark.slow)
       for f in ("reduced", "quasi_velocities", "constrained")],
)  # fmt: skip
@every_case
def test_accelerations_are_those_of_the_whole_file(name, fidelity) -> None:
    """Nothing is lost: at random places, angles, speeds and controls, MuJoCo's whole model on
    rolling wheels moves as the robot does."""
    robot, oracle = made(name), reference(name)
    run, rng, layout, m = laws(robot, fidelity), np.random.default_rng(5), robot.layout, oracle.m
    for _ in range(3):
        q = rng.uniform(-0.6, 0.6, layout.nq)
        v, u = rng.normal(size=robot.arrangement.mobility), rng.normal(size=robot.nu)
        rates, ours = map(np.asarray, run(q, v, u))
        b = q[layout.steerings], u[len(robot.drives) :]
        there, moving, steering = to_file(name, q, rates, b)
        ctrl, torques = np.zeros(m.nu), {}
        if m.nu:
            ctrl[:2] = u[:2]
        else:
            torques = {w.shaft: t for w, t in zip(robot.wheels, u, strict=True)}
        allowed = oracle.rows(there) @ moving
        # the velocities of the robot are those that the file allows; of steerings, as asked for
        loose = len(allowed) - len(steering)
        np.testing.assert_allclose(allowed[:loose], 0.0, atol=1e-13 * max(1, abs(moving).max()))
        a = oracle.acceleration(there, moving, ctrl, torques, steering)
        # (R V)' = R (V' + w x V)
        c, s = np.cos(q[2]), np.sin(q[2])
        (ax, ay), (x, y) = (np.array([[c, s], [-s, c]]) @ z[:2] for z in (a, moving))
        due = [ax + moving[5] * y, ay - moving[5] * x, a[5]]
        own = [joint for joint in CASES[name].moves if joint == "hitch"]
        due += [-a[m.jnt_dofadr[m.joint(joint).id]] for joint in own]
        for i in layout.setters:
            at = m.jnt_dofadr[m.joint(robot.wheels[i].shaft).id]
            due.append(sense(robot.wheels[i]) * a[at])
        assert relative_error(ours, np.array(due)) < ORACLE


def sense(wheel: wheeled.Wheel) -> float:
    """The caster of the cart has an axle that points to the right."""
    return -1.0 if wheel.kind == "caster" else 1.0


@pytest.mark.parametrize("name", ["upkie", "skid_steer", "car"])
def test_mass_and_places_are_those_of_mujoco(name) -> None:
    """By the mass matrix on the free joint, and the places of bodies, at the configuration."""
    robot, oracle, case = made(name), reference(name), CASES[name]
    m, d = oracle.m, oracle.d
    oracle.rows(start(name))
    d.qvel[:] = 0
    mujoco.mj_forward(m, d)
    M = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, d, M)
    body = parameters_of(robot, jnp.float64).bodies[0]
    np.testing.assert_allclose(body.mass, M[0, 0], rtol=1e-12)
    com = d.subtree_com[1] - d.xpos[1]
    np.testing.assert_allclose(np.array(body.moment) / body.mass, com[:2], atol=1e-14)
    np.testing.assert_allclose(body.inertia, M[5, 5], rtol=1e-12)
    bottom = d.xpos[m.body(case.touches[0].centre).id, 2] - case.touches[0].radius
    np.testing.assert_allclose(body.height, d.subtree_com[1, 2] - bottom, rtol=1e-12)
    by_name = {w.shaft: w for w in robot.wheels}
    for touch in case.touches:
        wheel, at = by_name[touch.joint], m.jnt_dofadr[m.joint(touch.joint).id]
        place = d.xpos[m.body(touch.centre).id] - d.xpos[1]
        np.testing.assert_allclose(wheel.position, place[:2], atol=1e-14)
        np.testing.assert_allclose(wheel.radius, touch.radius, rtol=1e-12)
        np.testing.assert_allclose(wheel.inertia, M[at, at], rtol=1e-12)


@pytest.mark.filterwarnings("ignore:from_file")
def test_the_chassis_frame_is_where_the_file_has_it_at_any_pose() -> None:
    given = CASES["car"].given
    for other in (
        wheeled.from_file(RACECAR, **given, q="elsewhere"),
        wheeled.from_file(RACECAR, **given, frame="chassis"),
        wheeled.from_file(compile_model(RACECAR), **given),
        wheeled.from_file(mujoco.MjSpec.from_file(str(RACECAR)), **given),
        wheeled.from_file(racecar(('<freejoint name="base"/>', ""), KEYS), **given),
    ):
        for a, b in zip(jax.tree.leaves(made("car")), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-14)
    # steering and wheel on one body
    knuckle = re.search(r'<body name="left_hinge".*?</body>\s*</body>', racecar(), re.S)[0]
    merged = re.sub(r'<body name="left_front">\s*<inertial.*?/>', "", knuckle)
    merged = re.sub(r"</body>\s*</body>", "</body>", merged)
    merged = re.sub(r"<inertial.*?/>", '<inertial pos="0 0 0.002269889910339349" mass="0.44055" '
                    'diaginertia="0.0002782 0.0004300 0.00028046"/>', merged)  # fmt: skip
    one = wheeled.from_file(racecar((knuckle, merged), KEYS), **given, tolerance=0.02)
    assert [w.kind for w in one.wheels] == [w.kind for w in made("car").wheels]
    for wheel, same in zip(one.wheels, made("car").wheels, strict=True):
        np.testing.assert_allclose(wheel.position, same.position, atol=1e-14)
        np.testing.assert_allclose([wheel.mass, wheel.yaw_inertia], [same.mass, same.yaw_inertia])
    laser = wheeled.from_file(RACECAR, **given, frame="laser")
    for wheel, same in zip(laser.wheels, made("car").wheels, strict=True):
        np.testing.assert_allclose(wheel.position + np.array([0.265, 0.0]), same.position,
                                   atol=1e-15)  # fmt: skip


def test_gravity_at_an_angle_is_a_slope() -> None:
    text = RACECAR.read_text().replace('model="racecar">', 'model="racecar">'
                                       '<option gravity="1.2 0.5 -9.6"/>')  # fmt: skip
    robot = wheeled.from_file(text, **CASES["car"].given)
    n = parameters_of(robot, jnp.float64)
    turned = np.array([[np.sqrt(0.75), 0.5], [-0.5, np.sqrt(0.75)]]) @ [1.2, 0.5]
    np.testing.assert_allclose([*n.downhill, n.gravity], [*turned, 9.6], rtol=1e-12)


@pytest.mark.parametrize("fidelity", ["kinematic", "slipping"])
@pytest.mark.parametrize(
    "name", ["upkie", "car", *(pytest.param(n, marks=pytest.mark.slow) for n in
                               ("skid_steer", "mecanum", "caster_and_trailer"))],
)  # fmt: skip
def test_other_fidelities_run_and_go_straight_ahead(name, fidelity) -> None:
    robot = made(name)
    drives = tuple(d.replace(motor=SpeedServo(5.0)) for d in robot.drives)
    vehicle = wheeled.at(robot.replace(drives=drives), fidelity)
    speeds = wheeled.commands(vehicle.robot, [0.5, 0.0, 0.0]).speeds
    u = jnp.concatenate([speeds, jnp.zeros(len(robot.steerings))])
    first = wheeled.start(vehicle, twist=[0.5, 0.0, 0.0])
    rate = wheeled.rates(vehicle, first, u)
    np.testing.assert_allclose(rate.q[:3], [0.5, 0.0, 0.0], atol=1e-9)
    assert bool(jnp.isfinite(rate.v).all())


def test_speeds_have_the_signs_of_the_files_joints() -> None:
    robot = made("upkie")
    left, right = wheeled.commands(robot, [0.3, 0.0, 0.0]).speeds
    np.testing.assert_allclose([left, right], [6.0, -6.0], rtol=1e-12)
    vehicle = wheeled.at(wheeled.from_file(_upkie(), ["right_wheel", "left_wheel"], q=POSE),
                         "reduced")  # fmt: skip
    # free velocities are ahead, although the wheel that leads has its heading behind
    found = wheeled.start(vehicle, twist=[0.3, 0, 0.1]).v
    np.testing.assert_allclose(found, [0.3, 0.1], rtol=1e-12)


# ------------------------------------------------------------------- drives


def cart(*actuators: str, **given: Any) -> wheeled.Robot:
    """The cart's wheels with actuators in the file."""
    text = re.sub(r"<motor.*?/>", "", CART.read_text())
    text = text.replace("<actuator>", "<actuator>" + "".join(actuators))
    if any("tendon" in a for a in actuators):
        fixed = "".join(
            f'<fixed name="{n}"><joint joint="left" coef="{a}"/><joint joint="right" coef="{b}"/>'
            "</fixed>"
            for n, a, b in (("sum", 0.5, -0.5), ("turn", -0.5, -0.5))
        )
        text = text.replace("<actuator>", f"<tendon>{fixed}</tendon><actuator>")
    return wheeled.from_file(text, ["left", "right"], **given)


def test_actuators_become_drives() -> None:
    servo, geared = cart(
        '<velocity joint="right" kv="3" gear="2" forcerange="-4 4"/>',
        '<motor joint="left" gear="-5"/>',
    ).drives
    assert servo.wheels == (1,) and geared.wheels == (0,)
    assert (float(servo.motor.gain), float(servo.motor.limit)) == (3.0, 4.0)
    assert (servo.split.tolist(), geared.split.tolist()) == ([2.0], [-5.0])
    (differential,) = cart('<motor tendon="sum" gear="8"/>').drives
    assert differential.wheels == (0, 1)
    assert differential.split.tolist() == [4.0, -4.0]
    assert [d.wheels for d in cart().drives] == [(0,), (1,)]


def test_tendons_that_share_wheels_add_their_torques() -> None:
    """As MuJoCo's own car has them: one actuator goes ahead, one turns."""
    both = cart('<motor tendon="sum" gear="2"/>', '<motor tendon="turn"/>')
    each = cart('<motor joint="left"/>', '<motor joint="right"/>')
    found = []
    for robot, u in ((both, [0.3, 0.1]), (each, [0.3 - 0.05, -0.3 - 0.05])):
        vehicle = wheeled.at(robot, "reduced")
        state = wheeled.start(vehicle, twist=[0.4, 0.0, 0.2])
        found.append(wheeled.rates(vehicle, state, u).v)
    np.testing.assert_allclose(*found, rtol=1e-12)


def test_drives_of_a_user() -> None:
    motor = DCMotor(2.0, 0.05, gear=20.0)
    (one,) = cart(drives={("left", "right"): motor}).drives
    # the right axle points to the right
    assert one.motor is motor or one.motor == motor
    assert (one.wheels, one.split.tolist()) == ((0, 1), [0.5, -0.5])
    assert [d.wheels for d in cart(drives=["right"]).drives] == [(1,)]
    assert isinstance(cart(drives="left").drives[0].motor, TorqueSource)
    assert cart(drives=[]).drives == ()


@pytest.mark.parametrize(
    ("actuators", "words"),
    [
        (['<position joint="left" kp="3"/>'], ["position servo|bias", "drives="]),
        (['<motor joint="left"/>', '<motor joint="left"/>'], ["several drives"]),
        (['<intvelocity joint="left" actrange="-1 1"/>'], ["state", "drives="]),
        (['<velocity joint="left" kv="1" forcerange="0 1"/>'], ["both signs"]),
    ],
)
def test_actuators_without_a_drive_are_refused(actuators, words) -> None:
    with pytest.raises(InputError) as caught:
        cart(*actuators)
    for word in words:
        assert re.search(word, str(caught.value)), str(caught.value)


# ------------------------------------------------------------------- what is left out or refused


def test_what_is_left_out_is_said_once_or_raised() -> None:
    with pytest.warns(UserWarning, match="left_wheel: a centre of mass off the axle by 0.255 mm"):
        wheeled.from_file(UPKIE, "*_wheel")
    with pytest.raises(UnsupportedFeature, match="not even about the axle"):
        wheeled.from_file(UPKIE, "*_wheel", strict=True)
    car = RACECAR.read_text()
    aside = car.replace('<body name="left_front">', '<body name="left_front" pos="0 0.0225 0">')
    with pytest.raises(UnsupportedFeature, match=r"off the axis of left_steering by 22\.5 mm"):
        wheeled.from_file(aside, **CASES["car"].given, strict=True)
    rough = car.replace('damping="1e-3"', 'frictionloss="1" stiffness="2"')
    with pytest.raises(UnsupportedFeature, match=r"left_rear_wheel: friction loss.*a spring"):
        wheeled.from_file(rough, **CASES["car"].given, strict=True)


def test_shapes_that_are_only_seen_serve_where_there_are_no_others(tmp_path) -> None:
    """Upkie's tyre is an STL mesh of the same size, which its package has."""
    text = re.sub("<collision>.*?</collision>", "", _upkie(), flags=re.S)
    with pytest.raises(InputError, match=r"left_wheel.*no shape.*radius=\{'left_wheel'"):
        wheeled.from_file(text, "*_wheel")
    given = wheeled.from_file(text, "*_wheel", radius={"left_wheel": 0.06, "right_wheel": 0.06})
    np.testing.assert_allclose([w.radius for w in given.wheels], 0.06)
    # without a shape its place is that of its joint
    np.testing.assert_allclose(given.wheels[0].position, [0.0, 0.1984], atol=1e-12)
    package = tmp_path / "upkie_description"
    (package / "urdf").mkdir(parents=True)
    (package / "meshes").symlink_to(UPKIE.parents[1] / "meshes")
    (package / "urdf" / "bare.urdf").write_text(text)
    seen = wheeled.from_file(package / "urdf" / "bare.urdf", "*_wheel")
    np.testing.assert_allclose([w.radius for w in seen.wheels], 0.05, rtol=0.03)
    np.testing.assert_allclose(seen.wheels[0].position, [0.0, 0.1524], atol=2e-3)


KNUCKLE = '<joint name="left_steering" class="steering"/>'
CAR = CASES["car"].given
WHEELS, DRIVEN = {"wheels": "*_wheel"}, {"wheels": ["left", "right"]}
BENT = {**POSE, "left_knee": -0.5}


@pytest.mark.parametrize(
    ("source", "given", "error", "words"),
    [
        (UPKIE, {"wheels": "wheel"}, UnknownName, ["hinge of wheels 'wheel'", "'left_hip'"]),
        (UPKIE, {"wheels": []}, InputError, ["no wheels", "'right_wheel'"]),
        (UPKIE, {"wheels": "floating_base"}, InputError, ["a free, expected a hinge"]),
        (UPKIE, {**WHEELS, "casters": "left_wheel"}, InputError, ["left_wheel", "twice"]),
        (UPKIE, {"wheels": ["left_knee", "left_wheel"]}, InputError, ["below left_knee", "wheel"]),
        (_upkie(), {**WHEELS, "q": BENT}, InputError,
         ["level ground", "left_wheel 0 mm, right_wheel 21.4 mm"]),
        (UPKIE, {**WHEELS, "q": "kneel"}, UnknownName, ["keyframe 'kneel'"]),
        (UPKIE, {**WHEELS, "q": {"knee": 1.0}}, UnknownName, ["joint 'knee'", "left_knee"]),
        (UPKIE, {**WHEELS, "q": {"left_knee": np.nan}}, InputError, ["left_knee", "finite"]),
        (UPKIE, {**WHEELS, "q": [0.0]}, InputError, ["13 finite numbers", "keyframe"]),
        (UPKIE, {**WHEELS, "radius": -1.0}, InputError, ["radius is -1.0", "above zero"]),
        (UPKIE, {**WHEELS, "frame": "nose"}, UnknownName,
         ["body or site 'nose'", "known body names", "'base'", "known site names"]),
        (racecar(('name="laser"', 'name="laser" euler="0 90 0"')), {**CAR, "frame": "laser"},
         InputError, ["x axis of 'laser' is 90 degrees"]),
        (UPKIE, {**WHEELS, "drives": "left_knee"}, InputError, ["drives name 'left_knee'"]),
        (RACECAR, {**CAR, "wheels": "*_rear_wheel"}, InputError,
         ["'left_steering' carries 0 of the wheels", "'left_front_wheel'"]),
        (RACECAR, {**CAR, "rollers": {"left_front_wheel": 0.5}}, InputError,
         ["rollers", "steered"]),
        (racecar((KNUCKLE, KNUCKLE.replace("/>", ' axis="0 0.3 1"/>'))), CAR, InputError,
         ["'left_steering' leans 16.7 degrees from the vertical"]),
        (racecar(('euler="0 0 30"', 'euler="5 0 0"')), CAR, InputError,
         ["axle of wheel 'left_rear_wheel' leans 5 degrees"]),
        (RACECAR, {**CAR, "shafts": {"rear": "*_rear_wheel"}}, InputError,
         ["opposite directions", "'rear'"]),
        (RACECAR, {**CAR, "steerings": (), "casters": STEERING}, InputError,
         ["0 mm behind", "is it a steering"]),
        (CART, {**DRIVEN, "trailers": "hitch"}, InputError, ["none of the wheels"]),
        (CART, {**DRIVEN, "trailers": "arm"}, InputError, ["leans 90 degrees"]),
        ("<mujoco/>", WHEELS, UnknownName, ["there are none"]),
        (UPKIE, {"wheels": 3}, InputError, ["wheels is 3, expected names", "'left_hip'"]),
        (UPKIE, {"wheels": [["left_wheel"]]}, InputError, ["expected names or glob patterns"]),
        (UPKIE, {**WHEELS, "rollers": 0.7}, InputError, ["rollers is 0.7, expected a mapping"]),
        (UPKIE, {**WHEELS, "shafts": "left"}, InputError, ["shafts is 'left', expected a mapping"]),
        (UPKIE, {**WHEELS, "drives": 2}, InputError, ["drives is 2", "drives="]),
        (UPKIE, {**WHEELS, "drives": {"left_wheel": 2}}, InputError, ["motor is 2"]),
        (UPKIE, {**WHEELS, "tolerance": -1}, InputError, ["tolerance is -1"]),
        (UPKIE, {**WHEELS, "skids": "left_knee"}, InputError, ["skids name 'left_knee'"]),
    ],
    ids=range(31),
)  # fmt: skip
@pytest.mark.filterwarnings("ignore:from_file")
def test_bad_arguments_are_refused_in_a_sentence(source, given, error, words) -> None:
    with pytest.raises(error) as caught:
        wheeled.from_file(source, **given)
    for word in words:
        assert re.search(word, str(caught.value)), str(caught.value)


def test_a_crowd_in_one_file_is_refused() -> None:
    two = racecar(KEYS).replace(
        "</worldbody>", '<body name="other" pos="0 0 3"><freejoint/><geom size="0.1" mass="1"/>'
        '<body><joint name="spare_wheel" axis="0 1 0"/><geom size="0.1" mass="1"/></body></body>'
        "</worldbody>",
    )  # fmt: skip
    with pytest.raises(InputError, match="belong to 2 robots"):
        wheeled.from_file(two, **CAR)


def test_numbers_are_leaves_in_the_dtype_of_jax() -> None:
    robot = made("car")
    assert all(isinstance(x, jax.Array) for x in jax.tree.leaves(robot))
    moved = robot.replace(gravity=1.6)
    assert moved.arrangement == robot.arrangement
