"""Crocoddyl's own examples, solved on request; run by an interpreter that has it, not by ours.

Each line of the input is a problem and a number of runs; each line of the output the best run.
With "costs" for the number, it is the costs of all iterations until the optimum stays the same.
"""

import json
import sys
import time

import crocoddyl
import example_robot_data
import numpy as np
import pinocchio


def arm():
    robot = example_robot_data.load("kinova")
    model = robot.model
    state = crocoddyl.StateMultibody(model)
    x0 = np.concatenate([model.referenceConfigurations["arm_up"], np.zeros(model.nv)])
    frame = model.getFrameId("j2s6s200_end_effector")
    goal = pinocchio.SE3(np.eye(3), np.array([0.6, 0.2, 0.5]))
    pose = crocoddyl.CostModelResidual(
        state, crocoddyl.ResidualModelFramePlacement(state, frame, goal)
    )
    near = crocoddyl.CostModelResidual(state, crocoddyl.ResidualModelState(state, x0))
    effort = crocoddyl.CostModelResidual(state, crocoddyl.ResidualModelControl(state))
    running, terminal = crocoddyl.CostModelSum(state), crocoddyl.CostModelSum(state)
    running.addCost("pose", pose, 1)
    running.addCost("near", near, 0.1)
    running.addCost("effort", effort, 0.1)
    terminal.addCost("pose", pose, 1e3)
    forces = crocoddyl.ActuationModelFull(state)
    return crocoddyl.ShootingProblem(x0, *steps(state, forces, running, terminal, 1e-2, 100))


def quadrotor():
    robot = example_robot_data.load("hector")
    model = robot.model
    state = crocoddyl.StateMultibody(model)
    d, cf, cm = 0.1525, 6.6e-5, 1e-6
    places = [
        pinocchio.SE3(np.eye(3), np.array(p))
        for p in ([d, 0, 0], [0, d, 0], [-d, 0, 0], [0, -d, 0])
    ]
    kinds = [crocoddyl.ThrusterType.CCW, crocoddyl.ThrusterType.CW] * 2
    rotors = [crocoddyl.Thruster(p, cm / cf, k) for p, k in zip(places, kinds, strict=False)]
    forces = crocoddyl.ActuationModelFloatingBaseThrusters(state, rotors)
    goal = pinocchio.SE3(np.eye(3), np.array([1.0, 0.0, 1.0]))
    frame = model.getFrameId("base_link")
    nu = forces.nu
    pose = crocoddyl.CostModelResidual(
        state, crocoddyl.ResidualModelFramePlacement(state, frame, goal, nu)
    )
    w = crocoddyl.ActivationModelWeightedQuad(
        np.array([0.1] * 3 + [1000.0] * 3 + [1000.0] * model.nv)
    )
    near = crocoddyl.CostModelResidual(
        state, w, crocoddyl.ResidualModelState(state, state.zero(), nu)
    )
    effort = crocoddyl.CostModelResidual(state, crocoddyl.ResidualModelControl(state, nu))
    running, terminal = crocoddyl.CostModelSum(state, nu), crocoddyl.CostModelSum(state, nu)
    running.addCost("near", near, 1e-6)
    running.addCost("effort", effort, 1e-6)
    running.addCost("pose", pose, 1e-2)
    terminal.addCost("pose", pose, 3.0)
    x0 = np.concatenate([robot.q0, np.zeros(model.nv)])
    return crocoddyl.ShootingProblem(x0, *steps(state, forces, running, terminal, 3e-2, 33))


def steps(state, forces, running, terminal, dt, count):
    make = crocoddyl.DifferentialActionModelFreeFwdDynamics
    step = crocoddyl.IntegratedActionModelEuler(make(state, forces, running), dt)
    last = crocoddyl.IntegratedActionModelEuler(make(state, forces, terminal), 0.0)
    return [step] * count, last


def bounded_quadrotor():
    problem = quadrotor()
    for model in problem.runningModels:
        model.u_lb, model.u_ub = np.full(4, 0.1), np.full(4, 5.0)
    return problem


made = {"arm": arm, "quadrotor": quadrotor, "bounded quadrotor": bounded_quadrotor}
problems = {}
for line in sys.stdin:
    name, runs = line.rsplit(maxsplit=1)
    if name not in problems:
        problems[name] = made[name]()
    if runs == "costs":
        solver = (crocoddyl.SolverBoxFDDP if "bounded" in name else crocoddyl.SolverFDDP)(
            problems[name]
        )
        logger = crocoddyl.CallbackLogger()
        solver.th_stop = 1e-20
        solver.setCallbacks([logger])
        solver.solve([], [], 1000)
        print(json.dumps(list(logger.costs)), flush=True)
        continue
    best = 1e9
    for _ in range(int(runs)):
        solver = crocoddyl.SolverFDDP(problems[name])
        start = time.process_time()
        solver.solve([], [], 200)
        best = min(best, (time.process_time() - start) / solver.iter)
    print(
        json.dumps({"ms": best * 1e3, "iterations": solver.iter, "cost": solver.cost}), flush=True
    )
