"""Forces between frames of a beam, goals at its frames, and links that it replaces."""

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.forces.context import Context
from rbjax.forces.reach import arms_between
from rbjax.kinematics.goals import errors
from rbjax.lanes import Vec3
from tests.flexible.beams import on_a_hinge, random_state, round_beam
from tests.tolerances import F64_TRANSFORM


def test_moment_arms_between_two_frames_of_one_beam() -> None:
    """The arms are the gradient of the distance; the hinge carries both ends and has none."""
    model = on_a_hinge()
    q = random_state(model).q

    def distance(q):
        p = rb.forward_kinematics(model, q).p
        return jnp.linalg.norm(p[model.body("rod")] - p[model.body("middle")])

    context = Context.of(model, 0.0, rb.State(q, jnp.zeros(model.nv)), None)
    tip, middle = context.body("rod"), context.body("middle")
    line = tip.position - middle.position
    arms = arms_between(context, tip, middle, line * (1 / line.norm()), Vec3.zero())
    want = jax.jit(jax.grad(distance))(q)
    assert sorted(arms) == [1, 2, 3, 4]
    got = np.array([arms[n] for n in range(1, 5)])
    np.testing.assert_allclose(got, want[1:], atol=F64_TRANSFORM)
    assert abs(want[0]) < F64_TRANSFORM


def test_arms_from_a_beam_to_its_base() -> None:
    """A force between the tip and the arm: the same arms as the Jacobian of the tip."""
    model = on_a_hinge()
    q = random_state(model, 1).q
    context = Context.of(model, 0.0, rb.State(q, jnp.zeros(model.nv)), None)
    tip, base = context.body("rod"), context.body("upper")
    arms = arms_between(context, tip, base, Vec3(0.3, -0.2, 0.5), Vec3.zero())
    J = rb.jacobian(model, q, "rod")[3:]
    assert 0 not in arms
    got = np.array([arms[n] for n in range(1, 5)])
    np.testing.assert_allclose(got, np.array([0.3, -0.2, 0.5]) @ J[:, 1:], atol=F64_TRANSFORM)


def test_the_jacobian_of_a_goal_at_the_tip() -> None:
    model = on_a_hinge()
    q = random_state(model, 2).q
    goal = rb.kinematics.Goal(body="rod", position=np.array([0.3, 0.1, -0.5]))
    _, J = errors(model, [goal], q)
    np.testing.assert_allclose(J, rb.jacobian(model, q, "rod")[3:], atol=F64_TRANSFORM)


def test_inverse_kinematics_reaches_a_pose_of_the_tip() -> None:
    model = on_a_hinge()
    q = 0.3 * random_state(model, 3).q
    target = rb.frame_pose(model, q, "rod")[1]
    goal = rb.kinematics.Goal(body="rod", position=target)
    found = rb.kinematics.inverse_kinematics(model, [goal], start=jnp.zeros(model.nq), seeds=1)
    np.testing.assert_allclose(rb.frame_pose(model, found.q, "rod")[1], target, atol=1e-6)


def test_a_beam_in_the_place_of_a_hinge() -> None:
    """The replaced joint and `with_beam` give the same equations, and the body keeps its mass."""
    text = """<mujoco><option gravity="0 0 -9.81"/><worldbody>
      <body name="tip" pos="0.1 0 0.2"><joint name="rod" axis="0 1 0"/>
        <inertial pos="0 0 0" mass="0.1" diaginertia="1e-3 1e-3 1e-3"/></body>
      </worldbody></mujoco>"""
    rod = round_beam()
    one = rod.replace_joint(rb.load(text), "rod")
    other = rb.load('<mujoco><option gravity="0 0 -9.81"/></mujoco>')
    other = other.with_beam("tip", rod, position=(0.1, 0.0, 0.2))
    bodies = other.bodies
    other = other.replace(
        bodies=bodies.replace(mass=bodies.mass.at[0].set(0.1), inertia=one.bodies.inertia)
    )
    q = random_state(one, 4).q
    for f in (rb.mass_matrix, rb.forces.elastic_energy):
        np.testing.assert_allclose(f(one, q), f(other, q), atol=F64_TRANSFORM)
