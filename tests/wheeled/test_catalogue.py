"""Robots by their names: where wheels stand, what bodies weigh, which axle is driven."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.wheeled import Body, Drive, Robot, Steering, Wheel, kinds
from rbjax.wheeled.kinematics.context import RobotContext
from rbjax.wheeled.kinematics.odometry import HeadingSlip
from rbjax.wheeled.kinematics.parameters import parameters_of
from rbjax.wheeled.kinematics.planar import Dual, inverse_root
from rbjax.wheeled.robot import catalogue

MASS, INERTIA = 7.0, 3.0


@pytest.mark.parametrize("kind", ["unicycle", "car", "bicycle", "tricycle", "skid_steer"])
def test_mass_and_inertia_are_those_of_the_chassis(kind):
    chassis = kinds()[kind].make(mass=MASS, inertia=INERTIA).bodies[0]
    assert (float(chassis.mass), float(chassis.inertia)) == (MASS, INERTIA)


@pytest.mark.parametrize(
    "kind", ["differential_drive", "mecanum", "car", "front_drive_car", "tricycle", "skid_steer"]
)
def test_wheels_stand_half_a_track_beside_the_middle(kind):
    robot = kinds()[kind].make(track=0.6)
    sides = np.array([wheel.position[1] for wheel in robot.wheels])
    np.testing.assert_allclose(sides[sides != 0], 0.3 * np.sign(sides[sides != 0]), rtol=1e-15)
    assert sides.sum() == 0 and (sides != 0).sum() >= 2


def test_trailers_of_a_kind():
    for name, count in {"tractor_trailers": 2, "car_trailer": 1, "car": 0}.items():
        assert len(kinds()[name].make().bodies) - 1 == count


def test_the_driven_axle_has_a_name():
    for drive, wheels in {"rear": [(0, 1)], "front": [(2, 3)], "all": [(0, 1), (2, 3)]}.items():
        assert [x.wheels for x in catalogue.car(drive=drive).drives] == wheels
    with pytest.raises(rb.UnknownName, match=r"drive 'middle'.*'front'"):
        catalogue.car(drive="middle")


@pytest.mark.parametrize("kind", ["tractor_trailers", "omni_3"])
def test_full_velocities_are_a_twist_and_rates_of_trailers_and_shafts(kind):
    robot = kinds()[kind].make()
    layout = robot.layout
    assert layout.nw == 3 + (len(robot.bodies) - 1) + len(layout.setters)
    assert len(layout.setters) == len(robot.wheels)  # none share a shaft


def test_a_caster_turns_by_itself():
    """Its mass counts with the chassis, in its pivot; its inertia does not (Huygens-Steiner)."""
    wheels = [
        Wheel([0.1, 0.2], mass=2.0, yaw_inertia=0.3),
        Wheel([0.1, -0.2], mass=2.0, yaw_inertia=0.3),
        Wheel([-0.4, 0.1], mass=0.5, yaw_inertia=0.7, kind="caster"),
    ]
    robot = Robot.of(Body(10.0, 1.5, [0.05, 0.02]), wheels, [Drive((0,)), Drive((1,))])
    moments = 10.0 * (0.05**2 + 0.02**2) + 2 * 2.0 * (0.1**2 + 0.2**2) + 0.5 * (0.4**2 + 0.1**2)
    body = parameters_of(robot, jnp.float64).bodies[0]
    np.testing.assert_allclose(body.inertia, 1.5 + 2 * 0.3 + moments, rtol=1e-14)
    np.testing.assert_allclose(body.mass, 14.5, rtol=1e-15)


@pytest.mark.parametrize("turned", [0.0, 0.7, np.pi / 2])
def test_axles_of_a_steered_car_meet_in_one_point(turned):
    """Ackermann's condition, of cars that drive ahead or aslant in the chassis' axes."""
    c, s = np.cos(turned), np.sin(turned)
    places = np.array([[0.3, 0.7], [0.3, -0.7], [2.3, 0.7], [2.3, -0.7]]) @ [[c, s], [-s, c]]
    kind = ["fixed", "fixed", "steered", "steered"]
    wheels = [Wheel(p, turned, kind=k) for p, k in zip(places, kind, strict=True)]
    robot = Robot.of(Body(10.0, 1.0), wheels, [Drive((0, 1))], [Steering((2, 3))])
    layout = robot.layout
    q = [0.0] * layout.nq
    q[layout.steerings.start] = 0.4
    ahead = np.array(
        RobotContext(parameters_of(robot, jnp.float64), q, [], [], []).shape.wheels, float
    )
    np.testing.assert_allclose((ahead**2).sum(1), 1.0, rtol=1e-14)
    reach = (ahead * places).sum(1)  # e . (p - c) = 0 for the centre c
    centre = np.linalg.lstsq(ahead, reach, rcond=None)[0]
    np.testing.assert_allclose(ahead @ centre, reach, rtol=0, atol=1e-13)
    middle = places[2:].mean(0) - places[:2].mean(0)  # 2 m; the middle turns by 0.4 rad
    away = np.linalg.norm(centre - places[:2].mean(0))
    np.testing.assert_allclose(away, np.linalg.norm(middle) / np.tan(0.4), rtol=1e-12)


def test_an_inverse_root_and_its_rate():
    assert inverse_root(4.0) == 0.5
    found = inverse_root(Dual(4.0, 3.0))
    assert (found.value, found.rate) == (0.5, -0.5 * 4.0**-1.5 * 3.0)


def test_a_slip_of_none_is_the_identity():
    """V = C z with z = (arm w, |u|, ux, uy), without terms that change with the speed."""
    none = HeadingSlip.none(arm=0.2)
    assert (none.harmonics, none.speed_harmonics) == (1, -1)
    assert none.coefficients.tolist() == [[0, 0, 1, 0], [0, 0, 0, 1], [1, 0, 0, 0]]


def test_what_no_robot_has_is_refused():
    wheels = [Wheel([0.0, y]) for y in (-0.2, 0.2)]

    def traced(y):
        return Robot.of(Body(1.0, 1.0), [Wheel([0.0, y])]).gravity

    with pytest.raises(rb.InputError, match="parameters are traced"):
        jax.eval_shape(traced, 0.1)
    with pytest.raises(rb.InputError, match=r"motor is 2\.0"):
        Robot.of(Body(1.0, 1.0), wheels, [Drive((0,), 2.0)])
    with pytest.raises(rb.InputError, match=r"Drive\(wheels=...\): got list"):
        Drive([0, 1])
    for name in ("friction", "rotor_inertia"):
        with pytest.raises(rb.InputError, match=f"{name}.*at least 0"):
            rb.wheeled.DCMotor(1.0, 0.1, **{name: -0.1})
    vehicle = rb.wheeled.at(kinds()["unicycle"].make(), "reduced")
    with pytest.raises(rb.InputError, match="rates: state is 3, expected a State"):
        rb.wheeled.rates(vehicle, 3, jnp.zeros(2))
