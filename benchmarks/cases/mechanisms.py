"""Mechanisms of the tests, built from bodies and loop joints as a user would."""

import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax import constraints as rc

QUIET = '<default><geom contype="0" conaffinity="0"/></default>'
#: a rod of 1 m and 1 kg along x of its body, thin
ROD = f'<inertial pos="0.5 0 0" mass="1" diaginertia="1e-9 {1 / 12} {1 / 12}"/>'


def pendulum() -> rb.Model:
    """IFToMM A01: a bob of 1 kg in x and z, on a rod of 1 m from the origin."""
    model = rb.load("""<mujoco><option gravity="0 0 -9.81"/><worldbody><body name="bob">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>""")
    ends = rc.Place.on(), rc.Place.on(body="bob")
    return model.with_constraints(rc.Distance(*ends, jnp.array(1.0)))


def four_bars(n: int, joint: type = rc.Spherical) -> tuple[rb.Model, rb.State]:
    """IFToMM A02: n + 1 upright rods on the ground, 1 m apart, n rods across their tips; upright,
    with 1 rad/s. Rod and coupler k are a chain, closed to rod k + 1 by a joint."""
    upright = 'xyaxes="0 0 1 0 1 0"'  # the rod's x is up, its y axis that of the hinge
    bodies = ""
    for k in range(n + 1):
        across = (
            f'<body name="coupler{k}" pos="1 0 0" xyaxes="0 0 -1 0 1 0">'
            f'<joint axis="0 1 0"/>{ROD}</body>'
        )
        bodies += (
            f'<body name="rod{k}" pos="{k} 0 0" {upright}><joint name="rod{k}" axis="0 1 0"/>'
            f"{ROD}{across if k < n else ''}</body>"
        )
    model = rb.load(
        f'<mujoco><option gravity="0 0 -9.81"/><worldbody>{bodies}</worldbody></mujoco>'
    )
    loops = [
        joint.between(model, f"coupler{k}", f"rod{k + 1}", point=[k + 1, 0, 1], axis=[0, 1, 0])
        for k in range(n)
    ]
    v = [x for k in range(n + 1) for x in ([1.0, -1.0] if k < n else [1.0])]
    start = model.default_state().replace(v=jnp.array(v))
    return model.with_constraints(*loops), start


def tilted_four_bar(tilt: str) -> rb.Model:
    """Three unequal bodies, hinged in a plane; closed in space: five rows of rank two."""
    bar = '<joint name="{0}" axis="0 1 0"/><geom size="0.05" pos="{1}" mass="{2}"/>'
    model = rb.load(
        f'<mujoco>{QUIET}<worldbody><body pos="0.1 0.2 1" quat="{tilt}">'
        f'<body name="crank">{bar.format("a", "0.1 0 0.2", 1)}'
        f'<body name="coupler" pos="0.2 0 0.4">{bar.format("b", "0.4 0 0.1", 2)}'
        f'<body name="rocker" pos="0.8 0 0.2">{bar.format("c", "0 0 -0.3", 1.5)}'
        "</body></body></body></body></worldbody></mujoco>"
    )
    R, p = rb.forward_kinematics(model, model.default_state().q)
    rocker = model.body("rocker")
    end = p[rocker] + R[rocker] @ jnp.array([0.1, 0.0, -0.7])
    axis = R[rocker] @ jnp.array([0.0, 1.0, 0.0])
    joint = rc.Revolute.between(model, "rocker", None, point=end, axis=axis)
    return model.with_constraints(joint)


def spatial_slider_crank() -> tuple[rb.Model, rb.State]:
    """IFToMM: a crank about x, a slider along x, and a free rod between them, on a ball at the
    crank and on a universal joint at the slider."""
    d = np.array([0.2, -0.1, -0.2]) / 0.3  # along the rod, from the crank to the slider
    J = 4e-3 * np.eye(3) - 3.6e-3 * np.outer(d, d)
    inertia = " ".join(str(J[i]) for i in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    model = rb.load(f"""<mujoco><option gravity="0 0 -9.81"/><worldbody>
      <body name="crank" pos="0 0.1 0.12"><joint name="crank" axis="1 0 0"/>
        <inertial pos="0 0 0.04" mass="0.12" diaginertia="1e-4 1e-4 1e-5"/></body>
      <body name="slider" pos="0.2 0 0"><joint name="slider" type="slide" axis="1 0 0"/>
        <inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/></body>
      <body name="rod" pos="0.1 0.05 0.1"><freejoint/>
        <inertial pos="0 0 0" mass="0.5" fullinertia="{inertia}"/></body>
    </worldbody></mujoco>""")
    ball = rc.Spherical.between(model, "crank", "rod", point=[0, 0.1, 0.2])
    across = np.cross([1.0, 0, 0], d)
    ends = rc.Place.on(body="slider"), rc.Place.on(body="rod", point=0.15 * d, axis=across)
    w = np.array([1.92, -0.96, 0.48])
    ball_velocity = np.array([0.0, -0.48, 0.0])
    middle = ball_velocity + np.cross(w, 0.15 * d)
    start = model.default_state().replace(v=jnp.array([6.0, 0.24, *middle, *w]))
    return model.with_constraints(ball, rc.Universal(*ends)), start


def andrews(p: dict, q0: list, loop: type = rc.Spherical) -> tuple[rb.Model, rb.State]:
    """Andrews' squeezing mechanism: seven planar bodies in four chains that meet at E."""

    def body(name, k, at, com, inside=""):
        m, i = p[f"m{k}"], p[f"i{k}"]
        return (
            f'<body name="{name}" pos="{at[0]} {at[1]} 0"><joint name="{name}" axis="0 0 1"/>'
            f'<inertial pos="{com[0]} {com[1]} 0" mass="{m}" diaginertia="{i} {i} {i}"/>'
            f"{inside}</body>"
        )

    k2 = body("K2", 2, (p["rr"], 0), (-p["da"], 0))
    k4 = body("K4", 4, (p["zt"], 0), (0, p["ea"] - p["e"]))
    k6 = body("K6", 6, (0, -p["u"]), (p["zf"] - p["fa"], 0))
    model = rb.load(f"""<mujoco><option gravity="0 0 0"/><worldbody>
      {body("K1", 1, (0, 0), (p["ra"], 0), k2)}
      {body("K3", 3, (p["xb"], p["yb"]), (p["sb"], -p["sa"]))}
      {body("K5", 5, (p["xa"], p["ya"]), (p["ta"], p["tb"]), k4)}
      {body("K7", 7, (p["xa"], p["ya"]), (p["ua"], p["ub"]), k6)}
    </worldbody></mujoco>""")
    on = rb.forces.Place.on
    ends = on(point=[p["xc"], p["yc"], 0]), on(body="K3", point=[p["sd"], -p["sc"], 0])
    spring = rb.forces.PointSpring.of(*ends, stiffness=p["c0"], length=p["l0"])
    E = {"K2": (-p["d"], 0), "K3": (0, -p["ss"]), "K4": (0, -p["e"]), "K6": (p["zf"], 0)}
    places = {name: rc.Place.on(body=name, point=[*at, 0]) for name, at in E.items()}
    loops = [loop(places[name], places["K2"]) for name in ("K3", "K4", "K6")]
    model = model.with_forces(spring).with_constraints(*loops)
    order = [int(name[1]) - 1 for name in model.joint_names]  # of K1 ... K7, as the figures are
    return model, model.default_state().replace(q=jnp.array(q0)[np.array(order)])


def walker(legs: list[float], pelvis: str) -> tuple[rb.Model, rb.State]:
    """A pelvis on a joint, with legs at these y, each a loop in space: a thigh and a shank on
    hinges, and from the pelvis a rod on a ball, its tip on a ball of the shank. No two are alike.
    """
    bodies = "".join(
        f"""<body name="thigh{k}" pos="0 {y} -0.1"><joint name="hip{k}" axis="0.1 1 {y}"/>
          <geom type="capsule" size="0.04" fromto="0 0 0 0 0 -0.4" mass="3"/>
          <body name="shank{k}" pos="0 0 -0.4"><joint name="knee{k}" axis="0 1 0.2"/>
            <geom type="capsule" size="0.03" fromto="0 0 0 0.1 0 -0.4" mass="2"/></body></body>
        <body name="rod{k}" pos="0.15 {y} -0.1"><joint name="rod{k}" type="ball"/>
          <geom type="capsule" size="0.02" fromto="0 0 0 0.02 0.01 -0.45" mass="0.5"/></body>"""
        for k, y in enumerate(legs)
    )
    model = rb.load(
        f'<mujoco>{QUIET}<worldbody><body name="pelvis" pos="0 0 1">{pelvis}'
        f'<geom type="box" size="0.1 0.2 0.1" mass="10"/>{bodies}</body></worldbody></mujoco>'
    )
    loops = [
        rc.Spherical(
            rc.Place.on(body=f"rod{k}", point=[0.02, 0.01, -0.45]),
            rc.Place.on(body=f"shank{k}", point=[0.17, 0.01, -0.05]),
        )
        for k in range(len(legs))
    ]
    return model.with_constraints(*loops), model.default_state()


def biped() -> tuple[rb.Model, rb.State]:
    """Two legs on a free pelvis."""
    return walker([0.1, -0.15], "<freejoint/>")
