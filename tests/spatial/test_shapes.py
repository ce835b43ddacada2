"""Shapes: MuJoCo's own inertias, closed forms, fine meshes, derivatives in the dimensions."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rbjax import spatial
from rbjax.errors import InputError
from rbjax.rotations import se3, so3
from rbjax.spatial import shapes
from tests.tolerances import F64_ROUNDING, GRADIENT, relative_error

RHO = 700.0


def of_mujoco(geom: str, asset: str = "") -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass and inertia about it in the body's axes."""
    xml = f"""<mujoco><asset>{asset}</asset><worldbody><body><freejoint/>
      <geom density="{RHO}" {geom}/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, model.body_iquat[1])
    R = R.reshape(3, 3)
    inertia = R @ np.diag(model.body_inertia[1]) @ R.T
    return model.body_mass[1], model.body_ipos[1], inertia


def close(got, want, tolerance=F64_ROUNDING) -> None:
    for a, b, what in zip(got, want, ("mass", "com", "inertia"), strict=True):
        error = relative_error(a, b, floor=max(1e-3, float(np.max(np.abs(b)))))
        assert error <= tolerance, what


@pytest.mark.parametrize(
    ("ours", "geom"),
    [
        (lambda: shapes.box([0.2, 0.4, 0.6], density=RHO), 'type="box" size="0.1 0.2 0.3"'),
        (lambda: shapes.sphere(0.3, density=RHO), 'type="sphere" size="0.3"'),
        (lambda: shapes.cylinder(0.2, 1.0, density=RHO), 'type="cylinder" size="0.2 0.5"'),
        (lambda: shapes.capsule(0.2, 1.0, density=RHO), 'type="capsule" size="0.2 0.5"'),
        (
            lambda: shapes.ellipsoid([0.1, 0.2, 0.3], density=RHO),
            'type="ellipsoid" size="0.1 0.2 0.3"',
        ),
    ],
    ids=["box", "sphere", "cylinder", "capsule", "ellipsoid"],
)
def test_as_in_mujoco(ours, geom) -> None:
    close(ours(), of_mujoco(geom))


def icosphere(times: int) -> tuple[np.ndarray, np.ndarray]:
    """A unit octahedron, each triangle cut in four and pushed out to the sphere, `times` over."""
    v = [np.array(x, float) for x in np.vstack([np.eye(3), -np.eye(3)])]
    f = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)]
    for _ in range(times):
        middles: dict[tuple[int, int], int] = {}

        def middle(i, j, middles=middles):
            key = (min(i, j), max(i, j))
            if key not in middles:
                m = v[i] + v[j]
                middles[key] = len(v)
                v.append(m / np.linalg.norm(m))
            return middles[key]

        fine = []
        for a, b, c in f:
            ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
            fine += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        f = fine
    return np.array(v), np.array(f)


def test_meshes_as_in_mujoco() -> None:
    v, f = icosphere(1)
    v = v * [0.2, 0.3, 0.5] + [0.3, -0.1, 0.2]
    v[:, 0] += 0.2 * v[:, 1] * v[:, 2]  # no plane of symmetry left
    asset = '<mesh name="m" inertia="exact" vertex="{}" face="{}"/>'.format(
        " ".join(f"{x:.17g}" for x in v.ravel()), " ".join(map(str, f.ravel()))
    )
    mass, com, inertia = of_mujoco('type="mesh" mesh="m"', asset)
    # MuJoCo keeps vertices in f32
    close(shapes.mesh(v, f, density=RHO), (mass, com, inertia), 1e-6)


def test_a_box_of_triangles_is_a_box() -> None:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    squares = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in squares for t in ((a, b, c), (a, c, d))])
    size, at = np.array([0.2, 0.5, 0.9]), np.array([10.0, -20.0, 30.0])
    got = shapes.mesh(corners * size + at, triangles, density=RHO)
    want = shapes.box(size, density=RHO)
    # far from the origin: 30 m of 0.2 lose two digits
    close(got, want._replace(com=at + size / 2), 1e-12)
    weighed = shapes.mesh(corners * size, triangles, mass=3.0)
    close(weighed, shapes.box(size, mass=3.0)._replace(com=size / 2))


def test_finer_meshes_of_an_ellipsoid_tend_to_it_quadratically() -> None:
    axes = np.array([0.5, 1.0, 1.5])
    want = shapes.ellipsoid(axes, density=1.0)
    errors = []
    for times in (2, 3, 4):
        v, f = icosphere(times)
        got = shapes.mesh(v * axes, f, density=1.0)
        errors.append(
            [
                float(relative_error(got.mass, want.mass)),
                float(relative_error(got.inertia, want.inertia)),
            ]
        )
    ratios = np.array(errors)[:-1] / np.array(errors)[1:]
    assert np.all(np.abs(ratios - 4) < 0.3), ratios


def test_closed_forms_agree_with_each_other() -> None:
    r, l = 0.3, 1.2
    # a capsule is a cylinder and two half balls, which are a ball cut through the middle
    half = 2 / 3 * np.pi * r**3
    ball_axis, ball_across = 2 / 5 * r * r, 2 / 5 * r * r - (3 / 8 * r) ** 2
    parts = [shapes.cylinder(r, l, density=1.0)]
    for side in (-1, 1):
        com = jnp.array([0.0, 0.0, side * (l / 2 + 3 / 8 * r)])
        I = jnp.diag(jnp.array([ball_across, ball_across, ball_axis])) * half
        parts.append(spatial.MassProperties(jnp.array(half), com, I))
    close(shapes.capsule(r, l, density=1.0), shapes.combine(parts))
    # a tube is a cylinder with a hole; a thin one is a rod; a plate is a flat box
    bored = [shapes.cylinder(0.5, l, density=2.0), shapes.hole(shapes.cylinder(r, l, density=2.0))]
    close(shapes.tube(0.5, r, l, density=2.0), shapes.combine(bored))
    close(shapes.rod(l, mass=2.0), shapes.cylinder(1e-9, l, mass=2.0))
    close(shapes.plate([0.3, 0.4], mass=2.0), shapes.box([0.3, 0.4, 1e-9], mass=2.0))
    close(shapes.rod(l, density=2.0), shapes.rod(l, mass=2.0 * l))


def test_a_cone_is_its_slices() -> None:
    r, h = 0.4, 1.1
    z, w = np.polynomial.legendre.leggauss(8)  # exact for polynomials of degree 15
    z, w = (z + 1) * h / 2, w * h / 2
    radius = r * (1 - z / h)
    m = np.pi * radius**2 * w
    centre = (m * z).sum() / m.sum()
    across = (m * (radius**2 / 4 + (z - centre) ** 2)).sum()
    want = (m.sum(), [0, 0, centre], np.diag([across, across, (m * radius**2 / 2).sum()]))
    close(shapes.cone(r, h, density=1.0), want)


def test_clouds_and_compositions_are_sums_over_particles() -> None:
    rng = np.random.default_rng(5)
    x, m = rng.normal(size=(20, 3)), rng.uniform(0.1, 1, 20)
    com = m @ x / m.sum()
    r = x - com
    inertia = sum(k * (a @ a * np.eye(3) - np.outer(a, a)) for k, a in zip(m, r, strict=True))
    want = (m.sum(), com, inertia)
    close(shapes.points(x, m), want)
    close(shapes.combine([shapes.points(x[:9], m[:9]), shapes.points(x[9:], m[9:])]), want)
    T = se3.exp(rng.normal(size=6))
    moved = x @ np.asarray(T[:3, :3]).T + np.asarray(T[:3, 3])
    close(spatial.transform_properties(T, *shapes.points(x, m)), shapes.points(moved, m))


def drilled(x: jax.Array) -> spatial.MassProperties:
    """A box with an oblique hole, of seven dimensions."""
    T = se3.pose(so3.exp(x[4:7] / 5), x[4:7] / 20)
    bar = shapes.hole(shapes.cylinder(x[3], 0.2, density=RHO))
    return shapes.combine([shapes.box(x[:3], density=RHO), spatial.transform_properties(T, *bar)])


TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


@pytest.mark.parametrize(
    ("shape", "x"),
    [
        (drilled, [0.5, 0.6, 0.7, 0.05, 0.1, 0.2, 0.3]),
        (lambda x: shapes.capsule(x[0], x[1], density=x[2]), [0.2, 1.0, 5.0]),
        (lambda x: shapes.cone(x[0], x[1], mass=x[2]), [0.2, 1.0, 5.0]),
        (lambda x: shapes.tube(x[0], x[1], x[2], density=1.0), [0.4, 0.2, 1.0]),
        (lambda x: shapes.ellipsoid(x, density=1.0), [0.4, 0.2, 1.0]),
        (
            lambda x: shapes.mesh(x.reshape(4, 3), TETRAHEDRON, density=1.0),
            [0, 0.1, 0, 1, 0, 0.2, 0, 1, 0, 0.1, 0, 1],
        ),
    ],
    ids=["composition", "capsule", "cone", "tube", "ellipsoid", "mesh"],
)
def test_derivatives_in_the_dimensions(shape, x) -> None:
    x = np.array(x, float)
    f = jax.jit(lambda x: jnp.concatenate([jnp.ravel(a) for a in shape(x)]))
    got = jax.jit(jax.jacfwd(f))(x)
    step = 6e-6
    want = np.stack([(f(x + e) - f(x - e)) / (2 * step) for e in step * np.eye(len(x))], -1)
    assert relative_error(got, want) <= GRADIENT


def test_one_dimension_may_be_traced_and_another_known() -> None:
    """I_zz = m (R^2 + r^2) / 2."""
    slope = jax.grad(lambda outer: shapes.tube(outer, 0.1, 1.0, mass=2.0).inertia[2, 2])(0.3)
    np.testing.assert_allclose(slope, 2.0 * 0.3, rtol=1e-12)


def test_dimensions_may_be_batches() -> None:
    radii = np.array([0.1, 0.2, 0.3])
    batch = shapes.cylinder(radii, 1.0, mass=2.0)
    one = shapes.cylinder(0.2, 1.0, mass=2.0)
    assert batch.inertia.shape == (3, 3, 3) and batch.com.shape == (3, 3)
    close([x[1] for x in batch], one)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: shapes.sphere(1.0), ["neither", "density and mass"]),
        (lambda: shapes.sphere(1.0, density=1.0, mass=1.0), ["both", "density and mass"]),
        (lambda: shapes.sphere(-1.0, mass=1.0), ["radius is -1.0", "above zero"]),
        (lambda: shapes.sphere(0.0, mass=1.0), ["radius is 0.0", "above zero"]),
        (lambda: shapes.box([1.0, 2.0], mass=1.0), ["size", "(2,)", "3"]),
        (lambda: shapes.tube(1.0, 2.0, 1.0, mass=1.0), ["inner", "inner < outer"]),
        (lambda: shapes.combine([]), ["at least one"]),
        (lambda: shapes.points(np.eye(3), [1.0]), ["masses", "(1,)", "(3,)"]),
        (lambda: shapes.mesh(np.eye(3), [[0, 1, 2]], mass=1.0), ["edge", "closed surface"]),
        (lambda: shapes.mesh(np.eye(3), [[0, 1, 3]], mass=1.0), ["vertices", "0 to 2"]),
        (lambda: shapes.mesh(np.eye(3), [[0.0, 1, 2]], mass=1.0), ["float64", "integers"]),
        (
            lambda: shapes.mesh(np.eye(4)[:, :3], TETRAHEDRON, mass=1.0),
            ["volume is", "clockwise"],
        ),
    ],
    ids=range(12),
)
def test_wrong_dimensions_are_refused_in_a_sentence(call, words) -> None:
    with pytest.raises(InputError) as caught:
        call()
    for word in words:
        assert word in str(caught.value)
