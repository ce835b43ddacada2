"""Scenes of few contacts for tests of impacts."""

import warnings

import numpy as np

import rbjax as rb

FLOOR = '<geom name="floor" type="plane" size="0 0 1"/>'


def load(bodies, gravity=9.81, floor=FLOOR):
    """Load a scene of bodies on a floor, with gravity along -z."""
    return load_text(
        f'<mujoco><option gravity="0 0 {-gravity}"/><worldbody>{floor}{bodies}</worldbody></mujoco>'
    )


def load_text(xml):
    """Load a file whose contacts are left out of the motion."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*left out of the model.*contacts")
        return rb.load(xml, contacts=False)


def ball(radius=0.1, height=0.1, joint='<joint type="slide" axis="0 0 1"/>', mass=1.0):
    """A ball at a height, on a joint."""
    geom = f'<geom type="sphere" size="{radius}" mass="{mass}"/>'
    return f'<body pos="0 0 {height}">{joint}{geom}</body>'


def row(n, radius=0.1, gap=0.01):
    """n equal balls on a line along x, a gap apart."""
    slide = '<joint type="slide" axis="1 0 0"/>'
    geom = f'<geom type="sphere" size="{radius}" mass="1"/>'
    return "".join(
        f'<body pos="{i * (2 * radius + gap)} 0 0">{slide}{geom}</body>' for i in range(n)
    )


def kane_levinson(radius=1e-9):
    """A double pendulum of uniform rods, whose tip strikes the floor; its state before."""
    first, second = np.deg2rad(20), np.deg2rad(30)
    depth = np.cos(first) + np.cos(second) + radius
    rod = (
        '<joint axis="0 -1 0"/><inertial pos="0 0 -0.5" mass="1" '
        'diaginertia="0.08333333333333333 0.08333333333333333 1e-6"/>'
    )
    tip = f'<geom name="tip" type="sphere" size="{radius}" pos="0 0 -1" mass="0"/>'
    model = load(
        f'<body>{rod}<body pos="0 0 -1">{rod}{tip}</body></body>',
        floor=f'<geom name="floor" type="plane" size="0 0 1" pos="0 0 {-depth}"/>',
    )
    return model, rb.State(np.array([first, second - first]), np.array([-0.1, -0.1]))
