"""Models as MJCF: the same numbers, the same dynamics here and in MuJoCo C, and what is said of the
rest."""

import dataclasses
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.models import MODELS
from benchmarks.cases.random_trees import random_state
from tests.forces.actuated import Samples, limbs, theirs
from tests.forces.test_dc_motor import MOTORS
from tests.forces.test_orientation_servo import SERVOS
from tests.forces.test_pid import CONTROLLERS
from tests.forces.test_transmissions import TRANSMISSIONS
from tests.loading.test_load import joint, link, urdf
from tests.oracles.media import fluid_forces, immersed_tree, states
from tests.oracles.random_actuators import random_actuated
from tests.oracles.random_tendons import random_tendons
from tests.robots import load_quietly, robot
from tests.tolerances import F64_PARITY, F64_ROUNDING, relative_error

TREES = [f"tree:{seed}" for seed in range(3)]
ROBOTS = [*rb.scenes(), "small", *TREES]
#: a robot of each sort; the others are slow ones
SORTS = {"pendulum", "free_body", "arm7", "small", TREES[0]}
FEW = [pytest.param(name, marks=() if name in SORTS else pytest.mark.slow) for name in ROBOTS]


def identified(model: rb.Model, seed: int = 0) -> rb.Model:
    """The model with other masses, centres and inertias, as of a fit."""
    rng, own = np.random.default_rng(seed), model.bodies
    turns = np.linalg.qr(rng.normal(size=(model.nb, 3, 3)))[0]
    return model.replace(
        bodies=own.replace(
            mass=own.mass * rng.uniform(0.5, 2, model.nb),
            com=own.com + 0.01 * rng.normal(size=(model.nb, 3)),
            inertia=turns @ np.asarray(own.inertia) @ turns.swapaxes(1, 2),
        )
    )


def written(model: rb.Model) -> str:
    """The file, of which everything is as in the model."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return rb.write_mjcf(model, strict=True)


def accelerations(text_or_model, q, v, u) -> np.ndarray:
    """MuJoCo's, of all that is no constraint."""
    m = text_or_model
    if isinstance(m, str):
        m = mujoco.MjModel.from_xml_string(m)
        m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        m.tendon_armature[:] = 0.0  # kept in the file, not in the dynamics
    data, rows = mujoco.MjData(m), []
    for data.qpos[:], data.qvel[:], data.ctrl[:] in zip(q, v, u, strict=True):
        mujoco.mj_forward(m, data)
        rows.append(data.qacc_smooth.copy())
    return np.array(rows)


@jax.jit
def dynamics(model, q, v, u):
    def one(q, v, u):
        tau = rb.applied_forces(model, rb.State(q, v, model.start(q.dtype)), u)
        return rb.forward_dynamics(model, q, v, tau)

    return jax.vmap(one)(q, v, u)


def drawn(m: mujoco.MjModel, count: int = 10) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    pairs = [random_state(m, seed) for seed in range(count)]
    u = np.random.default_rng(0).normal(size=(count, m.nu))
    return np.stack([q for q, _ in pairs]), np.stack([v for _, v in pairs]), u


# ---------------------------------------------------------------------------- the same robot


@pytest.mark.parametrize("name", FEW)
def test_the_same_dynamics(name: str) -> None:
    model = identified(robot(name).model)
    text = written(model)
    q, v, u = drawn(robot(name).reference)
    want = dynamics(model, q, v, u)
    got = dynamics(load_quietly(text).replace(dropped=model.dropped), q, v, u)
    assert relative_error(got, want, batch_dims=1).max() <= F64_PARITY
    theirs = accelerations(text, q, v, u)
    assert relative_error(theirs, want, batch_dims=1).max() <= F64_PARITY


#: the largest file, and nine crowds of what the first has
LARGE = [n for n in MODELS if "barkour" in n or ("_humanoids" in n and "01_" not in n)]


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in LARGE else n
             for n in (*ROBOTS, *MODELS)]
)  # fmt: skip
def test_the_same_in_mujoco(name: str) -> None:
    """The original file and the written file, compared in MuJoCo only."""
    with warnings.catch_warnings():
        # MuJoCo's own files: names that MJCF makes, meshes and height fields
        for what in ("names of joints", "names of tendons", "geoms of meshes and height fields"):
            warnings.filterwarnings("ignore", message=f".*{what}")
        text = rb.write_mjcf(robot(name).model)
    reference = robot(name).reference
    q, v, u = drawn(reference)
    got, want = accelerations(text, q, v, u), accelerations(reference, q, v, u)
    singular = np.abs(want).max(initial=0.0) > 1e9  # four slides on one line have no acceleration
    assert singular or relative_error(got, want, batch_dims=1).max() <= F64_PARITY


@pytest.mark.parametrize("name", ROBOTS)
def test_every_number_and_name_is_read_again(name: str) -> None:
    model = identified(load_quietly(name) if name in rb.scenes() else robot(name).model)
    if model.constraints:  # their ends on bodies are written as sites, which then stay
        model = load_quietly(written(model)).replace(dropped=model.dropped)
    again = load_quietly(written(model)).replace(dropped=model.dropped)
    assert jax.tree.structure(again) == jax.tree.structure(model)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(model), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)
    for key in model.keyframe_names:
        assert (again.keyframe(key).q == model.keyframe(key).q).all()


def test_single_precision_keeps_its_decimals() -> None:
    model = load_quietly("arm7")
    single = rb.write_mjcf(model.astype(jnp.float32))
    assert single.count("999") <= rb.write_mjcf(model).count("999")
    again = load_quietly(single).astype(jnp.float32)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(model), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-6, atol=1e-8)


def test_a_file_is_written_too(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    text = rb.write_mjcf(rb.load("two_link"), path)
    assert path.read_text() == text
    assert rb.load(path).joint_names == rb.load("two_link").joint_names


def test_what_fix_zeros_declared_is_what_is_written() -> None:
    fixed = rb.load("pendulum").fix_zeros()
    moved = fixed.replace(bodies=fixed.bodies.replace(com=fixed.bodies.com + 1.0))
    again = rb.load(rb.write_mjcf(moved))
    assert (again.bodies.com[0, :2] == 0).all() and (again.bodies.com[0, 2] != 0)


# ---------------------------------------------------------------------------- force elements


ACTUATORS = {
    "transmissions": [f'<general {t} dyntype="integrator"/>' for t in TRANSMISSIONS],
    "dc motors": MOTORS,
    "servos": SERVOS,
    **CONTROLLERS,
    "muscles": [
        '<muscle joint="h" lengthrange="-1 1"/>',
        '<muscle tendon="rope" lengthrange="1 2" tausmooth="0.3" force="3"/>',
    ],
    "laws": [
        '<general joint="h" dyntype="filter" dynprm="0.07" actrange="-.2 .3" actearly="true"/>',
        '<general joint="k" dyntype="filterexact" dynprm="0.001" forcerange="-.2 .4"/>',
        '<general joint="b" gear="0.2 0.1 0.3" dyntype="filter" dynprm="0.1" gainprm="3"'
        ' biastype="affine" biasprm="0 -3 -0.1"/>',
        '<position joint="b" gear="1 2 3" kp="3"/>',
        '<general joint="s" group="4"/><motor joint="s" ctrlrange="0 1"/>',
    ],
}


@pytest.mark.parametrize("which", [*ACTUATORS, *range(4)])
def test_actuators(which: str | int) -> None:
    """Forces, rates of the states, and the states after a step, of both files."""
    m = mujoco.MjModel.from_xml_string(random_actuated(which)) if isinstance(which, int) else None
    m = limbs(*ACTUATORS[which]) if m is None else m
    if which == "laws":
        m.opt.disableactuator = 1 << 4
    model = load_quietly(m)
    text = written(model)
    again = mujoco.MjModel.from_xml_string(text)
    again.opt.disableflags = m.opt.disableflags
    assert (again.nu, again.na) == (m.nu, m.na)
    for got, want in zip(
        theirs(again, Samples.of(m, 20)), theirs(m, Samples.of(m, 20)), strict=True
    ):
        scale = np.maximum(1.0, np.abs(want).max(-1, initial=0.0, keepdims=True))
        assert (np.abs(got - want) / scale).max(initial=0.0) <= F64_PARITY
    assert load_quietly(text).actuator_names == model.actuator_names


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_fluids(seed: int, share: float) -> None:
    m = immersed_tree(seed, ellipsoids=share)
    again = mujoco.MjModel.from_xml_string(written(load_quietly(m)))
    q, v = states(m, 5)
    want = fluid_forces(m, q, v)
    assert relative_error(fluid_forces(again, q, v), want, batch_dims=1).max() <= F64_PARITY


PASSIVE = {
    "polynomials": (
        {"joint": 'stiffness="3 1 2" damping="0.1 0.2 0.3"', "ball": 'damping="0.1 0.2"'}, ""),
    "gravity compensation": ({"body": 'gravcomp="0.5"'}, ""),
    "its actuated share": ({"body": 'gravcomp="0.5"', "joint": 'actuatorgravcomp="true"'}, ""),
    "springs": (
        {},
        '<tendon><spatial stiffness="3 1 2" damping="0.1 0.2 0.3" springlength="0.1 0.4"><site '
        'site="w"/><site site="s"/></spatial></tendon>',
    ),
}  # fmt: skip
TWO = """<mujoco><worldbody><site name="w" pos="1 1 1"/><body {body}><joint name="j" {joint}/>
<geom size="0.1" pos="0.1 0 0.2" contype="0"/><body pos="0.2 0 0"><joint type="ball" {ball}/>
<geom size="0.1 0.2" type="capsule" pos="0.2 0 0.1" contype="0"/><site name="s" pos="0.4 0 0"/>
</body></body></worldbody>{extra}<actuator><motor joint="j"/></actuator></mujoco>"""


@pytest.mark.parametrize("which", PASSIVE)
def test_passive_elements(which: str) -> None:
    given, extra = PASSIVE[which]
    filled = dict.fromkeys(("body", "joint", "ball"), "") | given
    m = mujoco.MjModel.from_xml_string(TWO.format(extra=extra, **filled))
    m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    model = load_quietly(m)
    assert model.forces or model.tendons
    q, v, u = drawn(m)
    want = accelerations(m, q, v, u)
    assert relative_error(accelerations(written(model), q, v, u), want).max() <= F64_PARITY


def test_springs_at_points_become_tendons() -> None:
    A = rb.forces.Place
    model = load_quietly(TWO.format(body="", joint="", ball="", extra=""))
    aside, above = A.on(site="s", point=[0.1, 0.2, 0.3]), A.on(body=1, point=[1.0, 0, 0])
    for ends in ((A.on(), aside), (above, A.on(site="s"))):
        spring = rb.forces.PointSpring.of(*ends, stiffness=3.0, damping=0.1, length=0.2)
        model = model.with_forces(spring)
    text = written(model)
    again = load_quietly(text)
    q, v, u = drawn(mujoco.MjModel.from_xml_string(text))
    want = dynamics(model, q, v, u)
    assert relative_error(dynamics(again, q, v, u), want).max() <= F64_PARITY
    assert relative_error(accelerations(text, q, v, u), want).max() <= F64_PARITY


def test_tendons_are_kept() -> None:
    """Paths over joints, around geoms with side sites, after pulleys; all parameters."""
    spec, rng = random_tendons(1), np.random.default_rng(4)
    for k, tendon in enumerate(spec.tendons):
        tendon.stiffness[:], tendon.damping[:] = rng.uniform(1, 9, (2, 3))
        tendon.springlength[:] = [0.2, 0.2 + k]
        tendon.limited, tendon.range[:], tendon.margin = True, [0.1, 0.5 + k], 0.02
        tendon.actfrclimited, tendon.actfrcrange[:] = True, [-1, 2]
        tendon.frictionloss, tendon.armature = 0.3 * k, 0.1 * (k == 0)
        tendon.solref_limit[:], tendon.solimp_friction[:3] = [0.1, 0.7], [0.5, 0.6, 0.01]
    model = load_quietly(spec.compile())
    again = load_quietly(rb.write_mjcf(model, strict=True))
    q = jnp.asarray(random_state(spec.compile(), 0)[0])
    lengths = [np.asarray(rb.tendon_lengths(x, q)) for x in (model, again)]
    np.testing.assert_allclose(*lengths, rtol=1e-14)
    for name in ("names", "limited", "rubbing"):
        assert getattr(again.tendons, name) == getattr(model.tendons, name)
    pairs = zip(jax.tree.leaves(model.tendons), jax.tree.leaves(again.tendons), strict=True)
    for a, b in pairs:
        np.testing.assert_allclose(a, b, rtol=1e-12)


# ---------------------------------------------------------------------------- what is said


class Wind(rb.forces.Element):
    speed: jax.Array

    def loads(self, context):
        return rb.forces.Loads()


def noted(model: rb.Model, *words: str) -> str:
    """The file of a model that it does not say as it is, where a warning and a comment say so."""
    with pytest.warns(UserWarning, match="not in the file as in the model") as caught:
        text = rb.write_mjcf(model)
    assert len(caught) == 1 and caught[0].filename == __file__
    head = text[: text.index("<compiler")]
    for word in words:
        assert word in str(caught[0].message)
        assert word in head
    with pytest.raises(rb.UnsupportedFeature, match="strict=False"):
        rb.write_mjcf(model, strict=True)
    load_quietly(text)
    return text


def test_what_mjcf_does_not_have_is_named() -> None:
    model = load_quietly("double_pendulum")
    noted(model.with_forces(Wind(jnp.ones(3))), "force element Wind")
    A = rb.forces.Place
    noted(model.with_forces(rb.forces.Bushing.of(A.on(), A.on(body=0))), "force element Bushing")
    long = rb.forces.JointPolynomials(jnp.ones((1, 3)), jnp.zeros((1, 1)), ("elbow",))
    noted(model.with_forces(long), "JointPolynomials of more than 3 terms", "elbow")
    dry = rb.forces.JointFriction.of(model, ["shoulder"], 0.3)
    assert 'frictionloss="0.3"' in noted(model.with_forces(dry), "shoulder", "friction=True")
    k, d, margin, w = (jnp.array([x]) for x in (1e3, 10.0, 0.0, 1e-3))
    stops = rb.forces.JointLimits(k, d, margin, w, ("elbow",))
    noted(model.with_forces(stops), "elbow", "limits=True")
    held = rb.forces.GravityCompensation(jnp.ones(1), (0,), joints=("elbow",))
    noted(model.with_forces(held), "force element GravityCompensation")


def test_numbers_that_a_file_says_otherwise_are_named() -> None:
    model = robot("small").model
    joints, bodies = model.joints, model.bodies
    at = model.v_slice("ball").start
    uneven = joints.replace(damping=joints.damping.at[at].set(1.0))
    noted(model.replace(joints=uneven), "damping of ball")
    turned = joints.replace(reference=joints.reference.at[model.q_slice("ball")].set(0.5))
    noted(model.replace(joints=turned), "joints.reference", "ball")
    # MuJoCo takes frames within 1e-6 of each other for one
    near = bodies.replace(com=bodies.com.at[3].set(jnp.array([5e-7, 0, 0])))
    diagonal = near.replace(inertia=near.inertia.at[3].set(jnp.diag(jnp.array([1.0, 1.0, 1.0]))))
    noted(model.replace(bodies=diagonal), "bodies.com", "plate")
    # and a positive third number of a servo for a ratio of damping
    own = model.actuators
    ratio = own.replace(bias=own.bias.at[1, 2].set(0.5))
    noted(model.replace(actuators=ratio), "actuators.bias", "servo")


def test_what_the_load_left_out_stands_in_the_file() -> None:
    with pytest.warns(UserWarning, match="left out"):
        model = rb.load(
            TWO.format(body="", joint='frictionloss="1"', ball="", extra=""), contacts=False
        )
    assert "left out when the model was loaded: joint friction loss (j)" in rb.write_mjcf(model)


def test_massless_links_get_the_least_that_mujoco_takes() -> None:
    text = urdf(
        '<link name="base"/><link name="a"/>', link("b", 1),
        joint("turn", "base", "a"), joint("lift", "a", "b").replace("0 1 0", "1 0 0"),
    )  # fmt: skip
    model = load_quietly(text)
    file = noted(model, "raised to 2e-15", "(a)")
    q, v, u = drawn(mujoco.MjModel.from_xml_string(file))
    want = dynamics(model, q, v, u)
    assert relative_error(accelerations(file, q, v, u), want).max() <= F64_PARITY


def test_massless_links_that_carry_mass_are_left_alone() -> None:
    text = urdf('<link name="base"/>', link("trunk", 1), joint("weld", "base", "trunk", "fixed"))
    model = rb.load(text, floating_base=True)
    assert rb.load(written(model)).bodies.mass.tolist() == [0, 1]


# ---------------------------------------------------------------------------- what is refused


def test_what_is_no_robot_is_refused_by_name() -> None:
    model = rb.load("double_pendulum")
    own = model.bodies

    def refused(error, *words, **changes):
        with pytest.raises(error) as caught:
            rb.write_mjcf(model.replace(bodies=own.replace(**changes)))
        assert all(word in str(caught.value) for word in words)

    names = model.body_names
    refused(rb.ModelError, names[1], "rb.spatial", mass=own.mass.at[1].set(-1.0))
    refused(rb.ModelError, names[0], inertia=own.inertia.at[0, 0, 0].set(99.0))
    broken = dataclasses.replace(own, com=own.com.at[1, 2].set(np.nan))
    with pytest.raises(rb.ModelError, match=r"bodies\.com has nan"):
        rb.write_mjcf(model.replace(bodies=broken))
    with pytest.raises(rb.InputError, match="expected a Model"):
        rb.write_mjcf("cart_pole")
    with pytest.raises(rb.InputError, match=r"\(3, 2\).*one model of the batch"):
        rb.write_mjcf(jax.tree.map(lambda x: jnp.stack([x] * 3), model))
    with pytest.raises(rb.InputError, match="traced"):
        jax.jit(lambda m: rb.write_mjcf(m) and 0)(model)


def test_a_chain_deeper_than_a_file_can_be_is_refused() -> None:
    spec = mujoco.MjSpec()
    body = spec.worldbody
    for _ in range(600):
        body = body.add_body(mass=1, inertia=[1, 1, 1], explicitinertial=True)
        body.add_joint()
    with pytest.raises(rb.ModelError, match="the 491th of a chain, expected at most 490"):
        rb.write_mjcf(load_quietly(spec))


def test_rounding_of_a_flat_plate_is_no_refusal() -> None:
    model = rb.load("pendulum")
    flat = jnp.diag(jnp.array([0.1, 0.7, 0.1 + 0.7 + 1e-12]))[None]
    text = written(model.replace(bodies=model.bodies.replace(inertia=flat)))
    assert relative_error(rb.load(text).bodies.inertia, flat) <= 100 * F64_ROUNDING


def test_names_that_xml_does_not_like() -> None:
    model = rb.load("double_pendulum")
    top = dataclasses.replace(model.topology, body_names=("a<b>&\"c'--", "π 关节"))
    model = model.replace(topology=top)
    assert rb.load(written(model)).body_names == top.body_names


def test_joints_that_mjcf_has_not_are_refused() -> None:
    model = rb.load("cart_pole").with_joint("slider", "screw", pitch=0.01)
    with pytest.raises(rb.UnsupportedFeature, match=r"slider \(screw\)"):
        rb.write_mjcf(model)
