"""Parameters of contacts against those of MuJoCo's contacts, their derivatives, constants."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.parameters import PairParameters, pair_parameters, tangential_solref

pytestmark = pytest.mark.filterwarnings("ignore:.*left out of the model.*contacts")
NAMES = {"margin": "includemargin", "condim": "dim"}


def text(x: Any) -> str:
    return " ".join(repr(float(n)) for n in np.atleast_1d(x))


def pile(seed: int, flags: str = ">", pairs: int = 9) -> str:
    """Spheres that all overlap, with parameters at random and at the edges of the rules."""
    rng = np.random.default_rng(seed)

    def softness() -> dict[str, str]:
        solref = rng.choice([[0.02, 1.0], [0.013, 0.7], [-300.0, -20.0], [-40.0, 0.0], [0.0, 0.0]])
        solimp = [*rng.uniform(0.1, 0.95, 2), rng.choice([0.0, 0.01]), 0.4, rng.uniform(1, 3)]
        return {"solref": text(solref), "solimp": text(solimp)}

    def geom(name: int) -> str:
        given = softness() | {
            "friction": text(rng.choice([0.0, 1.0, 1e-6]) * rng.random(3)),
            "solmix": text(rng.choice([0.0, 1.0, 3.7, 1e-16, 2e-15])),
            "priority": str(rng.choice([0, 0, 0, 1, -2])),
            "condim": str(rng.choice([1, 3, 4, 6])),
            "margin": text(rng.choice([0.0, 0.1])), "gap": text(rng.choice([0.0, 0.05])),
        }  # fmt: skip
        body = "".join(f' {key}="{x}"' for key, x in given.items())
        return (
            f'<body pos="{text(0.01 * rng.normal(size=3))}"><freejoint/>'
            f'<geom name="g{name}" size="1"{body}/></body>'
        )

    bodies, explicit = "".join(map(geom, range(9))), ""
    for _ in range(pairs):
        a, b = rng.choice(9, 2, replace=False)
        given = softness() | {
            "friction": text(rng.choice([0.0, 1.0]) * rng.random(5)), "gap": text(rng.random()),
            "solreffriction": rng.choice(["0 0", "0.03 0.5", "-10 0"]),
            "condim": str(rng.choice([1, 3, 4, 6])), "margin": text(rng.random()),
        }  # fmt: skip
        body = "".join(f' {key}="{x}"' for key, x in given.items())
        explicit += f'<pair geom1="g{a}" geom2="g{b}"{body}/>'
    return (
        f"<mujoco><option {flags}</option><worldbody>{bodies}</worldbody>"
        f"<contact>{explicit}</contact></mujoco>"
    )


def of_mujoco(m: mujoco.MjModel) -> dict[tuple[int, int], list[dict[str, np.ndarray]]]:
    """The parameters of MuJoCo's contacts in the reference configuration, by pair."""
    d = mujoco.MjData(m)
    mujoco.mj_fwdPosition(m, d)
    out: dict = {}
    for c in d.contact:
        row = {
            k: np.array(getattr(c, NAMES.get(k, k))) for k in PairParameters._fields if k != "gap"
        }
        out.setdefault((int(c.geom[0]), int(c.geom[1])), []).append(row)
    return out


OVERRIDE = (
    'o_margin="0.3" o_solref="0.04 0.6" o_solimp="0.4 0.6 0.01 0.3 1.5" '
    'o_friction="0.2 0.3 0 0.4 0.5"><flag override="enable"/>'
)


@pytest.mark.parametrize("flags", [">", OVERRIDE])
def test_parameters_are_those_of_mujoco(flags: str) -> None:
    compared = 0
    for seed in range(5):
        m = mujoco.MjModel.from_xml_string(pile(seed, flags))
        geoms = rb.load(m).geoms
        ours, theirs = pair_parameters(geoms, geoms.pairs), of_mujoco(m)
        rows: dict = {}
        for i, pair in enumerate(geoms.pairs):
            rows.setdefault(pair, []).append({k: x[i] for k, x in ours._asdict().items()})
        assert {k: len(x) for k, x in theirs.items()} == {k: len(x) for k, x in rows.items()}
        for pair, found in theirs.items():
            for row, expected in zip(rows[pair], found, strict=True):
                for name, x in expected.items():
                    np.testing.assert_allclose(
                        row[name], x, rtol=0, atol=1e-15, err_msg=f"{seed} {pair} {name}"
                    )
                compared += 1
    assert compared > 180


def test_gaps_decide_which_contacts_exist() -> None:
    """MuJoCo has a contact if the distance is below margin + gap."""
    text = """<mujoco><worldbody><geom size="1" margin=".1" gap=".2"/>
      <body pos="0 0 {}"><freejoint/><geom size="1" margin=".05" gap=".03"/></body></worldbody>
      {}</mujoco>"""
    for pair, sum_ in (("", 0.38), ('<contact><pair geom1="a" geom2="b" margin=".3" gap=".25"/>'
                                    "</contact>", 0.55)):  # fmt: skip
        for sign in (-1, 1):
            given = text.format(2 + sum_ + sign * 1e-9, pair).replace("<geom size", "<geom{} size")
            m = mujoco.MjModel.from_xml_string(given.format(' name="a"', ' name="b"'))
            geoms = rb.load(m).geoms
            found = pair_parameters(geoms, geoms.pairs)
            np.testing.assert_allclose(found.margin + found.gap, sum_, rtol=1e-15)
            assert len(of_mujoco(m)) == (sign < 0)


def test_constants_are_arrays_of_numpy_and_other_leaves_are_differentiated() -> None:
    model = rb.load(mujoco.MjModel.from_xml_string(pile(3)))
    geoms, leaves = model.geoms, ("friction", "solmix", "pair_friction", "margin")
    kept = pair_parameters(geoms, geoms.pairs)
    assert all(isinstance(x, np.ndarray) for x in kept[:-1])

    def outputs(*changed):
        own = dataclasses.replace(geoms, **dict(zip(leaves, changed, strict=True)))
        found = pair_parameters(own, geoms.pairs)
        assert isinstance(found.gap, np.ndarray)
        return found.friction, found.solimp, found.margin

    args = tuple(getattr(geoms, name) for name in leaves)
    for a, b in zip(
        jax.jit(outputs)(*args), (kept.friction, kept.solimp, kept.margin), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=1e-14)
    n = len(geoms.pairs)
    friction, solimp, margin = jax.jit(jax.jacrev(outputs, argnums=(0, 1, 2, 3)))(*args)
    assert friction[0].shape == (n, 5, 9, 3) and float(jnp.abs(friction[0]).sum()) > 0
    assert float(jnp.abs(friction[2][:9]).sum()) > 0 and float(jnp.abs(friction[2][9:]).sum()) == 0
    for x in jax.tree.leaves((friction, solimp, margin)):
        assert jnp.isfinite(x).all()  # with weights of zero too
    np.testing.assert_array_equal(margin[3].sum(-1), [0.0] * 9 + [2.0] * (n - 9))


def test_a_batch_and_single_precision() -> None:
    geoms = rb.load(mujoco.MjModel.from_xml_string(pile(5))).geoms
    single = jax.tree.map(lambda x: x.astype(jnp.float32), geoms)

    def friction(x):
        return pair_parameters(dataclasses.replace(single, friction=x), geoms.pairs).friction

    batch = single.friction * jnp.array([1.0, 0.5, 2.0], jnp.float32)[:, None, None]
    found = jax.jit(jax.vmap(friction))(batch)
    assert (found.dtype, found.shape) == (jnp.float32, (3, len(geoms.pairs), 5))
    np.testing.assert_allclose(found[0], pair_parameters(geoms, geoms.pairs).friction, rtol=1e-6)


def test_no_pairs_other_pairs_and_their_order() -> None:
    geoms = rb.load(mujoco.MjModel.from_xml_string(pile(7))).geoms
    none = pair_parameters(geoms, ())
    assert none.friction.shape == (0, 5) and none.condim == ()
    every = pair_parameters(geoms, geoms.pairs)
    turned = pair_parameters(geoms, [(b, a) for a, b in geoms.pairs])
    np.testing.assert_allclose(every.friction, turned.friction)
    np.testing.assert_allclose(every.solimp, turned.solimp, rtol=1e-14)
    assert every.condim == turned.condim
    shuffled = pair_parameters(geoms, geoms.pairs[::-1])
    names = [x for x in geoms.pairs if geoms.pairs.count(x) == 1]
    for pair in names:
        i = geoms.pairs.index(pair)
        np.testing.assert_array_equal(every.solref[i], shuffled.solref[len(geoms.pairs) - 1 - i])


def test_the_reference_of_tangents() -> None:
    assert tangential_solref((0.02, 1.0), (0.0, 0.0)) == (0.02, 1.0)
    assert tangential_solref((0.02, 1.0), (0.0, -3.0)) == (0.0, -3.0)
    found = jax.jit(tangential_solref)((0.02, 1.0), (0.1, 0.0))
    np.testing.assert_allclose(found, (0.1, 0.0))
