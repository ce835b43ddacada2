"""Every kind of joint, on every driver: against MuJoCo's chains of hinges and slides, Pinocchio's
own joints, and identities that hold for any joint."""

import copy
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.dynamics.algorithms.energy import momentum_and_rate
from rbjax.lanes import Mat3, Vec3, rotation_z, sincos
from rbjax.spatial import Transform
from tests.tolerances import F64_IDENTITY, F64_ROUNDING, relative_error

#: a chain with a joint of every sort of neighbour; {joint} moves the second body
CHAIN = """<mujoco><default><geom contype="0" conaffinity="0" type="box"/></default>
<worldbody><body pos="0.1 0 0.3">
  <joint name="first" axis="0.1 0.2 0.9" pos="0.02 0 0"/>
  <geom size="0.1 0.04 0.06" pos="0.05 0.01 0" mass="1.3"/>
  <body pos="0.2 0.05 0" euler="20 30 10">{joint}
    <geom size="0.05 0.1 0.03" pos="0.02 0.1 0.03" mass="0.9"/>
    <body pos="0 0.2 0.1" euler="0 50 0"><joint name="last" {last} axis="0.6 0 0.8"/>
      <geom size="0.02 0.05 0.03" pos="0.02 0.05 0.01" mass="0.4"/></body>
  </body></body></worldbody></mujoco>"""
AT = 'pos="0.03 0.02 0.01"'
SLIDE, BALL = 'type="slide"', 'type="ball" pos="0 0.02 0"'
STAND_IN = f'<joint name="it" {AT} axis="2 -1 2"/>'
#: Duff's rotation of z to the axis [2, -1, 2] / 3, by hand: x and y of its plane
IN_PLANE = ("11 2 -10", "2 14 5")
#: a kind, its numbers, and the chain that MuJoCo takes for it
CHAINS = {
    "cylindrical": ({}, f'<joint type="slide" {AT} axis="2 -1 2"/><joint {AT} axis="2 -1 2"/>'),
    "planar": (
        {},
        "".join(f'<joint type="slide" {AT} axis="{a}"/>' for a in IN_PLANE)
        + f'<joint {AT} axis="2 -1 2"/>',
    ),
    "universal": (
        {"second_axis": [0.3, 0.4, -1.2]},
        f'<joint {AT} axis="2 -1 2"/><joint {AT} axis="0.3 0.4 -1.2"/>',
    ),
}
#: one of MuJoCo's own, put in place of the hinge
OWN = {"ball": ({}, f'<joint type="ball" {AT}/>')}


class OnCurve(rb.joints.Node):
    """A body that slides along a helix-like curve and turns on the way: one coordinate."""

    name, coordinates = "on_curve", 1

    def pose(self, q, params):
        c, s = sincos(q[0])
        return Transform(rotation_z(c, s), Vec3(0.3 * c, 0.2 * s, 0.1 * q[0] * q[0]))


class Bent(rb.joints.Node):
    """The motion of a beam's end from two modes, to second order: two coordinates."""

    name, coordinates = "bent", 2

    def pose(self, q, params):
        (c, s), (d, e) = sincos(1.5 * q[0]), sincos(1.2 * q[1])
        R = Mat3(1.0, 0.0, 0.0, 0.0, d, -e, 0.0, e, d)
        short = 0.5 - 0.6 * (q[0] * q[0] + q[1] * q[1])
        return Transform(rotation_z(c, s) @ R, Vec3(short, q[0], -q[1]))


class Cardan(rb.joints.Node):
    """A universal joint as a node: turns about z, then about x."""

    name, coordinates = "cardan", 2

    def pose(self, q, params):
        (c, s), (d, e) = sincos(q[0]), sincos(q[1])
        return Transform(rotation_z(c, s) @ Mat3(1, 0, 0, 0, d, -e, 0, e, d), Vec3.zero())


for node in (OnCurve(), Bent(), Cardan()):
    rb.joints.register(node)

KINDS = {
    "screw": {"pitch": 0.07},
    **{name: given for name, (given, _) in CHAINS.items()},
    "on_curve": {}, "bent": {}, "cardan": {},
}  # fmt: skip


#: those that stand for the others where a test is dear
QUICK = {"screw", "bent"}
ONE = [pytest.param(kind, marks=() if kind == "screw" else pytest.mark.slow) for kind in KINDS]
FEW = [pytest.param(kind, marks=() if kind in QUICK else pytest.mark.slow) for kind in KINDS]


def chain(kind: str, last: str = SLIDE, **given) -> rb.Model:
    robot = rb.load(CHAIN.format(joint=STAND_IN, last=last))
    return robot.with_joint("it", kind, **given)


@functools.cache
def moving(kind: str, last: str = SLIDE):
    model = chain(kind, last, **KINDS.get(kind, {}))
    state = model.random_state(jax.random.key(3))
    a = jax.random.normal(jax.random.key(4), (model.nv,))
    return model, state.q, state.v, a


def everything(model, q, v, a):
    """The results of all algorithms for a motion."""
    last = model.body_names[-1]
    return {
        "tau": rb.inverse_dynamics(model, q, v, a),
        "a": rb.forward_dynamics(model, q, v, a),
        "M": rb.mass_matrix(model, q),
        "inverse": rb.inverse_mass_matrix(model, q),
        "C": rb.coriolis_matrix(model, q, v),
        "V": rb.body_velocities(model, q, v),
        "p": rb.forward_kinematics(model, q).p,
        "R": rb.forward_kinematics(model, q).R,
        "J": rb.jacobian(model, q, last),
        "J_rate": rb.jacobian_rate(model, q, v, last),
        "bias": rb.frame_bias_acceleration(model, q, v, last),
        "regressor": rb.inertial_regressor(model, q, v, a),
        "energy": rb.kinetic_energy(model, q, v),
        "rest": rb.gravity_forces(model, q),
    }


@functools.cache
def found(kind: str, driver: str = "unrolled", last: str = SLIDE):
    model, q, v, a = moving(kind, last)
    return jax.jit(functools.partial(everything, model.replace(driver=driver)))(q, v, a)


@pytest.mark.parametrize(
    "kind", [*CHAINS, *(pytest.param(kind, marks=pytest.mark.slow) for kind in OWN)]
)
def test_a_chain_is_mujoco_s(kind: str) -> None:
    """Poses, mass matrix and inverse dynamics of the same robot in MuJoCo C."""
    (_, q, v, a), ours = moving(kind), found(kind)
    m = mujoco.MjModel.from_xml_string(CHAIN.format(joint=(CHAINS | OWN)[kind][1], last=SLIDE))
    data = mujoco.MjData(m)
    data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
    mujoco.mj_forward(m, data)
    M = np.zeros((m.nv, m.nv))
    for k, unit in enumerate(np.eye(m.nv)):
        mujoco.mj_mulM(m, data, M[k], unit)
    data.qacc[:] = a
    mujoco.mj_inverse(m, data)
    np.testing.assert_allclose(ours["p"], data.xpos[1:], atol=1e-12)
    np.testing.assert_allclose(ours["M"], M, atol=1e-12)
    np.testing.assert_allclose(ours["tau"], data.qfrc_inverse, atol=1e-11)


def test_a_screw_is_pinocchio_s() -> None:
    """The mass matrix and inverse dynamics of a helical joint between two hinges."""
    pin = pytest.importorskip("pinocchio", reason="pin is not installed")
    theirs, at = pin.Model(), pin.SE3.Identity()
    inertia = pin.Inertia(1.1, np.array([0.1, 0.02, -0.03]), np.diag([0.02, 0.03, 0.04]))
    turn = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.0, 0.6]])
    z = np.array([0.0, 0.0, 1.0])
    joints = (pin.JointModelRZ(), pin.JointModelHelicalUnaligned(z, 0.07), pin.JointModelRZ())
    parent = 0
    for n, joint in enumerate(joints):
        parent = theirs.addJoint(parent, joint, at, f"{n}")
        theirs.appendBodyToJoint(parent, inertia, pin.SE3.Identity())
        at = pin.SE3(turn, np.array([0.1, 0.2, 0.3]))
    body = (
        '<body name="{n}" pos="{p}" quat="{q}"><joint name="{n}"/><inertial mass="1.1" '
        'pos="0.1 0.02 -0.03" diaginertia="0.02 0.03 0.04"/>{inside}</body>'
    )
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, turn.ravel())
    inside = ""
    for n in (2, 1, 0):
        p, turned = ("0.1 0.2 0.3", quat) if n else ("0 0 0", [1.0, 0.0, 0.0, 0.0])
        turned = " ".join(repr(float(x)) for x in turned)
        inside = body.format(n=f"j{n}", p=p, q=turned, inside=inside)
    text = f"<mujoco><worldbody>{inside}</worldbody></mujoco>"
    model = rb.load(text).with_joint("j1", "screw", pitch=0.07)
    q, v, a = np.random.default_rng(0).normal(size=(3, 3))
    data = theirs.createData()
    want = pin.rnea(theirs, data, q, v, a)
    np.testing.assert_allclose(rb.inverse_dynamics(model, q, v, a), want, atol=1e-12)
    M = pin.crba(theirs, data, q)
    M = np.triu(M) + np.triu(M, 1).T
    np.testing.assert_allclose(rb.mass_matrix(model, q), M, atol=1e-13)


@pytest.mark.parametrize("kind", FEW)
def test_identities(kind: str) -> None:
    """Forward inverts inverse; M, C and the energy belong together; Jacobians are derivatives."""
    check_identities(kind, SLIDE)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_identities_before_a_ball(kind: str) -> None:
    check_identities(kind, BALL)


def check_identities(kind: str, last: str) -> None:
    (model, q, v, a), ours = moving(kind, last), found(kind, last=last)
    tau, tip = ours["tau"], model.body_names[-1]

    def along(h):
        q_h = rb.integrate(model, q, h * v)
        return (
            rb.mass_matrix(model, q_h),
            rb.jacobian(model, q_h, tip),
            rb.forward_kinematics(model, q_h).p,
        )

    again, (M_rate, J_rate, moved) = jax.jit(
        lambda tau: (
            rb.forward_dynamics(model, q, v, tau), jax.jvp(along, (0.0,), (1.0,))[1]
        )
    )(tau)  # fmt: skip
    np.testing.assert_allclose(again, a, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(ours["M"] @ ours["inverse"], np.eye(model.nv), atol=1e-9)
    np.testing.assert_allclose(ours["energy"], v @ ours["M"] @ v / 2, rtol=F64_ROUNDING)
    whole = ours["C"] @ v + ours["M"] @ a + ours["rest"]
    np.testing.assert_allclose(whole, tau, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(ours["C"] + ours["C"].T, M_rate, atol=1e-10)
    np.testing.assert_allclose(ours["J_rate"], J_rate, atol=1e-10)
    np.testing.assert_allclose(ours["J"] @ v, ours["V"][-1], atol=1e-11)
    np.testing.assert_allclose(ours["bias"], ours["J_rate"] @ v, atol=1e-10)
    parameters = rb.inertial_parameters(model)
    np.testing.assert_allclose(ours["regressor"] @ parameters, tau, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(ours["V"][:, 3:], moved, atol=1e-11)


@pytest.mark.parametrize("kind", FEW)
def test_derivatives(kind: str) -> None:
    """The derivatives of inverse and forward dynamics are those of differentiation."""
    model, q, v, a = moving(kind)

    def inverse(dq, v, a):
        return rb.inverse_dynamics(model, rb.integrate(model, q, dq), v, a)

    def forward(dq, v, a):
        return rb.forward_dynamics(model, rb.integrate(model, q, dq), v, a)

    for f, by in (
        (inverse, rb.inverse_dynamics_derivatives), (forward, rb.forward_dynamics_derivatives),
    ):  # fmt: skip
        got = jax.jit(functools.partial(by, model))(q, v, a)
        want = jax.jit(jax.jacrev(f, (0, 1, 2)))(0 * v, v, a)
        for one, other in zip(got, want, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("kind", ONE)
def test_the_rolled_driver_agrees(kind: str) -> None:
    agree(found(kind), found(kind, "rolled"))


def test_a_node_among_hinges_on_the_rolled_driver() -> None:
    """The cheapest of `everything`."""
    model, q, v, a = moving("bent")
    rolled, unrolled = (model.replace(driver=driver) for driver in ("rolled", "unrolled"))
    agree(rb.inverse_dynamics(rolled, q, v, a), rb.inverse_dynamics(unrolled, q, v, a))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_rolled_driver_agrees_before_a_ball(kind: str) -> None:
    agree(found(kind, last=BALL), found(kind, "rolled", BALL))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_limbs_agree(kind: str) -> None:
    """Two equal chains: one of them in a loop."""
    before, rest = CHAIN.format(joint=STAND_IN, last=SLIDE).split("<worldbody>")
    two = again = rest.split("</worldbody>")[0]
    for name in ("first", "it", "last"):
        again = again.replace(f'name="{name}"', f'name="{name}2"')
    model = rb.load(f"{before}<worldbody>{two}{again}</worldbody></mujoco>")
    for name in ("it", "it2"):
        model = model.with_joint(name, kind, **KINDS[kind])
    state = model.random_state(jax.random.key(3))
    q, v, a = state.q, state.v, jnp.cos(state.v)
    agree(
        *(
            jax.jit(functools.partial(everything, model.replace(driver=driver)))(q, v, a)
            for driver in ("limbs", "rolled")
        )
    )


def agree(one, other) -> None:
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_a_node_is_the_chain_of_the_same_motion() -> None:
    """A universal joint written as a node of two coordinates."""
    _, q, v, a = moving("cardan")
    A = np.array([[11, 2, 10], [2, 14, -5], [-10, 5, 10]]) / 15.0
    second = A[:, 0]
    same = chain("universal", second_axis=second)
    want = jax.jit(lambda q, v, a: everything(same, q, v, a))(q, v, a)
    ours = found("cardan")
    for name, x in ours.items():
        assert relative_error(x, want[name]) <= F64_IDENTITY, name


@pytest.mark.parametrize("kind", FEW)
def test_momenta(kind: str) -> None:
    """p = M v, and p' along the motion: of axes that depend on q too."""
    model, q, v, a = moving(kind)
    tau = found(kind)["tau"]
    p, rate = jax.jit(lambda q, v, tau: momentum_and_rate(model, q, v, tau))(q, v, tau)
    want = jax.jit(
        lambda q, v, a: jax.jvp(lambda q, v: rb.mass_matrix(model, q) @ v, (q, v), (v, a))
    )(q, v, a)
    np.testing.assert_allclose(p, want[0], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(rate, want[1], rtol=1e-9, atol=1e-10)


def test_the_variational_step_is_of_order_two_on_a_node() -> None:
    model = rb.load("cart_pole").with_joint("slider", "on_curve", axis=[0.0, 0.0, 1.0])
    state = rb.State(jnp.array([0.4, 0.3]), jnp.array([0.5, -0.2]))

    @functools.partial(jax.jit, static_argnums=(0, 1))
    def end(integrator, n):
        return rb.rollout(model, state, None, 0.4 / n, steps=n, integrator=integrator).q[-1]

    exact = end("dopri8", 64)
    coarse, fine = (jnp.abs(end("variational_midpoint", n) - exact).max() for n in (16, 32))
    assert abs(np.log2(coarse / fine) - 2) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("kind", ONE)
def test_motion(kind: str) -> None:
    """Energy is kept, forces of springs included; the gradient is the difference quotient."""
    model, q, v, _ = moving(kind)
    model = model.replace(gravity=jnp.array([0.0, 0.0, -2.0]), timestep=5e-4)
    state = rb.State(q, 0.5 * v)

    def energy(path):
        each = jax.vmap(lambda q, v: rb.kinetic_energy(model, q, v) + rb.potential_energy(model, q))
        return each(path.q, path.v)

    def run(scale):
        start = state.replace(v=scale * state.v)
        path = rb.rollout(model, start, steps=100, integrator="rk4")
        return path.q[-1], path

    @jax.jit
    def found(scale):
        end, rate, path = jax.jvp(run, (scale,), (1.0,), has_aux=True)
        return end, rate, energy(path)

    _, rate, kept = found(1.0)
    np.testing.assert_allclose(kept, kept[0], rtol=1e-6)
    quotient = (found(1.0 + 1e-5)[0] - found(1.0 - 1e-5)[0]) / 2e-5
    np.testing.assert_allclose(rate, quotient, rtol=1e-5, atol=1e-6)


def test_gradients_by_the_pitch() -> None:
    """A screw's pitch and a second axis are leaves: derivatives, and maps over them."""
    for kind in ("screw", "universal"):
        model, q, v, a = moving(kind)

        def tau(numbers, model=model, q=q, v=v, a=a):
            joints = model.joints.replace(params=numbers)
            return rb.inverse_dynamics(model.replace(joints=joints), q, v, a).sum()

        numbers = model.joints.params
        h = 1e-6 * jnp.ones_like(numbers)
        got = jax.grad(tau)(numbers) @ h
        np.testing.assert_allclose(got, (tau(numbers + h) - tau(numbers - h)) / 2, rtol=1e-6)
        both = jax.vmap(tau)(jnp.stack([numbers, 1.1 * numbers]))
        np.testing.assert_allclose(both, [tau(numbers), tau(1.1 * numbers)], rtol=F64_ROUNDING)


def test_with_joint_keeps_what_it_can_and_says_what_it_cannot() -> None:
    model = rb.load("arm7")
    name = model.joint_names[2]
    screw = model.with_joint(name, "screw", pitch=0.02)
    np.testing.assert_array_equal(screw.joints.armature, model.joints.armature)
    np.testing.assert_array_equal(screw.joints.range, model.joints.range)
    wide = model.replace(forces=()).with_joint(name, "planar", reference=[0.1, 0.2, 0.3])
    assert wide.nq == model.nq + 2 and wide.keyframes.q.shape == (len(wide.keyframe_names), wide.nq)
    assert wide.q_slice(name) == slice(2, 5)
    np.testing.assert_array_equal(wide.default_state().q[2:5], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(model.with_joint(name, "universal").joints.params, [0, 1, 0])
    fixed = screw.fix_zeros()
    assert fixed.with_joint(name, "hinge").execution.zeros is not None
    with pytest.raises(rb.UnknownName, match="screw"):
        model.with_joint(name, "scrw")
    with pytest.raises(rb.UnknownName, match="pitch"):
        model.with_joint(name, "screw", pich=0.1)  # codespell:ignore


@pytest.mark.parametrize(
    ("kind", "given", "words"),
    [
        ("universal", {"second_axis": [1.0]}, r"\(second_axis=.*shape \(1,\), expected \(3,\)"),
        ("universal", {"second_axis": np.zeros(3)}, r"\(second_axis=.*squared length 0.*an axis"),
        ("screw", {"axis": np.zeros(3)}, r"\(axis=...\): got .*expected an axis"),
        ("screw", {"axis": [1.0, np.inf, 0.0]}, r"\(axis=...\): got inf at \[1\], expected finite"),
        ("screw", {"pitch": np.nan}, r"\(pitch=...\): got nan at \[\], expected finite"),
        ("screw", {"pitch": "0.1"}, r"\(pitch=...\): got str, expected numbers of shape \(\)"),
        ("screw", {"pitch": 1j}, r"\(pitch=...\): got numbers of dtype complex128"),
        ("ball", {"reference": np.zeros(4)}, r"\(reference=...\).*expected a unit quaternion"),
    ],
)
def test_numbers_of_a_joint_are_checked(kind: str, given: dict, words: str) -> None:
    model = rb.load("cart_pole")
    with pytest.raises(rb.InputError, match=rf"with_joint{words}"):
        model.with_joint("slider", kind, **given)


def test_a_kind_registered_anew_is_another_program() -> None:
    """As when a notebook cell runs again: new models use the new kind, old ones the old kind."""

    def rail(height):
        class Rail(rb.joints.Node):
            name, coordinates = "tilted_rail", 1

            def pose(self, q, params):
                return Transform(Mat3.identity(), Vec3(q[0], 0.0, height * q[0]))

        rb.joints.register(Rail())
        return rb.load("cart_pole").with_joint("slider", "tilted_rail")

    q = jnp.array([0.5, 0.0])
    flat = rail(0.0)
    before = rb.kinetic_energy(flat, q, jnp.array([1.0, 0.0]))
    steep = rail(2.0)
    energies = [rb.kinetic_energy(m, q, jnp.array([1.0, 0.0])) for m in (steep, flat)]
    np.testing.assert_allclose(energies, [5 * before, before], rtol=F64_ROUNDING)
    again = copy.deepcopy(steep.topology)
    assert again == steep.topology and again.dofs


def test_registering() -> None:
    with pytest.raises(rb.InputError, match="expected an instance"):
        rb.joints.register(OnCurve)  # type: ignore[arg-type]

    class Another(rb.joints.Node):
        name, coordinates = "hinge", 1

    with pytest.raises(rb.InputError, match="another name"):
        rb.joints.register(Another())
    with pytest.raises(NotImplementedError, match="needs a pose"):
        Another().pose([], [])


def test_a_hinge_turns_about_z() -> None:
    angle, speed = 0.3, -0.7
    c, s = np.cos(angle), np.sin(angle)
    motion = rb.joints.hinge_motion(c, s, speed)
    rotation = np.array([[*row] for row in motion.J.rows])
    np.testing.assert_array_equal(rotation, [[c, -s, 0], [s, c, 0], [0, 0, 1]])
    twist = motion.twist
    np.testing.assert_array_equal([*twist.ang, *twist.lin], [0, 0, speed, 0, 0, 0])
