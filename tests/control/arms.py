"""Robots of these tests; this file is no test."""

import numpy as np

import rbjax as rb
from tests.robots import load_quietly

#: of `arm7`, whose file states these ranges and does not switch them on
RANGES = np.array([[-2.8, 2.8], [-1.8, 1.8], [-2.8, 2.8], [-0.1, 3.0], [-2.8, 2.8], [0.0, 3.7],
                   [-2.8, 2.8]])  # fmt: skip


def arm7() -> rb.Model:
    """The arm of seven joints within its ranges."""
    arm = load_quietly("arm7")
    return arm.replace(joints=arm.joints.replace(range=RANGES))


#: four hinges, of which three move the tip's position in a redundant way; springs, dampers,
#: armature; motors with gears, and a servo
ARM = """
<mujoco><compiler angle="radian"/><option timestep="0.0005"/>
<default><geom density="800"/></default>
<worldbody>
<body name="turret" pos="0 0 0.2"><joint name="turn" axis="0 0 1" damping="0.3"/>
<geom type="capsule" fromto="0 0 0 0 0 0.2" size="0.05"/>
<body name="upper" pos="0 0 0.2"><joint name="shoulder" axis="0 1 0" armature="0.02" stiffness="3"/>
<geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.04"/>
<body name="lower" pos="0.4 0 0"><joint name="elbow" axis="0 1 0" damping="0.2"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/>
<body name="hand" pos="0.3 0 0"><joint name="wrist" axis="0 1 0" armature="0.02"/>
<geom type="capsule" fromto="0 0 0 0.1 0.02 0" size="0.02"/><site name="tip" pos="0.1 0.02 0"/>
</body></body></body></body></worldbody>
<actuator><motor joint="turn" gear="20"/><motor joint="elbow" gear="-7"/>
<position name="servo" joint="shoulder" kp="50" kv="2"/><motor joint="wrist" gear="3"/></actuator>
</mujoco>
"""

#: a pendulum on a ball joint with a hinge at its end, in no need of actuators
BALL = """
<mujoco><compiler angle="radian"/><worldbody><body name="swing"><joint name="ball" type="ball"/>
<geom type="box" size="0.05 0.1 0.2" pos="0.02 0 -0.2"/>
<body name="end" pos="0 0 -0.4"><joint name="hinge" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0.2 0.1 0" size="0.03"/></body></body></worldbody></mujoco>
"""

#: a floating trunk with a leg and an arm, whose joints have motors
FLOATING = """
<mujoco><compiler angle="radian"/><worldbody><body name="trunk"><freejoint name="base"/>
<geom size="0.2"/>
<body name="leg" pos="0 0 -0.2"><joint name="hip" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0.1 0 -0.4" size="0.05"/></body>
<body name="arm" pos="0.2 0 0.1"><joint name="reach" type="slide" axis="1 0 0.2"/>
<geom size="0.1"/></body></body></worldbody>
<actuator><motor joint="hip"/><motor joint="reach" gear="5"/></actuator></mujoco>
"""
