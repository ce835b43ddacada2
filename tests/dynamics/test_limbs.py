"""The driver by limbs: which limbs are isomorphic, and the same results as the other drivers."""

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.compiler.ir.program import batch_first
from rbjax.compiler.lower.write import write_program
from rbjax.dynamics.algorithms.aba import factorize
from rbjax.dynamics.drivers.choice import driver
from rbjax.dynamics.drivers.limbs import Limbs
from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.lanes import fusion_barrier
from rbjax.model import WORLD, partition
from tests.compiler.host import COMPILER, on_host, written
from tests.robots import Robot, load_quietly, robot
from tests.tolerances import F64_PARITY, relative_error

G1 = "frax/unitree_g1/g1_29dof_rev_1_0.urdf+free"


def _limb(name: str, side: int, ball: bool) -> str:
    """A limb of three or five links, mirrored by `side` = 1 or -1; no two have the same numbers."""
    mass = 1.3 + 0.2 * side
    first = (
        f'<joint type="ball" pos="0 {0.02 * side} 0" damping="0.1"/>'
        if ball
        else f'<joint axis="1 {0.2 * side} 0" ref="{0.1 + 0.05 * side}" armature="0.02"/>'
    )
    inertial = f'fullinertia="0.03 0.02 0.025 {0.001 * side} 0.002 {-0.001 * side}"'
    return f"""
    <body name="{name}{side}" pos="0.1 {0.2 * side} 0.1" quat="1 {0.2 * side} 0 0">
      {first}<inertial pos="0 0.01 -0.1" mass="{mass}" {inertial}/>
      <body pos="0 0 -0.4"><joint axis="0 1 0" stiffness="3" springref="0.2"/>
        <inertial pos="0.02 {0.01 * side} -0.1" mass="0.7" diaginertia="0.01 0.012 0.002"/>
        <body pos="0 {0.01 * side} -0.3"><joint type="slide" axis="0 0 1" armature="0.1"/>
          <inertial pos="0 0 -0.05" mass="0.3" diaginertia="0.001 0.002 0.001"/></body>
      </body>
    </body>"""


WALKER = f"""
<mujoco><compiler angle="radian"/><option gravity="0.3 -0.2 -9.8"/><worldbody>
  <body name="base" pos="0 0 1"><freejoint/>
    <inertial pos="0.01 0 0.02" mass="6" fullinertia="0.2 0.25 0.3 0.01 0.02 -0.01"/>
    {_limb("leg", 1, True)}{_limb("leg", -1, True)}
    <body name="torso" pos="0 0 0.3"><joint axis="0 0 1"/>
      <inertial pos="0 0.01 0.2" mass="4" diaginertia="0.1 0.1 0.05"/>
      {_limb("arm", 1, False)}
      <body name="head" pos="0 0 0.4"><joint axis="0 1 0"/>
        <inertial pos="0 0 0.1" mass="1" diaginertia="0.01 0.01 0.01"/></body>
      <body name="pack" pos="-0.1 0 0.1"><joint axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
        <inertial pos="0 0 0.1" mass="1" diaginertia="0.01 0.02 0.01"/>{_limb("arm", -1, False)}
        <body pos="0 0 0.2"><joint axis="0 1 1"/>
          <inertial pos="0.1 0 0" mass="0.2" diaginertia="0.01 0.01 0.01"/></body></body>
    </body>
  </body>
  {_limb("post", 1, False).replace("post1", "post")}
  <body name="stool" pos="2 0 0"><joint type="slide" axis="1 0 0"/>
    <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/></body>
</worldbody>
</mujoco>"""
"""Legs with balls on the base; alike arms on two links of the trunk and on the world."""


def _arm(side: int) -> str:
    return f"""
    <body pos="0.1 {0.2 * side} 0" quat="1 {0.2 * side} 0 0">
      <joint type="ball" pos="0 0 {0.02 * side}"/>
      <inertial pos="0 0.1 0" mass="{2 + side}" fullinertia="0.03 0.02 0.025 {0.001 * side} 0 0"/>
      <body pos="0 {0.4 * side} 0"><joint axis="1 0 {0.1 * side}" ref="{0.2 + 0.1 * side}"/>
        <inertial pos="0.1 0 0" mass="0.7" diaginertia="0.01 0.012 0.002"/>
        <site name="hand{side}" pos="0.05 0 0"/></body></body>"""


CART = f"""
<mujoco><compiler angle="radian"/><worldbody><body><joint type="slide" axis="1 0 0"/>
  <inertial pos="0 0 0" mass="3" diaginertia="1 1 1"/>{_arm(1)}
  <body pos="0 0 1"><joint axis="0 1 0"/>
    <inertial pos="0 0 1" mass="2" diaginertia="0.1 0.2 0.1"/>{_arm(-1)}
    <body pos="0 0 2"><joint axis="1 0 1"/>
      <inertial pos="0 0.1 0" mass="0.5" diaginertia="0.02 0.01 0.02"/></body></body>
</body></worldbody>
<actuator><motor site="hand1" gear="1 0.5 2 0.1 0.3 -0.2"/></actuator></mujoco>"""
"""Two arms of ball and hinge on two links, small. Both links branch, so that the arms are limbs."""


def walker(driver: str = "limbs", text: str = WALKER) -> Robot:
    reference = mujoco.MjModel.from_xml_string(text)
    return Robot(load_quietly(reference).replace(driver=driver), reference)


# ------------------------------------------------------------------- the partition


def sizes(model: rb.Model) -> tuple[int, list[tuple[int, int]]]:
    """Links of the trunk; limbs and links of a limb of each group."""
    trunk, groups = partition(model.topology)
    return len(trunk), [(len(group.links), len(group.parents)) for group in groups]


def quadruped() -> rb.Model:
    leg = '<body pos="{} {} 0"><joint axis="1 0 0"/>{}<body pos="0 0 -.2">{}</body></body>'
    mass = '<inertial pos="0 0 -.1" mass="1" diaginertia=".01 .01 .01"/>'
    knee = f'<joint axis="0 1 0"/>{mass}'
    legs = "".join(leg.format(x, y, mass, knee) for x in (-1, 1) for y in (-1, 1))
    return rb.load(f"<mujoco><worldbody><body><freejoint/>{mass}{legs}</body></worldbody></mujoco>")


def test_robots_are_parted_where_a_reader_would():
    assert sizes(robot(G1).model) == (9, [(2, 6), (2, 7)])
    assert partition(robot(G1).model.topology).links_in_program == 22
    assert sizes(robot("gymnasium/humanoid.xml").model) == (9, [(2, 4), (2, 3)])
    assert sizes(quadruped()) == (6, [(4, 2)])
    assert sizes(walker().model) == (12, [(2, 5), (3, 3)])
    assert sizes(walker(text=CART).model) == (3, [(2, 4)])
    assert partition(walker().model.topology).groups[1].carriers == (16, 22, WORLD)


@pytest.mark.parametrize("name", ["arm7", "double_pendulum", "cart_pole"])
def test_what_has_no_limbs_is_unrolled(name: str):
    model = rb.load(name).replace(driver="limbs")
    assert partition(model.topology) == (tuple(range(model.nv)), ())
    assert isinstance(driver(model, jnp.zeros(()).dtype), Unrolled)
    assert isinstance(driver(walker().model, jnp.zeros(()).dtype), Limbs)


@pytest.mark.parametrize("seed", range(30))
def test_limbs_of_a_group_are_isomorphic_and_disjoint(seed: int):
    top = robot(f"tree:{seed}").model.topology
    trunk, groups = partition(top)
    limbs = [link for group in groups for limb in group.links for link in limb]
    assert sorted([*trunk, *limbs]) == list(range(top.nv))
    assert all(top.parents[i] == WORLD or top.parents[i] in trunk for i in trunk)
    for group in groups:
        assert len(group.links) > 1
        for limb, carrier in zip(group.links, group.carriers, strict=True):
            assert carrier == WORLD or carrier in trunk
            for k, (i, parent) in enumerate(zip(limb, group.parents, strict=True)):
                assert top.parents[i] == (carrier if parent == WORLD else limb[parent])
                assert top.dofs[i].spec == top.dofs[group.links[0][k]].spec


# ------------------------------------------------------------------- what it computes


def everything(model, q, v, a, w, ctrl):
    """All algorithms that use a driver."""
    return {
        "poses": rb.forward_kinematics(model, q),
        "velocities": rb.body_velocities(model, q, v),
        "jacobian": rb.jacobian(model, q, model.body_names[-1]),
        "M": rb.mass_matrix(model, q),
        "inverse": rb.inverse_mass_matrix(model, q),
        "tau": rb.inverse_dynamics(model, q, v, a, w),
        "a": rb.forward_dynamics(model, q, v, a, w),
        "coriolis": rb.coriolis_matrix(model, q, v),
        "regressor": rb.inertial_regressor(model, q, v, a),
        "kinetic": rb.kinetic_energy(model, q, v),
        "momentum": rb.dynamics.centroidal_momentum(model, q, v),
        "applied": rb.applied_forces(model, rb.State(q, v), ctrl),
    }


def given(sample: Robot, count: int) -> list[np.ndarray]:
    q, v = sample.states(count)
    rng, m = np.random.default_rng(0), sample.model
    shapes = (m.nv,), (m.nb, 6), (m.nu,)
    return [q, v, *(rng.normal(size=(count, *shape)) for shape in shapes)]


def run(f, *args):
    return jax.jit(f)(*args)


def agree(got, want, batch_dims: int = 0) -> None:
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert relative_error(x, y, batch_dims=batch_dims).max() <= F64_PARITY


def test_matrices_and_poses_agree_with_the_rolled_driver():
    q = given(walker(text=CART), 3)[0]

    def f(model, q):
        return rb.mass_matrix(model, q), rb.jacobian(model, q, model.body_names[-1])

    agree(*(run(jax.vmap(partial(f, walker(n, CART).model)), q) for n in ("limbs", "rolled")), 1)


@pytest.mark.slow
def test_all_algorithms_agree_with_the_rolled_driver():
    args = given(walker(text=CART), 3)
    got, want = (
        run(jax.vmap(partial(everything, walker(name, CART).model)), *args)
        for name in ("limbs", "rolled")
    )
    for name in want:
        agree(got[name], want[name], 1)


def test_accelerations_are_mujocos():
    sample = walker()
    (q, v), data = sample.states(5), mujoco.MjData(sample.reference)
    model = sample.model

    def acceleration(q, v):
        return rb.forward_dynamics(model, q, v, rb.applied_forces(model, rb.State(q, v)))

    got, want = run(jax.vmap(acceleration), q, v), []
    for k in range(len(q)):
        data.qpos, data.qvel = q[k], v[k]
        mujoco.mj_forward(sample.reference, data)
        want.append(data.qacc.copy())
    agree(got, np.array(want), 1)


def dynamics(model, q, v, a):
    return rb.forward_dynamics(model, q, v, a), rb.inverse_dynamics(model, q, v, a)


def test_a_model_that_is_an_argument():
    q, v = (x[0] for x in given(walker(text=CART), 1)[:2])
    agree(*(run(rb.kinetic_energy, walker(name, CART).model, q, v) for name in ("limbs", "rolled")))


def test_reverse_derivatives_of_limbs_on_two_links():
    q, v = (x[0] for x in given(walker(text=CART), 1)[:2])

    def slope(model, q, v):
        return jax.grad(lambda q: rb.inverse_dynamics(model, q, v, v).sum())(q)

    agree(*(run(partial(slope, walker(name, CART).model), q, v) for name in ("limbs", "rolled")))


def test_reverse_derivatives_where_values_of_a_limb_are_unused():
    """Nothing comes back to what a loop has found but one number of one limb, though a barrier
    takes others."""
    q = given(walker(text=CART), 1)[0][0]

    def slope(driven, q):
        def loss(q):
            d = driver(driven, q.dtype)
            of = d.whole(factorize(d, d.joints(q, None)))[2]
            return fusion_barrier((of.inverse_D, of.U))[0]

        return jax.grad(loss)(q)

    found = (run(partial(slope, walker(name, CART).model), q) for name in ("limbs", "unrolled"))
    agree(*found)


@pytest.mark.slow
@pytest.mark.parametrize("fixed", [False, True])
def test_a_batch_of_robots_and_derivatives_by_their_numbers(fixed: bool):
    """The model's leaves are traced, with and without its zeros as constants of the program."""
    args = given(walker(text=CART), 2)[:3]

    def derivatives(model, q, v, a):
        def scaled(size, q, v, a):
            mass = model.bodies.mass * size
            position = model.bodies.position * size[:, None]
            bodies = model.bodies.replace(mass=mass, position=position)
            return dynamics(model.replace(bodies=bodies), q, v, a)

        size = jnp.ones(model.nb)
        out, pull = jax.vjp(scaled, size, q, v, a)
        return out, pull(out)

    found = []
    for name in ("limbs", "rolled"):
        model = walker(name, CART).model
        model = model.fix_zeros() if fixed else model
        robots = [
            model.replace(bodies=model.bodies.replace(mass=model.bodies.mass * scale))
            for scale in (1.0, 1.5)
        ]
        many = jax.tree.map(lambda *x: jnp.stack(x), *robots)
        found.append(run(jax.vmap(derivatives), many, *args))
    agree(*found, 1)


@pytest.mark.slow
def test_tangents_and_second_derivatives():
    q, v, a = (x[0] for x in given(walker(text=CART), 1)[:3])

    def derivatives(model, q, v, a):
        slope = jax.grad(lambda q: rb.forward_dynamics(model, q, v, a).sum())
        return jax.jvp(lambda *x: dynamics(model, *x), (q, v, a), (q, v, a)), jax.jvp(
            slope, (q,), (q,)
        )

    models = [walker(name, CART).model for name in ("limbs", "rolled")]
    agree(*(run(partial(derivatives, m), q, v, a) for m in models))


def test_limbs_without_hinges():
    inertial = '<inertial pos=".1 0 0" mass="{1}" diaginertia="1 1 1"/>'
    body = f'<body><joint type="{{0}}"/>{inertial}{{2}}</body>'
    limbs = "".join(body.format("ball", m, body.format("slide", m, "")) for m in (1, 2))
    model = rb.load(f"<mujoco><worldbody>{limbs}</worldbody></mujoco>").replace(driver="limbs")
    assert sizes(model) == (0, [(2, 4)])
    state = model.random_state(jax.random.key(0))
    got, want = (
        run(partial(dynamics, m), state.q, state.v, state.v)
        for m in (model, model.replace(driver="rolled"))
    )
    agree(got, want)


@pytest.mark.slow
@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
def test_emitted_c_is_what_xla_computes():
    args = given(walker(text=CART), 4)[:3]
    models = [walker(name, CART).model for name in ("limbs", "rolled")]

    def gradient(model, q, v, a):
        out, pull = jax.vjp(partial(dynamics, model), q, v, a)
        return out, pull(out)

    got, want = (on_host(partial(gradient, model), *args) for model in models)
    agree(got, want, 1)
    agree(got[0], run(jax.vmap(partial(dynamics, models[1])), *args), 1)


def test_programs_of_robots_are_short():
    """Statements of forward dynamics in f32, which decide how a GPU thread runs."""
    for name, most in ((G1, 6_800), ("gymnasium/humanoid.xml", 4_300)):
        model = robot(name, "limbs").model
        shapes = [jax.ShapeDtypeStruct((n,), jnp.float32) for n in (model.nq, model.nv, model.nv)]
        closed = jax.make_jaxpr(lambda *x, m=model: [rb.forward_dynamics(m, *x)])(*shapes)
        ins = [batch_first(x.shape, (4,)) for x in shapes]
        program = write_program(closed, (4,), ins, [batch_first((model.nv,), (4,))])
        assert program.statements <= most


def test_a_loop_of_steps_has_the_driver_of_a_rollout():
    """A tree that is by limbs in `rollout` is so in a user's loop of `step`, of an f32 thread."""
    with jax.enable_x64(False):
        model = load_quietly("humanoid", contacts=False)
        start = model.default_state()
        q, v = (jnp.asarray(x, jnp.float32)[None] for x in (start.q, start.v))

        def loop(q, v):
            turn = lambda x, _: (rb.step(model, x, dt=0.002), None)  # noqa: E731
            return jax.lax.scan(turn, rb.State(q, v), None, length=3)[0].q

        def rollout(q, v):
            return rb.rollout(model, rb.State(q, v), None, 0.002, steps=3, save_every=3).q[-1]

        one, other = (written(f, q, v)[0].statements for f in (loop, rollout))
    assert one < 1.05 * other
