"""One posture: the drawing is at the position of the robot."""

import inspect

import matplotlib
import matplotlib.colors
import matplotlib.figure
import numpy as np
import pytest

import rbjax as rb
from rbjax.plotting.solid_shapes import _outermost
from rbjax.style import INK, PAPER, is_dark

matplotlib.use("Agg")


def axis():
    return matplotlib.figure.Figure(figsize=(5, 4)).add_subplot()


@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(name, marks=() if name in ("arm7", "quadrotor") else pytest.mark.slow)
        for name in rb.scenes()
    ],
)
@pytest.mark.parametrize("geoms", [False, True])
def test_every_scene(scene: str, geoms: bool) -> None:
    model = rb.load(scene)
    shapes = rb.plotting.solids(scene) if geoms else rb.plotting.skeleton(model)
    ax = rb.plotting.draw(model, model.joints.reference, ax=axis(), source=scene if geoms else None)
    ax.figure.canvas.draw()
    solids = ax.collections[-1]
    assert 0 < len(solids.get_paths()) <= len(shapes)
    assert ax.get_aspect() == 1.0  # equal axes
    for path in solids.get_paths():
        assert np.isfinite(path.vertices).all()
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    points = np.concatenate([path.vertices for path in solids.get_paths()])
    assert left < points[:, 0].min() and points[:, 0].max() < right
    assert low < points[:, 1].min() and points[:, 1].max() < high


def test_a_figure_of_its_own() -> None:
    import matplotlib.pyplot as plt

    ax = rb.plotting.draw(rb.load("pendulum"), [0.5])
    assert ax.figure.axes == [ax]
    plt.close(ax.figure)


@pytest.mark.parametrize("q", [[0.1, 0.2], [np.nan]])
def test_q_of_another_robot(q: list[float]) -> None:
    with pytest.raises(rb.InputError, match=r"expected shape \(1,\) of finite numbers"):
        rb.plotting.draw(rb.load("pendulum"), q, ax=axis())


def test_a_rod_by_its_numbers_is_a_rod() -> None:
    """A uniform rod of length L on a hinge at its end: the ellipsoid and the line reach its tip."""
    model = rb.load(
        "<mujoco><worldbody><body><joint axis='0 1 0'/>"
        "<inertial pos='0 0 -0.6' mass='2' diaginertia='0.24 0.24 1e-9'/>"
        "</body></worldbody></mujoco>"
    )
    shapes = rb.plotting.skeleton(model)
    assert len(shapes) == 3
    ellipsoid, line, _ = shapes
    assert ellipsoid.points[:, 2].min() == pytest.approx(-1.2, abs=1e-3)
    assert ellipsoid.points[:, 2].max() == pytest.approx(0.0, abs=1e-3)
    assert line.points[:, 2].min() == pytest.approx(-1.2, abs=0.03)


def test_limbs_meet_at_their_joints() -> None:
    """Every rod of a skeleton starts and ends where kinematics has a joint or a tip."""
    model = rb.load("arm7")
    R, p = rb.forward_kinematics(model, model.keyframe("home").q)
    on = np.array(model.topology.joint_bodies)
    anchors = np.asarray(p[on] + np.einsum("bij,bj->bi", R[on], model.joints.placement))
    rods = [s for s in rb.plotting.skeleton(model) if s.alpha == 1.0]
    points = np.concatenate([s.points @ np.asarray(R[s.body]).T + p[s.body] for s in rods])
    for anchor in anchors:
        assert np.linalg.norm(points - anchor, axis=1).min() < 0.05


def test_a_body_without_mass_and_a_site() -> None:
    model = rb.load(
        "<mujoco><worldbody><body><freejoint/><geom size='0.1'/>"
        "<body pos='1 0 0'><site name='tip'/></body></body></worldbody></mujoco>"
    )
    ax = rb.plotting.draw(model, model.joints.reference, ax=axis())
    assert len(ax.collections[-1].get_paths()) >= 4  # a ball with axes, a rod to the tip


def test_a_mesh_keeps_its_outermost_points() -> None:
    points = np.random.default_rng(0).normal(size=(5000, 3))
    kept = _outermost(points)
    assert len(kept) < 400
    assert kept.max(0) == pytest.approx(points.max(0)) and kept.min(0) == pytest.approx(
        points.min(0)
    )


def test_solids_at_a_pose() -> None:
    """A move along the line of sight's horizontal moves each patch; `world` counts fixed solids."""
    shapes = rb.plotting.solids("pendulum")

    def drawn(x: float, **options: bool) -> list[np.ndarray]:
        ax = axis()
        place = np.array([[x, 0.0, 1.0]])
        rb.plotting.draw_solids(shapes, np.eye(3)[None], place, ax=ax, shadow=False, **options)
        return [patch.get_path().vertices for patch in ax.patches]

    still, moved = drawn(0.0, world=False), drawn(0.3, world=False)
    assert still and len(still) == len(moved)
    shifts = [b - a for a, b in zip(still, moved, strict=True)]
    for shift in shifts:
        np.testing.assert_allclose(shift, shifts[0][:1].repeat(len(shift), 0), atol=1e-9)
    assert np.abs(shifts[0]).max() > 0.1


def test_later_poses_of_a_strobe_are_stronger() -> None:
    model = rb.load("pendulum")
    ax = axis()
    rb.plotting.strobe(model, np.linspace(0, 1, 3)[:, None], ax=ax, shadow=False)
    strengths = {patch.get_zorder() // 1: patch.get_facecolor()[3] for patch in ax.patches}
    assert strengths[2] < strengths[3] < strengths[4] == 1
    with pytest.raises(rb.RbjaxError):
        rb.plotting.strobe(model, np.zeros((3, 2)), ax=ax)


def test_coordinates_over_time() -> None:
    axes = matplotlib.figure.Figure().subplots(2)
    ts, q, v = np.arange(4.0), np.arange(8.0).reshape(4, 2), np.ones((4, 1))
    rb.plotting.time_plot(ts, q, v, names=["hip"], ax=axes)
    np.testing.assert_array_equal([line.get_ydata() for line in axes[0].lines], q.T)
    assert [len(ax.lines) for ax in axes] == [2, 1]
    assert axes[0].lines[0].get_label() == "hip"


def test_states_are_accepted_for_coordinates() -> None:
    """A picture of states is the picture of their q."""
    model, q, v = rb.load("pendulum"), np.linspace(0, 1, 3)[:, None], np.ones((3, 1))
    states = rb.State(q, v)
    path = rb.Trajectory(np.arange(3.0), q, v, np.array(True))
    for x in (states, path):
        R, _ = rb.plotting.poses(model, x)
        np.testing.assert_array_equal(R, rb.plotting.poses(model, q)[0])
        drawn = rb.plotting.strobe(model, x, ax=axis(), shadow=False).patches
        expected = rb.plotting.strobe(model, q, ax=axis(), shadow=False).patches
        for one, other in zip(drawn, expected, strict=True):
            np.testing.assert_array_equal(one.get_xy(), other.get_xy())
        axes = rb.plotting.time_plot(path.ts, x, ax=[axis(), axis()])
        np.testing.assert_array_equal(axes[1].lines[0].get_ydata(), v[:, 0])
    one = rb.plotting.draw(model, rb.State(q[0], v[0]), ax=axis()).collections[-1]
    other = rb.plotting.draw(model, q[0], ax=axis()).collections[-1]
    for a, b in zip(one.get_paths(), other.get_paths(), strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)


def test_data_come_first_and_the_axis_by_keyword() -> None:
    """In all rooms: no public function takes an axis by position, and None makes a figure."""
    rooms = [getattr(rb, n) for n in rb.__all__ if inspect.ismodule(getattr(rb, n))]
    found = {}
    for room in rooms:
        functions = (getattr(room, n) for n in room.__all__)
        found |= {f.__name__: inspect.signature(f) for f in functions if inspect.isfunction(f)}
    drawn = {name: x.parameters["ax"] for name, x in found.items() if "ax" in x.parameters}
    assert drawn.keys() == {
        "bare", "draw", "draw_solids", "plot_regions", "plot_spectral_radius", "strobe",
        "time_plot", "top_view",
    }  # fmt: skip
    assert all(x.kind is x.KEYWORD_ONLY for x in drawn.values())
    assert all(x.default is None for name, x in drawn.items() if name != "bare")


def test_a_new_figure_has_the_style_of_rbjax() -> None:
    import matplotlib.pyplot as plt

    with plt.style.context("dark_background"):
        axes = rb.plotting.time_plot(np.arange(2.0), np.zeros((2, 1)), np.zeros((2, 1)))
    assert matplotlib.colors.to_hex(axes[0].figure.get_facecolor()) == PAPER
    assert axes[0].xaxis.label.get_color() == INK
    plt.close(axes[0].figure)


def test_what_is_not_an_axis_is_rejected() -> None:
    for ax in (3, [axis()], "gca"):
        with pytest.raises(rb.InputError, match=r"ax is \w+, expected"):
            rb.plotting.time_plot([0.0], [[0.0]], [[0.0]], ax=ax)
        with pytest.raises(rb.InputError, match=r"ax is \w+, expected an axis of matplotlib"):
            rb.plotting.bare(ax=ax)
    with pytest.raises(rb.InputError, match="no polygon and no line"):
        rb.plotting.bare(ax=axis())


@pytest.mark.parametrize("paper, dark", [("#ffffff", False), ("#000000", True), ("none", False)])
def test_pictures_fit_the_background(paper: str, dark: bool) -> None:
    """On a dark figure the ground is dark, and legends have the colour of the labels."""
    figure = matplotlib.figure.Figure(facecolor=paper)
    assert is_dark(figure) == dark
    one, *axes = figure.subplots(3)
    ground = rb.plotting.draw(rb.load("pendulum"), [0.5], ax=one).collections[1]
    assert (ground.get_facecolor()[0, :3].mean() < 0.5) == dark
    axes[0].xaxis.label.set_color("#808080")
    rb.plotting.time_plot([0.0, 1.0], [[0.0]] * 2, [[0.0]] * 2, names=["a"], ax=axes)
    (label,) = axes[0].get_legend().get_texts()
    assert matplotlib.colors.to_hex(label.get_color()) == "#808080"
    assert not axes[0].get_legend().get_frame_on()
