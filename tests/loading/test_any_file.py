"""Property tests: a robot file that is wrong in any way ends in an error of rbjax or in a model of
finite numbers; nothing is silent and no other exception gets out."""

import math
import random
import warnings
import xml.etree.ElementTree as ET

import jax
import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import rbjax as rb
from tests.loading.test_load import joint, link, urdf
from tests.robots import SMALL

ARM = urdf(
    link("base", 3), link("arm"), link("hand"), link("tool"),
    joint("elbow", "base", "arm", "continuous"), joint("wrist", "arm", "hand", "prismatic"),
    joint("grip", "hand", "tool", "fixed"),
)  # fmt: skip
PATCHES = (
    "nan", "inf", "-1", "0", "1e400", "1e300", "1e-300", "x", "", "1 2", "1,5", "\u0663", "-0.0",
    "../..", "base", "arm", "elbow", "free", "ball", "floating", "true",
)  # fmt: skip
TEXTS = (ARM, SMALL)
QUICK = settings(
    max_examples=60, deadline=None, derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)  # fmt: skip


def checked(text: str) -> None:
    """Load it: an error of rbjax with a sentence, or a model of finite numbers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            model = rb.load(text)
        except rb.RbjaxError as error:
            assert 25 < len(str(error)) < 2000, str(error)
            return
    records = (model.bodies, model.joints.replace(), model.gravity, model.sites, model.keyframes)
    for x in jax.tree.leaves(records):
        x = np.asarray(x)
        assert not np.isnan(x).any()
    for x in jax.tree.leaves((model.bodies, model.gravity, model.sites, model.keyframes)):
        assert np.isfinite(x).all()
    assert math.isfinite(model.timestep) and model.timestep > 0
    q = model.random_state(jax.random.key(0)).q
    assert np.isfinite(q).all()


@QUICK
@given(st.sampled_from(TEXTS), st.randoms(use_true_random=False), st.sampled_from(PATCHES))
def test_any_attribute_may_be_wrong(text: str, chance: random.Random, value: str) -> None:
    root = ET.fromstring(text)
    places = [(x, key) for x in root.iter() for key in x.attrib]
    element, key = chance.choice(places)
    element.set(key, value)
    checked(ET.tostring(root, encoding="unicode"))


@QUICK
@given(st.sampled_from(TEXTS), st.randoms(use_true_random=False), st.sampled_from("rdmw"))
def test_any_element_may_be_missing_or_there_twice(
    text: str, chance: random.Random, how: str
) -> None:
    root = ET.fromstring(text)
    places = [(parent, child) for parent in root.iter() for child in parent]
    parent, child = chance.choice(places)
    if how == "r":
        parent.remove(child)
    elif how == "d":
        parent.append(child)
    elif how == "m":
        parent.remove(child)
        chance.choice([x for x in root.iter() if x is not child]).append(child)
    else:
        child.tag = chance.choice(["joint", "link", "body", "geom", "inertial", "nonsense"])
    checked(ET.tostring(root, encoding="unicode"))


@QUICK
@given(st.sampled_from(TEXTS), st.floats(0, 1), st.text(max_size=8))
def test_any_text_may_be_cut_or_filled(text: str, where: float, more: str) -> None:
    at = int(where * len(text))
    checked(text[:at])
    checked(text[:at] + more + text[at:])


@QUICK
@given(
    st.lists(st.sampled_from(["a", "b", "c", "world", ""]), min_size=1, max_size=4),
    st.lists(st.tuples(
        st.sampled_from(["a", "b", "c", "world", "gone"]), st.sampled_from(["a", "b", "c"]),
        st.sampled_from(["continuous", "fixed", "floating", "planar", "spherical", "spring"]),
        st.floats(allow_nan=True, allow_infinity=True),
    ), max_size=4),
)  # fmt: skip
def test_any_tree_of_a_urdf(links: list, joints: list) -> None:
    parts = [joint(f"j{k % 3}", a, b, kind).replace("0 1 0", f"0 {x} 0")
             for k, (a, b, kind, x) in enumerate(joints)]  # fmt: skip
    checked(urdf(*(link(name) for name in links), *parts))
