"""Model and State: changing fields, names, keyframes, states."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.model.links import with_constants
from tests.robots import robot


@pytest.fixture(scope="module")
def model() -> rb.Model:
    return robot("small").model


def test_replace_gives_a_changed_copy(model: rb.Model) -> None:
    heavy = model.replace(bodies=model.bodies.replace(mass=[1, 2, 3, 4]))
    assert heavy.bodies.mass.dtype == model.bodies.mass.dtype
    np.testing.assert_array_equal(heavy.bodies.mass, [1, 2, 3, 4])
    assert float(model.bodies.mass[0]) == 1.5 and heavy.topology is model.topology
    assert model.replace(driver="rolled").driver == "rolled"


def test_replace_refuses_in_a_sentence(model: rb.Model) -> None:
    with pytest.raises(rb.UnknownName, match=r"'weight'.*'mass', 'com', 'inertia'"):
        model.bodies.replace(weight=1.0)
    with pytest.raises(rb.InputError, match=r"mass.*\(2,\).*expected \(4,\).*jax\.vmap"):
        model.bodies.replace(mass=jnp.ones(2))
    with pytest.raises(AttributeError):
        model.bodies.mass = jnp.ones(4)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"driver": "unroled"}, rb.UnknownName, r"'unroled'.*'auto', 'unrolled', 'rolled'"),
        ({"timestep": float("nan")}, rb.ModelError, "timestep is nan, expected a positive number"),
        ({"timestep": 0.0}, rb.ModelError, "timestep is 0.0, expected a positive number"),
        ({"timestep": -1}, rb.ModelError, r"timestep is -1, .*replace\(timestep=0.002\)"),
        ({"timestep": "1 ms"}, rb.ModelError, r"timestep is '1 ms', .* is for rollout\(dt=...\)"),
    ],
)
def test_what_no_model_can_have_is_refused(model: rb.Model, changes, error, words) -> None:
    with pytest.raises(error, match=words):
        model.replace(**changes)


def test_names(model: rb.Model) -> None:
    assert (model.body("hand"), model.joint("ball"), model.site("tip")) == (2, 2, 0)
    for ask, name in ((model.body, "slider"), (model.joint, "hinge"), (model.site, "tip")):
        with pytest.raises(rb.UnknownName, match=f"unknown .* 'nose'.*{name!r}"):
            ask("nose")
    with pytest.raises(KeyError, match="'bent'"):
        model.keyframe("straight")
    with pytest.raises(rb.UnknownName, match="there are none"):
        robot("tree:1").model.keyframe("any")


def test_slices_of_joints(model: rb.Model) -> None:
    names = ("slide", "hinge", "ball")
    assert [model.q_slice(n) for n in names] == [slice(0, 1), slice(1, 2), slice(2, 6)]
    assert [model.v_slice(n) for n in names] == [slice(0, 1), slice(1, 2), slice(2, 5)]
    assert model.actuator("jet") == 3
    satellite = rb.load("satellite")
    assert satellite.q_slice("root") == slice(0, 7) and satellite.v_slice("root") == slice(0, 6)
    for ask in (model.q_slice, model.v_slice, model.actuator):
        with pytest.raises(rb.UnknownName, match=r"unknown (joint|actuator) 'nose'"):
            ask("nose")


def test_astype(model: rb.Model) -> None:
    single = with_constants(model, jnp.float64).astype(np.float32)
    assert all(x.dtype == np.float32 for x in jax.tree.leaves(single))
    assert single.execution.constants is None and single.topology is model.topology
    state = single.default_state()
    assert rb.mass_matrix(single, state.q).dtype == np.float32
    back = single.astype("float64")
    chex.assert_trees_all_close(back, model, rtol=1e-6)
    with pytest.raises(rb.InputError, match=r"astype: got int32, expected float32 or float64"):
        model.astype("int32")


def test_states(model: rb.Model, key: jax.Array) -> None:
    rest, bent, drawn = model.default_state(), model.keyframe("bent"), model.random_state(key)
    np.testing.assert_array_equal(rest.q, [0.2, 0, 1, 0, 0, 0])
    assert not rest.v.any()
    np.testing.assert_array_equal(bent.v, [1, 2, 3, 4, 5])
    assert np.isclose(jnp.linalg.norm(drawn.q[2:]), 1) and np.abs(drawn.q - rest.q)[:2].max() <= 1
    np.testing.assert_array_equal(drawn.q, model.random_state(key).q)
    assert drawn.replace(v=bent.v).q is drawn.q


def test_random_attitudes_are_uniform_and_batch(key: jax.Array) -> None:
    model = rb.load("free_body")
    many = jax.jit(jax.vmap(model.random_state))(jax.random.split(key, 4000))
    attitude = np.asarray(many.q[:, 3:])
    np.testing.assert_allclose(np.linalg.norm(attitude, axis=1), 1, atol=1e-12)
    second = attitude[:, :, None] * attitude[:, None, :]  # 1/4 of the identity, spread 0.2
    np.testing.assert_allclose(second.mean(0), np.eye(4) / 4, atol=0.02)
    np.testing.assert_allclose(many.v.std(0), 1, atol=0.06)
    np.testing.assert_allclose(many.q[:, :3].mean(0), model.default_state().q[:3], atol=0.05)


def test_a_model_is_a_pytree_of_numbers(model: rb.Model) -> None:
    leaves, tree = jax.tree.flatten(model)
    assert all(isinstance(x, jax.Array) and x.dtype == jnp.float64 for x in leaves)
    assert hash(tree) == hash(jax.tree.structure(jax.tree.map(lambda x: 2 * x, model)))
    assert hash(model.topology) is not None


def test_a_model_without_joints() -> None:
    model = rb.load("<mujoco><worldbody><body name='rock'/></worldbody></mujoco>")
    q = jnp.zeros(0)
    assert rb.forward_dynamics(model, q, q, q).shape == (0,)
    assert rb.mass_matrix(model, q).shape == (0, 0)
    assert rb.forward_kinematics(model, q).p.shape == (1, 3)
