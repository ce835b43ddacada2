"""`Channel`, `Recording` and `split`: units, clocks, samples that did not arrive, pieces."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rbjax as rb
from rbjax.sysid import Channel, Recording, split
from rbjax.sysid.data import in_si
from rbjax.sysid.data.units import UNITS

T = np.arange(200) / 100
SWING = np.stack([np.sin(3 * T), np.cos(2 * T)], 1)


def run(**channels):
    return Recording("run", channels or {"q": Channel(T, SWING, ("hip", "knee"))})


def test_units_signs_and_scales_are_said_once():
    seen = Channel(
        T, SWING, ("hip", "knee"), unit=("deg", "rpm"), sign=(1, -1), scale=(1, 2), noise=(1, 2)
    )
    expected = SWING * [np.pi / 180, -2 * 2 * np.pi / 60]
    np.testing.assert_allclose(seen.values, expected, rtol=1e-15)
    current = Channel(T, SWING[:, 0], unit="mA", scale=0.05)  # 0.05 N m/A
    np.testing.assert_allclose(current.values[:, 0], SWING[:, 0] * 5e-5, rtol=1e-15)
    assert in_si("rev") == 2 * in_si("rad") * np.pi and len(UNITS) > 30


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"t": np.append(T[:-1], T[-2])}, r"stands still at sample 199 \(t = 1.98 s"),
        ({"t": np.where(T[50] == T, 0.1, T)}, r"goes back at sample 50 \(t = 0.49 s, then 0.1 s"),
        ({"t": np.where(T[7] == T, np.nan, T)}, "t is nan at sample 7"),
        ({"values": np.where(SWING[3, 1] == SWING, np.nan, SWING)}, "knee is nan at sample 3 "),
        ({"values": np.where(SWING[3, 1] == SWING, np.inf, SWING), "dropped": "nan"}, "is inf at"),
    ],
)
def test_what_is_wrong_with_a_channel_is_named(given, message):
    with pytest.raises(rb.InputError, match=message):
        Channel(**({"t": T, "values": SWING, "names": ("hip", "knee")} | given))
    with pytest.raises(rb.UnknownName, match=r"unit 'grad'; known names: .*'deg'"):
        Channel(T, SWING, unit="grad")


def test_what_is_wrong_with_a_recording_is_named():
    seen = Channel(T, SWING)
    with pytest.raises(rb.InputError, match="no channels"):
        Recording("run", {})
    with pytest.raises(rb.UnknownName, match="unknown sensor 'speed'; known names"):
        run(speed=seen)
    with pytest.raises(rb.InputError, match="gyro:imu has 2 columns, expected 3"):
        run(**{"gyro:imu": seen})
    with pytest.raises(rb.InputError, match="channel ctrl begins at 5 s, after channel q has"):
        run(q=seen, ctrl=Channel(T + 5, SWING))
    with pytest.raises(rb.UnknownName, match="channel of recording run 'tau'"):
        run()["tau"]


def test_channels_suit_the_model():
    model = rb.load("double_pendulum")
    first, second = model.joint_names
    run().check_model(model)  # as many as coordinates
    run(q=Channel(T, SWING[:, 0], (second,))).check_model(model)
    with pytest.raises(rb.InputError, match=rf"q has 1 columns \(hip\), expected 2 .*{first}"):
        run(q=Channel(T, SWING[:, 0], ("hip",))).check_model(model)
    with pytest.raises(rb.InputError, match="channel ctrl has 2 columns"):
        run(ctrl=Channel(T, SWING)).check_model(rb.load("pendulum"))
    with pytest.raises(rb.UnknownName, match="body or site of channel pose:hand 'hand'"):
        run(**{"pose:hand": Channel(T, np.ones((200, 7)))}).check_model(model)
    with pytest.raises(rb.UnknownName, match="site of channel gyro:imu 'imu'"):
        run(**{"gyro:imu": Channel(T, np.ones((200, 3)))}).check_model(model)


def test_one_clock_cubic_positions_and_held_commands():
    """Cubic splines err by 5/384 h^4 max|q''''| inside; commands hold."""
    rng = np.random.default_rng(0)
    uneven = np.sort(rng.uniform(0, 2, 400))
    pushes = Channel([-1.0, 0.5, 1.0], [1.0, 2.0, 3.0])
    seen = run(q=Channel(uneven, np.sin(3 * uneven)), ctrl=Channel([*pushes.t, 2.5], [1, 2, 3, 3]))
    t = np.linspace(0.1, 1.9, 181)
    even = seen.on_clock(t)
    h = np.diff(uneven).max()
    assert np.nanmax(np.abs(even["q"].values[:, 0] - np.sin(3 * t))) < 5 / 384 * h**4 * 81 * 10
    np.testing.assert_array_equal(even["ctrl"].values[:, 0], 1.0 + (t >= 0.5) + (t >= 1.0))
    with pytest.raises(rb.InputError, match=r"t is from 0 to 3 s, expected .* where channel q has"):
        seen.on_clock([0.0, 3.0])


def test_attitudes_turn_evenly():
    """A constant angular velocity is exact under slerp; a quaternion and its negative are one."""
    axis = np.array([1.0, 2.0, 2.0]) / 3
    turn = Rotation.from_rotvec(np.outer(T, axis))
    quat = turn.as_quat(scalar_first=True) * np.where(np.arange(200) % 2, 1, -1)[:, None]
    seen = run(**{"pose:hand": Channel(T, np.hstack([np.outer(T, [1, 2, 3]), quat]))})
    t = np.linspace(0.003, 1.5, 77)
    pose = seen.on_clock(t)["pose:hand"].values
    np.testing.assert_allclose(pose[:, :3], np.outer(t, [1, 2, 3]), atol=1e-13)
    moved = Rotation.from_quat(pose[:, 3:], scalar_first=True)
    away = moved * Rotation.from_rotvec(np.outer(t, axis)).inv()
    assert away.magnitude().max() < 1e-12


def test_dropped_samples_are_never_averaged_away():
    lost = np.zeros((200, 2), bool)
    lost[50, 0] = True
    rows = np.r_[0:100, 120:200]  # the log misses 20 rows
    seen = run(q=Channel(T[rows], SWING[rows], dropped=lost[rows]))
    t = T[:-1] + 0.004
    at = seen.on_clock(t)["q"].values
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(at[:, 0])), [49, 50, *range(99, 120)])
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(at[:, 1])), range(99, 120))
    bridged = seen.on_clock(t, gap=0.021)["q"].values  # said: one dropped sample is bridged
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(bridged[:, 0])), range(99, 120))
    assert not seen["q"].drop(T[rows] > 1).arrived[-1].any()
    assert np.isnan(seen.on_clock(T[40:60])["q"].values[10, 0])


def test_pieces():
    pushes = Channel([0.0, 0.25, 1.0, 2.0], [1.0, 2.0, 3.0, 3.0], ("motor",))
    seen = run(q=Channel(T, SWING), ctrl=pushes)
    cut = seen.segment(0.4, 1.2)
    np.testing.assert_allclose(cut["q"].t, T[40:121])
    assert cut["ctrl"].t.tolist() == [0.4, 1.0] and cut["ctrl"].values.ravel().tolist() == [2, 3]
    assert (cut.name, cut.source) == ("run[0.4:1.2]", "run")
    assert [p.name for p in run().segments(0.6)] == ["run[0:0.6]", "run[0.6:1.2]", "run[1.2:1.8]"]
    with pytest.raises(rb.InputError, match="channel q has 0 samples from 3 to 4 s"):
        seen.segment(3, 4)
    with pytest.raises(rb.InputError, match=r"seconds is 9, expected a positive length of at most"):
        seen.segments(9)


def test_split_by_recording():
    runs = [Recording(f"run {k}", run().channels) for k in range(7)]
    parts = split(runs, 0.5, 0.2, 0.3, seed=3)
    assert sorted(r.name for part in parts for r in part) == [r.name for r in runs]
    assert [len(p) for p in parts] == [4, 1, 2]
    again = split(runs, 0.5, 0.2, 0.3, seed=3)
    assert [[r.name for r in p] for p in again] == [[r.name for r in p] for p in parts]
    others = {tuple(r.name for r in split(runs, 0.5, 0.2, 0.3, seed=s).train) for s in range(9)}
    assert len(others) > 1
    pieces = [p for r in runs[:3] for p in r.segments(0.5)]
    used = [{p.source for p in part} for part in split(pieces)]
    assert [len(s) for s in used] == [1, 1, 1] and len(set.union(*used)) == 3
    with pytest.raises(rb.InputError, match=r"1 recordings .run. for 3 parts"):
        split(run().segments(0.5))
    with pytest.raises(rb.InputError, match="add up to 1"):
        split(runs, 0.5, 0.2, 0.2)


@pytest.mark.parametrize("flips", [False, True])
@pytest.mark.parametrize("free", [False, True])
def test_attitudes_of_joints_turn_evenly_on_another_clock(flips, free):
    """Of ball and free joints, with a model and without, and if the sign of a sample flips."""
    t, w = np.arange(0, 1.001, 0.05), 3.0
    q = np.stack([np.cos(w * t / 2), 0 * t, 0 * t, np.sin(w * t / 2)], 1)
    if flips:
        q[10:] *= -1
    values = np.column_stack([t, t**2, -t, q]) if free else q
    model = rb.load("free_body") if free else None
    at = np.arange(0, 1.0, 0.0125)
    want = np.stack([np.cos(w * at / 2), 0 * at, 0 * at, np.sin(w * at / 2)], 1)
    for known in (None, model) if free else (None,):
        moved = Recording("r", {"q": Channel(t, values)}).on_clock(at, model=known)
        found = np.asarray(moved["q"].values)
        quaternion = found[:, -4:]
        np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, rtol=1e-12)
        np.testing.assert_allclose(np.abs((quaternion * want).sum(1)), 1.0, rtol=1e-12)
        if free:
            np.testing.assert_allclose(found[:, 1], at**2, atol=1e-12)


def test_hinges_are_no_attitude():
    """Four angles whose squares do not add up to 1 keep their splines."""
    t = np.arange(0, 1.001, 0.05)
    q = np.stack([t**2, t, 0 * t, 1 - t], 1)
    at = np.arange(0, 1.0, 0.0125)
    moved = Recording("r", {"q": Channel(t, q)}).on_clock(at)
    np.testing.assert_allclose(moved["q"].values[:, 0], at**2, atol=1e-12)
