"""What a file has and a model has not is named, with the argument that takes it."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.plotting import draw
from tests.loading.test_load import joint, link, load_quietly, mjcf, urdf

COLLIDES = '<collision><geometry><sphere radius="1"/></geometry></collision>'
BODY = '<body name="b"><joint name="j" {}/><geom size=".1"/><site name="s"/></body>'
USER = '<sensor><user name="g" dim="1"/></sensor>'


def arm(limits: tuple[float, float] | None = None, extra: str = "", collides: bool = False) -> str:
    turn = joint("turn", "base", "arm", "revolute" if limits else "continuous")
    if limits:
        turn = turn.replace('lower="-1" upper="1"', 'lower="{}" upper="{}"'.format(*limits))
    ends = [link("base"), link("arm")]
    if collides:
        ends[1] = ends[1].replace("</link>", COLLIDES + "</link>")
    return urdf(*ends, turn.replace("</joint>", extra + "</joint>"))


#: an entry of `dropped`, what cures it, the file, and arguments with which nothing is left out
ENTRIES = {
    "sensors of the kind user (g)": (
        "rbjax.sensors.CustomSensor", mjcf(BODY.format(""), extra=USER), None),
    "joint limits (j)": (
        "load(contacts=True) or load(limits=True)",
        mjcf(BODY.format('range="0 1" limited="true"')), {"limits": True}),
    "joint friction loss (j)": (
        "load(contacts=True) or load(friction=True)",
        mjcf(BODY.format('frictionloss="1"')), {"friction": True}),
    "collision shapes of links (arm)": (
        "contacts", arm(collides=True), {"contacts": True, "floating_base": False}),
    "fixed root link, whose mass does not count (base)": (
        "load(floating_base=True)", arm(), {"floating_base": True}),
    "joint limits whose lower end is above the upper one (turn)": ("swap", arm((2, 1)), None),
}  # fmt: skip


@pytest.mark.parametrize("entry", ENTRIES)
def test_an_entry_names_its_cure(entry: str) -> None:
    cure, text, arguments = ENTRIES[entry]
    with pytest.warns(UserWarning, match="left out of the model") as caught:
        model = rb.load(text, contacts=False)
    assert entry in model.dropped and len(caught) == 1
    said = str(caught[0].message)
    assert entry in said and (cure is None or f"{entry}: {cure}" in said or cure in said)
    with pytest.raises(rb.UnsupportedFeature) as refused:
        rb.load(text, strict=True, contacts=False)
    assert entry in str(refused.value)
    if arguments:
        assert entry not in rb.load(text, strict=True, **{"contacts": False, **arguments}).dropped


def test_a_root_that_is_said_to_be_fixed_is_not_left_out() -> None:
    assert rb.load(arm(), strict=True, floating_base=False).dropped == ()
    assert rb.load(urdf(link("base", 0), *arm_of_no_root()), strict=True).dropped == ()


def arm_of_no_root() -> tuple[str, str]:
    return link("arm"), joint("turn", "base", "arm", "continuous")


def test_limits_in_the_wrong_order_limit_nothing() -> None:
    model = load_quietly(arm((2, 1)), limits=True, floating_base=False)
    assert np.isinf(model.joints.range).all() and model.forces == ()
    assert np.isfinite(model.random_state(jax.random.key(0)).q).all()


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (mjcf(BODY.format('damping="-5"')), "negative damping (j)"),
        (mjcf(BODY.format('stiffness="-5"')), "negative stiffness (j)"),
        (mjcf(BODY.format('armature="-0.001"')), "negative armature (j)"),
        (arm(extra='<dynamics damping="-3"/>'), "negative damping (turn)"),
    ],
)
def test_numbers_that_no_passive_joint_has_are_named(text: str, what: str) -> None:
    given = {"floating_base": False} if text.startswith("<robot") else {}
    with pytest.warns(UserWarning) as caught:
        rb.load(text, **given)
    assert len(caught) == 1 and what in str(caught[0].message)
    with pytest.raises(rb.UnsupportedFeature, match="negative"):
        rb.load(text, strict=True, **given)


def test_random_states_are_within_the_ranges() -> None:
    ball = '<body><joint type="ball" range="0 30" limited="true"/><geom size=".1"/></body>'
    hinge = '<body><joint range="20 30" limited="true"/><geom size=".1"/>{}</body>'
    slide = '<body><joint type="slide" ref="3" range="-9 2.5" limited="true"/>' \
        '<geom size=".1"/></body>'  # fmt: skip
    model = load_quietly(mjcf(hinge.format(ball), slide))
    for dtype in (jnp.float32, jnp.float64):
        own = model.astype(dtype)
        q = jax.vmap(lambda k, m=own: m.random_state(k).q)(jax.random.split(jax.random.key(0), 99))
        assert q.dtype == dtype
        low, high = own.joints.range.T
        assert (q[:, 0] >= low[0]).all() and (q[:, 0] <= high[0]).all() and q[:, 0].std() > 0.01
        angle = 2 * jnp.arccos(jnp.clip(jnp.abs(q[:, 1]), 0, 1))
        assert angle.max() <= high[1] * (1 + 1e-5) and angle.std() > 0.05
        assert (q[:, 5] <= high[2]).all() and q[:, 5].min() > 1.9
    free = rb.load("double_pendulum")
    far = jax.vmap(lambda k: free.random_state(k).q)(jax.random.split(jax.random.key(0), 99))
    assert 0.9 < jnp.abs(far).max() <= 1 and np.isinf(free.joints.range).all()


def test_a_drawing_says_that_a_urdf_has_no_shapes() -> None:
    model, text = load_quietly(arm()), arm(collides=True)
    with pytest.warns(UserWarning, match="no shapes of the source are drawn .*URDF") as caught:
        draw(model, [0.3], source=text)
    assert [w.filename for w in caught] == [__file__]
    draw(model, [0.3])
    draw(rb.load("pendulum"), [0.3], source="pendulum")


def test_the_callers_compiled_model_stays_as_it_is() -> None:
    m = mujoco.MjModel.from_xml_string(mjcf(BODY.format("")))
    m.body_subtreemass[:] = 7.0
    rb.load(m)
    assert (m.body_subtreemass == 7.0).all()


def test_a_number_that_the_dtype_cannot_hold_is_refused() -> None:
    heavy = '<inertial pos="1 0 0" mass="1e300" diaginertia="1 1 1"/>'
    body = f'<body><joint axis="0 1 0"/>{heavy}</body>'
    with jax.enable_x64(False), pytest.raises(rb.ModelError, match="too large for float32"):
        rb.load(mjcf(body))


def test_sensors_that_the_file_switches_off():
    with pytest.warns(UserWarning, match="switches sensors off"):
        model = rb.load(
            """<mujoco><option><flag sensor="disable"/></option><worldbody><body><joint name="a"/>
            <geom size="1"/></body></worldbody><sensor><jointpos joint="a"/></sensor></mujoco>"""
        )
    assert any("switches sensors off" in x for x in model.dropped)
