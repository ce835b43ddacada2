"""Reference motions of wheeled robots, by independent equations and integrators.

Differential drive: (m + 2 Iw/r^2) v' - mc d w^2 = (tR + tL)/r, (I + 2 Iw b^2/r^2) w' + mc d v w =
b (tR - tL)/r (Dhaouadi & Abu Hatab 2013). Omnidirectional robot with three wheels: (m + mu) vx' -
m w vy = Fx, and so on, mu = 3 Iw/(2 r^2). Chaplygin's sleigh: its closed form. Mecanum: *Modern
Robotics*, 13.2, and its capstone project.
"""

DIFFERENTIAL = {
    "numbers": {
        "mc": 10.0, "mw": 0.5, "Ic": 0.4, "Im": 0.002, "Iw": 0.004, "b": 0.2, "r": 0.08, "d": 0.07},
    # torques (right, left), (v, w) at 0; x, y, heading, right and left wheel, v, w at 5 s
    "cases": {
        "spin up": ((0.3, 0.1), (0.0, 0.0), (
            -2.748153083877527, 2.8993047026398435, 3.1411703457221374, 76.05276716556203,
            60.34691543695074, 2.1689946849016213, 0.36020656893291475)),
        "coast": ((0.0, 0.0), (0.8, 1.5), (
            1.6581853737865466, 3.6946515347369075, 1.379790869468678, 56.85966318550712,
            49.96070883816402, 0.8600773542777393, 0.006079895908727137)),
    },
}  # fmt: skip

OMNI = {
    "numbers": {"m": 6.0, "Iz": 0.2, "Iw": 0.003, "r": 0.05, "l": 0.18},
    # torques, (vx, vy, w) at 0; pose and twist at 5 s
    "cases": {
        "coast": ((0.0, 0.0, 0.0), (1.0, 0.0, 2.0), (
            1.6045423341601053, 3.6226503006169963, 10.0, 0.16097054351560716, -0.9869592109708898,
            2.0)),
        "torque": ((0.05, -0.02, 0.03), (0.0, 0.0, 0.0), (
            -0.48637481398424465, 0.7252649076677062, 8.527033855482564, 0.11068776528514605,
            0.22315141102957708, 3.410813542193026)),
    },
}  # fmt: skip

#: m, inertia about the centre of mass, its distance ahead of the blade; v and w at 0; at 5 s v, w,
#: heading, place of the blade
SLEIGH = (
    (1.0, 0.5, 0.3), (1.0, 0.8),
    (1.1732320511504923, 0.043696839920036736, 1.3375602594318177, 2.710458296673592,
     4.441478693707546),
)  # fmt: skip

#: length / 2, track / 2, radius; wheel speeds -> x, y, heading after a second
MECANUM = (
    (0.235, 0.15, 0.0475),
    {
        (10.0, 10.0, 10.0, 10.0): (0.475, 0.0, 0.0),
        (-10.0, 10.0, -10.0, 10.0): (0.0, 0.475, 0.0),
        (-10.0, 10.0, 10.0, -10.0): (0.0, 0.0, 1.2337662337662338),
    },
)
