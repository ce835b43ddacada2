"""Terms of tasks: small functions of a `Transition`, for observations, rewards and terminations.

Files:
    frames.py: motion of a frame, actuator forces.
    velocities.py: tracking of velocity commands, undesired velocities.
    attitude.py: direction of gravity, tilt, a fallen robot.
    joints.py: pose, joint limits, standing still.
    effort.py: forces, power, changes of the action.
    touch.py: whether geoms touch.
    feet.py: contact, air time, slip and height of feet.
    loads.py: the forces of the floor on two feet.
    gait.py: a gait clock.
    commands.py: commands that change in time.
    pushes.py: pushes.
    randomisations.py: domain randomisation of robots.
    sigmoids.py: `tolerance`, values between 0 and 1 by the distance from an interval.
    products.py: rewards that are products or clipped sums of their terms.
    starts.py: random angles and poses at the start of an episode.
"""

from rbjax.envs.terms.attitude import axis_error, fallen, gravity_direction, tilt
from rbjax.envs.terms.commands import periodic_commands, switched_commands
from rbjax.envs.terms.effort import (
    absolute_forces,
    action_rate,
    force_norms,
    forces,
    joint_acceleration,
    power,
    squared_forces,
    terminated,
)
from rbjax.envs.terms.feet import Feet
from rbjax.envs.terms.frames import Term
from rbjax.envs.terms.gait import follow_phase, gait_clock, height_of_phase, phase_cosines
from rbjax.envs.terms.joints import (
    joint_deviation,
    joint_limit_violation,
    joint_offsets,
    joint_velocities,
    pose_error,
    pose_similarity,
    stand_still,
)
from rbjax.envs.terms.loads import excess_load, two_foot_loads
from rbjax.envs.terms.products import clipped_sum, product_of_rewards
from rbjax.envs.terms.pushes import force_pushes, velocity_pushes
from rbjax.envs.terms.randomisations import (
    joint_randomisations,
    mass_randomisations,
    set_friction,
    set_pair_friction,
    shift_center_of_mass,
)
from rbjax.envs.terms.sigmoids import tolerance
from rbjax.envs.terms.starts import planar_start, random_base
from rbjax.envs.terms.touch import any_touching, box_separation, touching
from rbjax.envs.terms.velocities import (
    roll_and_pitch_rate,
    track_velocity,
    track_yaw_rate,
    vertical_velocity,
)

__all__ = [
    "Feet",
    "Term",
    "absolute_forces",
    "action_rate",
    "any_touching",
    "axis_error",
    "box_separation",
    "clipped_sum",
    "excess_load",
    "fallen",
    "follow_phase",
    "force_norms",
    "force_pushes",
    "forces",
    "gait_clock",
    "gravity_direction",
    "height_of_phase",
    "joint_acceleration",
    "joint_deviation",
    "joint_limit_violation",
    "joint_offsets",
    "joint_randomisations",
    "joint_velocities",
    "mass_randomisations",
    "periodic_commands",
    "phase_cosines",
    "planar_start",
    "pose_error",
    "pose_similarity",
    "power",
    "product_of_rewards",
    "random_base",
    "roll_and_pitch_rate",
    "set_friction",
    "set_pair_friction",
    "shift_center_of_mass",
    "squared_forces",
    "stand_still",
    "switched_commands",
    "terminated",
    "tilt",
    "tolerance",
    "touching",
    "track_velocity",
    "track_yaw_rate",
    "two_foot_loads",
    "velocity_pushes",
    "vertical_velocity",
]

__dir__ = __all__.copy
