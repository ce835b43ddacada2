"""`read_recording` on tables of many kinds, and on measured data where it is there."""

from pathlib import Path

import numpy as np
import pytest
from scipy import io

import rbjax as rb
from rbjax.sysid import Channel, Column, Recording, findings, read_recording, split

DATA = Path(__file__).parents[3] / "shared" / "data"  # beside the repository
WANTED = {"a": ("q", "hip", "deg"), "b": Column("q", "knee", "deg", sign=-1), "i": ("tau", "hip")}


def data(*parts: str) -> Path:
    path = DATA.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"no measured data: {path.name} is not beside the repository")
    return path


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("t,a,b,i\n0,90,180,1\n0.5,45,90,2\n1,0,-90,3\n", {}),
        ("t\ta\tb\ti\n0\t90\t180\t1\n0.5\t45\t90\t2\n1\t0\t-90\t3\n", {}),
        ("t a b i\n0 90   180 1\n0.5 45 90 2\n1 0 -90 3\n", {}),
        ("# x\nTime;A;B;I;\nms;deg;deg;A;\nt;a;b;i;\n0;90;180;1;\n500;45;90;2;\n1000;0;-90;3;\n",
         {"time_unit": "ms"}),
        ("t;a;b;i\n0;90;180;1\n0,5;45;90;2\n\n1;0;-90;3\n", {"decimal": ","}),
        ("i,b,a\n1,180,90\n2,90,45\n3,-90,0\n", {"rate": 2}),
    ],
)  # fmt: skip
def test_tables(tmp_path, text, options):
    (tmp_path / "run.csv").write_text(text)
    run = read_recording(tmp_path / "run.csv", WANTED, **options)
    np.testing.assert_allclose(run["q"].t, [0, 0.5, 1], rtol=1e-15)
    expected = np.pi * np.array([[0.5, -1], [0.25, -0.5], [0, 0.5]])
    np.testing.assert_allclose(run["q"].values, expected, rtol=1e-15)
    assert run.name == "run" and run["q"].names == ("hip", "knee")
    assert run["tau"].values.ravel().tolist() == [1, 2, 3]


def test_sensors_at_several_rates_share_a_table(tmp_path):
    (tmp_path / "run.csv").write_text(
        "t,a,b,i\n0,1,2,5\n1,2,3,\n2,nan,4,6\n3,5,6,\n4,7,8,7\n5,,,\n"
    )
    run = read_recording(tmp_path / "run.csv", WANTED)
    assert run["q"].t.tolist() == [0, 1, 2, 3, 4] and run["tau"].t.tolist() == [0, 2, 4]
    assert np.argwhere(~run["q"].arrived).tolist() == [[2, 0]]


def test_what_is_wrong_with_a_table_is_named(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("t,a,b,i\n0,1,2,3\n1,2,x,4\n")
    with pytest.raises(rb.InputError, match="line 3, column b: got 'x', expected a number"):
        read_recording(path, WANTED)
    with pytest.raises(rb.UnknownName, match=r"column of run.csv 'c'; .* 't', 'a', 'b', 'i'"):
        read_recording(path, {"c": ("q",)})
    with pytest.raises(rb.UnknownName, match=r"column of run.csv 'time'"):
        read_recording(path, {"a": ("q",)}, time="time")
    with pytest.raises(rb.InputError, match=r"no file .*there are: run\.csv"):
        read_recording(tmp_path / "ran.csv", WANTED)
    with pytest.raises(rb.InputError, match=r"columns is \{\}, expected a dict such as"):
        read_recording(path, {})
    with pytest.raises(rb.InputError, match=r"columns\['a'\] is 'q', expected a Column"):
        read_recording(path, {"a": "q"})
    with pytest.raises(rb.UnknownName, match="unit 'degrees'"):
        read_recording(path, {"a": ("q", "hip", "degrees")})
    path.write_text("t,a\n0,1\n0,2\n")
    with pytest.raises(rb.InputError, match=r"run, sensor q: .* clock stands still at sample 1"):
        read_recording(path, {"a": ("q",)})
    np.savez(tmp_path / "run.npz", t=np.arange(3), a=np.ones((3, 2)), n=["x"], rate=3.0)
    with pytest.raises(rb.UnknownName, match=r"array of run.npz 'c'; .* 't', 'a', 'n', 'rate'"):
        read_recording(tmp_path / "run.npz", {"c": ("q",)})
    for name in ("n", "rate"):
        with pytest.raises(rb.InputError, match=f"array {name} of run.npz has dtype"):
            read_recording(tmp_path / "run.npz", {name: ("q",)})
    with pytest.raises(rb.InputError, match="a has 2 columns, expected 1"):
        read_recording(tmp_path / "run.npz", {"a": ("q", "hip")})


def test_arrays_with_clocks_of_their_own(tmp_path):
    path = tmp_path / "run.npz"
    np.savez(path, t=np.arange(5), q=np.ones((5, 2)), ti=np.arange(0, 5, 0.5), w=np.ones((10, 3)))
    run = read_recording(path, {
        "q": ("q",), "w": Column("gyro:imu", time="ti", unit="deg/s", noise=0.1),
    })  # fmt: skip
    assert run["q"].names == ("q[0]", "q[1]") and run["gyro:imu"].t[1] == 0.5
    assert run["gyro:imu"].noise.tolist() == [0.1] * 3


def test_double_pendulum_of_dfki():
    path = data("dfki_double_pendulum", "design_A.0", "20220815", "sys_id", "trajectory_00.npz")
    sensors = {"pos_meas": "q", "vel_meas": "v", "tau_meas": "tau", "tau_con": "ctrl"}
    columns = {f"{n}{k}": (s, f"joint{k}") for n, s in sensors.items() for k in (1, 2)}
    run = read_recording(path, columns, time="time")
    assert run["q"].values.shape == (4997, 2) and 0.0019 < run["q"].step < 0.0021
    assert not [f for f in findings(run) if f.kind in ("velocity", "still", "stuck")]
    flipped = columns | {"vel_meas2": Column("v", "joint2", sign=-1)}
    found = [
        f for f in findings(read_recording(path, flipped, time="time")) if f.kind == "velocity"
    ]
    assert [f.column for f in found] == ["joint2"] and "wrong sign" in str(found[0])


def test_go2_in_the_air():
    path = data("go2_in_air", "traj_0.npz")
    columns = {"position_rad": ("q", "joint_names"), "command_rad": ("ctrl", "joint_names")}
    run = read_recording(path, columns, rate=200)
    with pytest.warns(UserWarning, match="joint limits"):
        run.check_model(rb.load(str(path.with_name("go2_in_air.xml")), contacts=False))
    assert run["q"].names[1] == "FL_thigh_joint" and run.end == 4697 / 200
    assert not findings(run)


def test_multi_arm_pendulum():
    path = data("multiarm_pendulum", "SinglePendulumDataForParameterEstimation.mat")
    pieces = [y.T for y in io.loadmat(path)["Y_id"][:, 0]]
    t = [np.arange(len(y)) / 1000 for y in pieces]
    runs = [
        Recording(f"swing {k}", {n: Channel(s, x, ["arm"]) for n, x in zip("qv", y.T, strict=True)})
        for k, (s, y) in enumerate(zip(t, pieces, strict=True))
    ]
    assert [len(p) for p in split(runs, 0.5, 0.25, 0.25)] == [2, 1, 1]
    assert not [f for run in runs for f in findings(run) if f.kind != "outliers"]


def test_robotino_motors():
    folder = data("robotino_omni_slip", "dc_motor_model_identification")
    path = folder / "data_for_identification_with_integral.csv"
    columns = {f"m{k}vel": ("v", f"wheel{k}", "rad/s", 1 / 16) for k in (1, 2, 3)}
    run = read_recording(path, columns | {"m1setvel": ("ctrl", "motor1")}, time_unit="ms")
    assert 0.02 < run["v"].step < 0.04 and run["v"].values.shape[1] == 3
