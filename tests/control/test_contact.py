"""Optimal control of robots on the floor, with the contact law of the model."""

import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb

HOPPER = """<mujoco><option timestep="0.01"/><worldbody>
  <geom type="plane" size="0 0 1" priority="1" solref="0.03 1" solimp="0.01 0.95 0.01"/>
  <body name="trunk" pos="0 0 0.5"><joint type="slide" axis="0 0 1"/>
    <geom size="0.05" mass="3" contype="0" conaffinity="0"/>
    <body><joint name="leg" type="slide" axis="0 0 -1" damping="1"/>
      <geom name="foot" type="sphere" pos="0 0 -0.47" size="0.03" mass="0.3"/></body></body>
  </worldbody><actuator><motor joint="leg" ctrlrange="-150 150"/></actuator></mujoco>"""


def test_a_hopper_jumps() -> None:
    """One leg, from rest on the floor to a trunk 0.3 m higher after 0.5 s, at the top of a flight
    with the leg drawn in. The plan is a motion of `rollout` with contacts."""
    model, steps = rb.load(HOPPER, contacts=True), 50
    goal = jnp.array([0.3, 0.0, 0.0])

    def miss(t, state, ctrl):
        return 10 * (jnp.array([*state.q, state.v[0]]) - goal)

    problem = rb.control.Problem(
        model, steps, 0.01, running=[rb.control.Cost(rb.control.Control(), 1e-3)],
        terminal=[rb.control.Cost(miss, 10.0)],
    )  # fmt: skip
    start = rb.State(jnp.array([-0.002, 0.0]), jnp.zeros(2))
    found = rb.control.solve(problem, start, ctrl=jnp.full((steps, 1), 32.0), iterations=100)
    assert found.success, found.summary()
    assert abs(float(found.states.q[-1, 0]) - 0.3) < 0.02
    foot = np.asarray(found.states.q[:, 0] - found.states.q[:, 1])
    assert foot[-1] > 0.25 and foot.min() > -0.03  # the foot has left the floor, and stayed above
    path = rb.rollout(model, start, found.ctrl, 0.01)
    np.testing.assert_allclose(path.q, found.states.q, atol=1e-3)


PUSHER = """<mujoco><option timestep="0.01" cone="elliptic"/>
  <default><geom friction="0.4" solref="0.03 1" solimp="0.0001 0.95 0.01 0.5 2"/></default>
  <worldbody><geom type="plane" size="0 0 1"/>
  <body name="box" pos="0.2 0 0.05"><freejoint/>
    <geom type="box" size="0.05 0.1 0.05" mass="0.5"/></body>
  <body name="pusher" pos="0.118 0 0.05"><joint name="x" type="slide" axis="1 0 0" damping="5"/>
    <joint name="y" type="slide" axis="0 1 0" damping="5"/>
    <geom type="sphere" size="0.03" mass="0.3"/></body></worldbody>
  <contact><exclude body1="world" body2="pusher"/></contact><actuator>
    <motor joint="x" ctrlrange="-20 20"/><motor joint="y" ctrlrange="-20 20"/></actuator>
  </mujoco>"""


def test_a_ball_pushes_a_box_to_a_pose() -> None:
    """A box on the floor goes 25 cm ahead, 5 cm to the left and turns by 0.4 rad, and rests there.

    The ball starts 2 mm away from the box. The guess pushes it; with no force there is no contact,
    and the derivative of the box by the controls is zero. MuJoCo moves the box in the same way.
    """
    model, steps, turn = rb.load(PUSHER), 80, 0.4

    def miss(t, state, ctrl):
        x, y, half = state.q[0], state.q[1], state.q[6]
        return jnp.stack([x - 0.45, y - 0.05, 2 * (half - np.sin(turn / 2)), *(0.1 * state.v)])

    def apart(t, state, ctrl):
        """The place of the ball in the axes of the box, from one behind the box."""
        (x, y), (w, z), (bx, by) = state.q[:2], (state.q[3], state.q[6]), state.q[7:]
        c, s, dx, dy = 1 - 2 * z**2, 2 * w * z, bx + 0.118 - x, by - y
        return jnp.stack([c * dx + s * dy + 0.08, c * dy - s * dx + 0.02])

    problem = rb.control.Problem(
        model, steps, 0.01,
        running=[rb.control.Cost(rb.control.Control(), 1e-2), rb.control.Cost(apart, 30.0)],
        terminal=[rb.control.Cost(miss, 100.0)],
    )  # fmt: skip
    start = model.default_state()
    found = rb.control.solve(problem, start, ctrl=jnp.tile(jnp.array([2.0, 0.0]), (steps, 1)))
    assert found.success, found.summary()
    path = rb.rollout(model, start, found.ctrl, 0.01)
    np.testing.assert_allclose(path.q, found.states.q, atol=1e-9)
    q = np.asarray(path.q[-1])
    np.testing.assert_allclose(q[:2], [0.45, 0.05], atol=0.01)
    assert abs(2 * np.arcsin(q[6]) - turn) < 0.01
    assert abs(path.v[-1]).max() < 0.01
    m = mujoco.MjModel.from_xml_string(PUSHER)
    m.opt.tolerance, data = 0, mujoco.MjData(m)
    for u in np.asarray(found.ctrl):
        data.ctrl[:] = u
        mujoco.mj_step(m, data)
    np.testing.assert_allclose(data.qpos, q, atol=1e-9)


TWO_BALLS = """<mujoco><option timestep="0.01" gravity="0 0 0"/>
  <default><geom size="0.05" mass="1"/></default><worldbody>
  <body><joint name="x" type="slide" axis="1 0 0" damping="2"/><geom/></body>
  <body pos="0.12 0 0"><joint type="slide" axis="1 0 0" damping="2"/><geom/></body></worldbody>
  <actuator><motor joint="x"/></actuator></mujoco>"""


def test_a_contact_that_is_never_made_is_named_and_a_guess_makes_it() -> None:
    """One ball pushes another. Without a guess the balls stay apart, and the summary says why. The
    guess pushes too far, which costs more than no motion, and is used."""
    model, steps = rb.load(TWO_BALLS), 40

    def miss(t, state, ctrl):
        return jnp.stack([state.q[1] - 0.1, 0.1 * state.v[1]])

    problem = rb.control.Problem(
        model, steps, running=[rb.control.Cost(rb.control.Control(), 1e-3)],
        terminal=[rb.control.Cost(miss, 100.0)],
    )  # fmt: skip
    start = model.default_state()
    still = rb.control.solve(problem, start)
    assert still.success and not still.ctrl.any()
    assert "no derivative by a contact" in still.summary()
    found = rb.control.solve(problem, start, ctrl=jnp.full((steps, 1), 12.0))
    assert rb.rollout(model, start, jnp.full((steps, 1), 12.0)).q[-1, 1] > 0.2
    assert abs(float(found.states.q[-1, 1]) - 0.1) < 0.01, found.summary()
    assert "no derivative" not in found.summary()


THIGH = 0.22


def quadruped_in_the_plane() -> rb.ModelBuilder:
    """A trunk that moves in the plane of x and z, with a front and a hind pair of legs."""
    builder, silent = rb.ModelBuilder(timestep=0.01), {"contype": 0, "conaffinity": 0}
    builder.add_geom("floor", None, "plane", (0, 0, 1), contype=0, conaffinity=1)
    builder.add_body("trunk")
    builder.add_joint("x", "trunk", "slide", axis=(1, 0, 0))
    builder.add_joint("z", "trunk", "slide", axis=(0, 0, 1))
    builder.add_joint("pitch", "trunk", axis=(0, 1, 0))
    builder.add_geom("trunk", "trunk", "box", (0.26, 0.1, 0.06), mass=9.0, **silent)
    for pair, x in (("front", 0.25), ("hind", -0.25)):
        thigh, shank, down = f"{pair} thigh", f"{pair} shank", (0, 0, -THIGH)
        for part, parent, place, mass in ((thigh, "trunk", (x, 0, 0), 2), (shank, thigh, down, 1)):
            builder.add_body(part, parent, position=place)
            builder.add_joint(part, part, axis=(0, 1, 0), damping=0.4, armature=0.02)
            size, middle = (0.02, THIGH / 2), (0, 0, -THIGH / 2)
            builder.add_geom(part, part, "capsule", size, position=middle, mass=mass, **silent)
            builder.add_motor(part, part, ctrlrange=(-80, 80))
        builder.add_geom(
            f"{pair} feet", shank, "sphere", 0.025, position=down, mass=0.2, conaffinity=0
        )
    return builder


def posture(bend: float) -> np.ndarray:
    """Feet below the hips, 1 mm deep in the floor."""
    return np.array([0, 2 * THIGH * np.cos(bend) + 0.024, 0, *[bend, -2 * bend] * 2])


def test_a_quadruped_stands_up() -> None:
    """From a crouch to a stance in half a second, in the plane, from no guess. MuJoCo moves the
    robot in the same way under these torques."""
    builder = quadruped_in_the_plane()
    model, steps = builder.build(), 50
    start, still = rb.State(jnp.asarray(posture(1.2)), jnp.zeros(7)), jnp.zeros(7)
    goal = rb.control.StateError(rb.State(jnp.asarray(posture(0.6)), still))
    problem = rb.control.Problem(
        model, steps, running=[rb.control.Cost(rb.control.Control(), 1e-3)],
        terminal=[rb.control.Cost(goal, 1000.0)],
    )  # fmt: skip
    found = rb.control.solve(problem, start)
    path = rb.rollout(model, start, found.ctrl)
    np.testing.assert_allclose(path.q, found.states.q, atol=1e-6)
    np.testing.assert_allclose(path.q[-1], posture(0.6), atol=0.02)
    assert abs(path.v[-1]).max() < 0.1
    m = builder.spec.compile()
    m.opt.tolerance, data = 0, mujoco.MjData(m)
    data.qpos[:] = start.q
    for u in np.asarray(found.ctrl):
        data.ctrl[:] = u
        mujoco.mj_step(m, data)
    np.testing.assert_allclose(data.qpos, path.q[-1], atol=1e-6)


def quadruped() -> rb.ModelBuilder:
    """A free trunk with four legs of three joints. The impedance of the floor grows from zero with
    depth, so that contact forces are smooth."""
    builder, silent = rb.ModelBuilder(timestep=0.01), {"contype": 0, "conaffinity": 0}
    builder.add_geom(
        "floor", None, "plane", (0, 0, 1), contype=0, conaffinity=1, priority=1, solref=(0.03, 1),
        solimp=(0.0001, 0.95, 0.01, 0.5, 2),
    )  # fmt: skip
    builder.add_body("trunk")
    builder.add_joint("root", "trunk", "free")
    builder.add_geom("trunk", "trunk", "box", (0.26, 0.1, 0.06), mass=9.0, **silent)
    middle, down = (0, 0, -THIGH / 2), (0, 0, -THIGH)
    for leg, x, y in (("a", 0.25, 0.1), ("b", 0.25, -0.1), ("c", -0.25, 0.1), ("d", -0.25, -0.1)):
        hip, thigh, shank = (f"{leg} {part}" for part in ("hip", "thigh", "shank"))
        for part, parent, place, axis in (
            (hip, "trunk", (x, y, 0), (1, 0, 0)), (thigh, hip, (0, 0, 0), (0, 1, 0)),
            (shank, thigh, down, (0, 1, 0)),
        ):  # fmt: skip
            builder.add_body(part, parent, position=place)
            builder.add_joint(part, part, axis=axis, damping=0.4, armature=0.02)
            builder.add_motor(part, part, ctrlrange=(-80, 80))
        builder.add_geom(hip, hip, "sphere", 0.04, mass=0.5, **silent)
        for part, mass in ((thigh, 1.0), (shank, 0.3)):
            builder.add_geom(
                part, part, "capsule", (0.02, THIGH / 2), position=middle, mass=mass, **silent
            )
        builder.add_geom(
            f"{leg} foot", shank, "sphere", 0.025, position=down, mass=0.1, conaffinity=0
        )
    return builder


def test_a_quadruped_with_a_free_trunk_stands_up() -> None:
    """18 degrees of freedom, from a crouch to a stance in half a second, from no guess."""
    builder = quadruped()
    model, steps = builder.build(), 50

    def pose(bend: float) -> np.ndarray:
        height = 2 * THIGH * np.cos(bend) + 0.022
        return np.array([0, 0, height, 1, 0, 0, 0, *[0, bend, -2 * bend] * 4])

    start = rb.State(jnp.asarray(pose(1.2)), jnp.zeros(18))
    goal = rb.control.StateError(rb.State(jnp.asarray(pose(0.6)), jnp.zeros(18)))
    problem = rb.control.Problem(
        model, steps, running=[rb.control.Cost(rb.control.Control(), 1e-3)],
        terminal=[rb.control.Cost(goal, 1000.0)],
    )  # fmt: skip
    found = rb.control.solve(problem, start, iterations=100)
    assert found.success, found.summary()
    path = rb.rollout(model, start, found.ctrl)
    np.testing.assert_allclose(path.q, found.states.q, atol=1e-9)
    np.testing.assert_allclose(path.q[-1], pose(0.6), atol=2e-3)
    assert abs(path.v[-1]).max() < 1e-3
    m = builder.spec.compile()
    m.opt.tolerance, data = 0, mujoco.MjData(m)
    data.qpos[:] = start.q
    for u in np.asarray(found.ctrl):
        data.ctrl[:] = u
        mujoco.mj_step(m, data)
    np.testing.assert_allclose(data.qpos, path.q[-1], atol=1e-9)
