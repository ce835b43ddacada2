"""The planar robots of the tasks, and states in which they touch the floor."""

import numpy as np

from tests.envs.suite.mujoco_states import motion, mujoco_model

HOPPER, WALKER, RUNNING = (mujoco_model(name) for name in ("hopper", "walker", "running_hopper"))
#: task -> its robot
ROBOTS = {"hopper_hop": HOPPER, "walker_walk": WALKER, "hopper_run": RUNNING}
BENT, FIRM = (0.1, 0.2, -0.3, 0.1, 0.3, -0.2, -0.1), np.full(6, 0.1)
#: task -> states (q, v, ctrl)
STATES = {
    # motions from random angles, on the floor and folded
    "hopper_hop": [
        *motion(HOPPER, 60, 10, 0, [0, -0.2, 0.3, 0.1, -0.5, 0.8, 0.1]),
        *motion(HOPPER, 60, 10, 1, [0, -0.4, 2.5, 0, -2.5, 2.3, 0.5]),
    ],
    # a fall from a bent pose, lying on the floor, and a run
    "walker_walk": [
        *motion(WALKER, 80, 10, 0, [0.1, 0, 0.2, 0.5, -0.4, 0.1, -0.1, -0.9, 0.3]),
        *motion(WALKER, 80, 10, 1, [-0.8, 0, 1.4, 0.3, -0.1, 0, 0.9, -1.5, -0.4]),
        *((np.array([z, 0, *BENT]), np.eye(9)[1] * s, FIRM) for z, s in ((0.02, 0.4), (0.2, 5.0))),
    ],
    # a fall with random controls, lying on the floor, and a leap
    "hopper_run": [
        *motion(RUNNING, 40, 12, 0),
        *motion(RUNNING, 40, 10, 1, [0, -0.8, 0.6, -1.0, -0.5, 0.2]),
        (np.array([0.2, 0.4, -0.1, -0.5, -0.8, 0.3]), np.eye(6)[0] * 2, np.full(3, 0.5)),
    ],
}  # fmt: skip
