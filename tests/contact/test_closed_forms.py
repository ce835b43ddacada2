"""MuJoCo's contact law against closed forms, to 1e-3 at a step of 1 ms and at order 1."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests import oracles
from tests.contact.closed_forms import PLANAR, ROLLING, Body, G, Touch, load, load_text, mover

ORACLE = oracles.load("contact")
SLIDE_X, SLIDE_Z = (f'<joint type="slide" axis="{x}"/>' for x in ("1 0 0", "0 0 1"))
OFF = 'contype="0" conaffinity="0"'


def check(run, v, time, errors_of, converging=()):
    """Compare with closed forms: errors_of(q, v) -> relative errors by name. Each is at most 1e-3
    at 1 ms. The errors of `converging` decrease with the step, an eighth, at least by 3."""
    coarse, fine = (
        {name: abs(float(x)) for name, x in errors_of(np.asarray(s.q), np.asarray(s.v)).items()}
        for s in (run(v, dt, time) for dt in (1e-3, 1.25e-4))
    )
    for name, error in coarse.items():
        assert error < 1e-3, name
        assert fine[name] < 1e-3, name
    for name in converging:
        assert fine[name] < coarse[name] / 3, name


def test_rest_creep_and_stopping_of_a_point():
    """Penetration at rest, creep on a ramp, a sliding block and a brick that is pushed."""
    slope, mu, force, until = np.deg2rad(10), 0.5, 10.0, 1.0
    bodies = [
        Body(Touch()),
        Body(Touch(solref="-10000 -200")),
        Body(Touch(1.0), slope=slope),
        Body(Touch(mu)),
        Body(Touch(mu)),
    ]
    d, t, model = 0.9, 0.02, load(bodies)
    push = np.arange(model.nv) == 8
    run = mover(model, tau=lambda now: push * np.float64(force) * (now < until - 1e-9))

    def errors(q, v):
        return {
            "rest": -q[1] / (G * (1 - d) * t**2) - 1,
            "rest, direct": -q[3] / (G * (1 - d) / 1e4) - 1,
            "creep": v[4] / (G * np.sin(slope) * (1 - d) * d * t / (2 * d)) - 1,
            "block": q[6] / (25 / (2 * mu * G)) - 1,
            "brick": q[8] / ((force - mu * G) * force * until**2 / (2 * mu * G)) - 1,
        }

    start = np.zeros(model.nv)
    start[6] = 5.0
    check(run, start, 2.5, errors, ["block"])


def test_creep_of_a_pyramid():
    """Edges of a pyramid have the factor 1 + mu^2, and impratio divides the creep."""
    slope, mu, d, t = np.deg2rad(10), 1.0, 0.9, 0.02
    model = load([Body(Touch(mu), slope=slope)], cone="pyramidal", impratio=10)
    creep = G * np.sin(slope) * (1 - d) * d * t / (2 * d * 10) * (1 + mu**2)
    check(mover(model), np.zeros(2), 1.0, lambda q, v: {"creep": v[0] / creep - 1})


def test_rolling_and_tipping():
    """A ball that slides and rolls, balls on a ramp that stick and slip, boxes about to tip."""
    slope, v0, time, mu, slip = np.deg2rad(30), 3.0, 1.5, 0.3, 0.1

    def hard(mu):
        return Touch(mu, solimp="0.99 0.99 0.001 0.5 2")

    def box(part):
        geom = 'type="box" size="0.05 0.05 0.1" mass="1"'
        return Body(hard(2.0), ROLLING, geom, slope=np.arctan(0.5 * part))

    bodies = [
        Body(hard(mu), ROLLING),
        Body(hard(mu), ROLLING, slope=slope),
        Body(hard(slip)._replace(solreffriction="0 -10"), ROLLING, slope=slope),
        box(0.998),
        box(1.002),
    ]
    a = G * (np.sin(slope) - slip * np.cos(slope))
    spin = 5 * slip * G * np.cos(slope) / (2 * 0.1)

    def errors(q, v):
        assert abs(q[11]) < 1e-3 and q[14] > 1.0  # the half sizes have the ratio 0.5
        return {
            "x of slide and roll": q[0] / (5 * v0 * time / 7 + 2 * v0**2 / (49 * mu * G)) - 1,
            "v of slide and roll": v[0] / (5 * v0 / 7) - 1,
            "stick on a ramp": v[3] / (5 / 7 * G * np.sin(slope) * time) - 1,
            "slip on a ramp": v[6] / (a * time) - 1,
            "x of slip": q[6] / (a * time**2 / 2) - 1,
            "spin of slip": v[8] / (spin * time) - 1,
        }

    model = load(bodies)
    start = np.zeros(model.nv)
    start[0] = v0
    check(mover(model), start, time, errors, ["x of slip"])


@pytest.mark.parametrize("case", ORACLE["restitution_direct_solref"]["values"])
def test_restitution_and_oblique_impacts(case):
    """A ball without gravity, and balls with spin whose tangential impulse is mu times the normal
    one or ends the slip."""
    scale = 50.0  # the stiffness over its square and the damping over it: e is the same
    solref = f"{-case['stiffness'] / scale**2} {-case['damping'] / scale}"
    ball = 'type="sphere" size="100" mass="1"'
    bodies = [
        Body(Touch(condim=1, solref=solref), SLIDE_Z, height=0.3),
        Body(Touch(0.2, solref, solreffriction="0 -200"), ROLLING, ball, height=100.3),
        Body(Touch(0.9, solref, solreffriction="0 -200"), ROLLING, ball, height=100.3),
    ]
    start = np.array([-1, 3.0, -1, 0.01, 0.5, -1, -0.01])

    def errors(q, v):
        e = v[5]
        slip, stick = start[1] - 100 * start[3], start[4] - 100 * start[6]
        tangential = 0.2 * (1 + v[2])
        return {
            "e": v[0] / case["e"] - 1,
            "v of slip": v[1] / (start[1] - tangential) - 1,
            "spin of slip": v[3] / (start[3] + 5 / 200 * tangential) - 1,
            "v of stick": (v[4] - (start[4] - 2 / 7 * stick)) / stick,
            "spin of stick": (v[6] - (start[6] + 5 / 700 * stick)) * 100 / stick,
            "slip": max(0.0, 3.5 * tangential - slip),
            "stick": max(0.0, stick - 3.5 * 0.9 * (1 + e)),
        }

    check(mover(load(bodies, gravity="0 0 0")), start, 3.0, errors, ["e"])


def test_wedge_cradle_and_bounce():
    """A ball on a wedge that moves, three balls in a row, and a ball that falls and bounces."""
    tilt, M, m, h, k, c, d, time = 0.5, 2.0, 1.0, 20.0, 100.0, 2.0, 0.9, 3.5
    up = 0.2 * np.array([np.sin(tilt), np.cos(tilt)])
    solimp = f'condim="1" solimp="{d} {d} .001 .5 2"'
    world = (
        f'<body>{SLIDE_X}<geom name="w" type="box" size="50 1 .1" euler="0 {tilt} 0" mass="{M}" '
        f'{OFF}/></body><body pos="{up[0]} 0 {up[1]}">{PLANAR}<geom name="b" size=".1" '
        f'mass="{m}" {OFF}/></body><geom name="f" type="plane" size="0 0 1" {OFF}/>'
        f'<body pos="0 9 {h + 0.1}">{SLIDE_Z}<geom name="z" size=".1" mass="1" {OFF}/></body>'
    )
    pairs = f'<pair geom1="w" geom2="b" {solimp}/>'
    pairs += f'<pair geom1="f" geom2="z" {solimp} solref="{-k} {-c}"/>'
    for i in range(3):
        ball = f'<geom name="c{i}" size=".1" mass="1" {OFF}/>'
        world += f'<body pos="{0.4 * i} 5 0">{SLIDE_X}{ball}</body>'
        if i:
            pairs += f'<pair geom1="c{i - 1}" geom2="c{i}" {solimp} solref="-4000 0"/>'
    fall = solve_ivp(falling(k / d, c / d, d), (0, time), [h, 0.0], rtol=1e-9, max_step=2e-3)
    D = M + m * np.sin(tilt) ** 2

    def errors(q, v):
        along = (v[1] - v[0]) * np.cos(tilt) - v[2] * np.sin(tilt)
        return {
            "wedge": v[0] / (m * G * np.sin(tilt) * np.cos(tilt) / D * time) + 1,
            "block": along / ((M + m) * G * np.sin(tilt) / D * time) - 1,
            "bounce": (q[3] + h - fall.y[0, -1]) / h,
            "cradle": np.abs(v[4:7] - [0, 0, 1]).max(),
        }

    model = load_text(world, pairs)
    start = np.zeros(model.nv)
    start[4] = 1.0
    check(mover(model), start, time, errors, ["bounce", "cradle"])


def falling(k, c, d):
    """Return the rates of a mass over a soft floor: a = d a_ref - (1 - d) g while it is pushed."""

    def rates(t, y):
        z, v = y
        push = d * (G - k * z - c * v) if z < 0 else 0.0
        return [v, max(push, 0.0) - G]

    return rates
