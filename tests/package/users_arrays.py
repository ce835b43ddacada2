"""A user's script with NumPy arrays and lists as arguments: mypy checks it, and it runs."""

from typing import assert_type

import jax
import numpy as np

import rbjax as rb
from rbjax import body, constraints, planning, rotations, spatial
from rbjax.rotations import quaternion, se3, so3
from rbjax.sysid import parameters, torque


def motion() -> None:
    model = rb.load("two_link")
    q, v, zero = np.array([0.3, -0.2]), np.array([1.0, 0.5]), [0.0, 0.0]
    state = rb.State(q, v)
    ctrls, wrenches = np.zeros((20, model.nu)), np.zeros((model.nb, 6))
    run = rb.rollout(model, state, ctrls, 0.01, wrenches=wrenches)
    assert_type(run.q, jax.Array)
    assert_type(rb.step(model, state, np.zeros(model.nu), 0.01, tau=zero), rb.State)
    assert_type(rb.acceleration(model, state, ctrls[0], tau=zero), jax.Array)
    assert_type(rb.simulate(model, state, np.linspace(0.0, 0.1, 3)), rb.Trajectory)
    assert_type(rb.linearise(model, state, ctrls[0]), rb.Linear)
    assert_type(rb.stability.state_matrix(model, state, ctrls[0]), jax.Array)
    rb.sense(model, state, ctrls[0])
    robot = rb.load("humanoid")
    start = robot.default_state()
    rb.contact.solve(robot, start, np.zeros(robot.nu), tau=np.zeros(robot.nv))


def dynamics() -> None:
    model = rb.load("two_link")
    q, v, a = np.array([0.3, -0.2]), [1.0, 0.5], np.zeros(2)
    state, wrenches, tip = rb.State(q, v), np.zeros((model.nb, 6)), model.body_names[-1]
    assert_type(rb.forward_dynamics(model, q, v, a, wrenches), jax.Array)
    assert_type(rb.inverse_dynamics(model, q, v, a, wrenches), jax.Array)
    assert_type(rb.mass_matrix(model, q), jax.Array)
    assert_type(rb.inverse_mass_matrix(model, [0.3, -0.2]), jax.Array)
    assert_type(rb.bias_forces(model, q, v), jax.Array)
    assert_type(rb.gravity_forces(model, q), jax.Array)
    assert_type(rb.coriolis_matrix(model, q, v), jax.Array)
    rb.lagrange_coefficients(model, q)
    assert_type(rb.inertial_regressor(model, q, v, a), jax.Array)
    rb.forward_dynamics_derivatives(model, q, v, a)
    rb.inverse_dynamics_derivatives(model, q, v, a)
    assert_type(rb.forward_kinematics(model, q), rb.Poses)
    rb.body_velocities(model, q, v)
    rb.frame_pose(model, q, tip, [0.0, 0.0, 0.1])
    assert_type(rb.frame_velocity(model, q, v, tip, np.zeros(3)), jax.Array)
    assert_type(rb.frame_bias_acceleration(model, q, v, tip), jax.Array)
    assert_type(rb.jacobian(model, q, tip, [0.0, 0.0, 0.1]), jax.Array)
    assert_type(rb.jacobian_rate(model, q, v, tip), jax.Array)
    assert_type(rb.dynamics.generalized_forces(model, q, wrenches), jax.Array)
    assert_type(rb.integrate(model, q, v), jax.Array)
    assert_type(rb.difference(model, q, [0.0, 0.0]), jax.Array)
    assert_type(rb.kinetic_energy(model, q, v), jax.Array)
    assert_type(rb.potential_energy(model, q), jax.Array)
    assert_type(rb.center_of_mass(model, q), jax.Array)
    assert_type(rb.centroidal_momentum(model, q, v), jax.Array)
    assert_type(rb.tendon_lengths(model, q), jax.Array)
    assert_type(rb.tendon_jacobian(model, q), jax.Array)
    assert_type(rb.applied_forces(model, state, np.zeros(model.nu)), jax.Array)
    assert_type(rb.forces.elastic_energy(model, q), jax.Array)
    constraints.constrained_dynamics(model, q, v, a)
    assert_type(constraints.jacobian(model, q), jax.Array)
    constraints.mobility(model, q)
    constraints.multipliers(model, state, np.zeros(model.nu))
    constraints.joint_wrenches(model, state, np.zeros(model.nu))
    rb.control.allocate(model, state, a)
    torque.regressor(model, q, v, a)
    torque.regressor(model, q[None], [v], a[None])


def geometry() -> None:
    x, twist, R = np.array([0.1, 0.2, 0.3]), [0.0, 0.0, 1.0, 0.0, 0.5, 0.0], np.eye(3)
    unit, inertia = [1.0, 0.0, 0.0, 0.0], np.diag([1.0, 1.2, 0.9])
    assert_type(so3.exp(x), jax.Array)
    so3.log(R), so3.hat(x), so3.vee(np.zeros((3, 3))), so3.compose(R, R), so3.inverse(R)
    so3.distance(R, R), so3.interpolate(R, R, 0.5), so3.project(R), so3.projection_margin(R)
    T = np.asarray(se3.exp(twist))
    se3.log(T), se3.pose(R, x), se3.compose(T, T), se3.inverse(T), se3.adjoint(T), se3.ad(twist)
    quaternion.multiply(unit, unit), quaternion.rotate(unit, x), quaternion.to_matrix(unit)
    quaternion.from_matrix(R), quaternion.exp(x), quaternion.log(unit), quaternion.angle(unit)
    rotations.convert(x, "euler_vector", "unit_quaternion")
    rotations.representations()["euler_vector"].to_matrix(x)
    rotations.mrp_short(x), rotations.mrp_shadow(x)
    M = np.asarray(spatial.spatial_inertia(2.0, x, inertia))
    spatial.mass_properties(M), spatial.momentum(M, twist), spatial.kinetic_energy(M, twist)
    spatial.parallel_axes(inertia, 2.0, x), spatial.rotate_inertia(R, inertia)
    spatial.principal_axes(inertia), spatial.transform_inertia(T, M)
    spatial.transform_motion(T, twist), spatial.transform_force(T, twist)
    spatial.motion_transform(T), spatial.force_transform(T), spatial.motion_cross(twist, twist)
    spatial.twist_at(twist, x), spatial.wrench_at(twist, x), spatial.force_at(x, [0.0, 0.0, 1.0])
    spatial.power(twist, twist), spatial.central_axis(twist)
    P = np.asarray(spatial.pseudo_inertia(2.0, 0.1 * x, inertia))
    spatial.from_pseudo_inertia(P), spatial.consistency(2.0, inertia)
    spatial.check_mass_properties(2.0, x, inertia)
    theta = np.asarray(parameters.to_log_cholesky(P))
    parameters.from_log_cholesky(theta)
    parameters.log_determinant_divergence(P, P)
    parameters.nearest_pseudo_inertia(P), parameters.inertial_parameters_of(P)
    body.ellipsoid_added_mass([1.0, 1.1, 1.2], 1000.0)
    grid = planning.OccupancyGrid(np.zeros((40, 30), bool), 0.1, [0.0, 0.0])
    grid.cell(np.array([2.0, 0.3])), grid.center([20, 3])
    grid.distance_field().at([1.5, 0.9])
    planning.dubins([0.0, 0.0, 0.0], np.array([1.0, 1.0, 0.0]), 0.4)
