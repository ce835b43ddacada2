"""Butcher tableaus, checks of their order, and collocation methods from their nodes.

    k_i = h f(t0 + c_i h, y0 + sum_j a_ij k_j),    y1 = y0 + sum_i b_i k_i
A method has order p if sum_i b_i Phi_i(tree) = 1 / gamma(tree) for every rooted tree of at most p
nodes.

Source: Hairer, Norsett & Wanner, *Solving Ordinary Differential Equations I*, II.2.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import diffrax
import numpy as np
from numpy.polynomial import Polynomial, legendre

from rbjax.arguments import integer, shown
from rbjax.display import displayed
from rbjax.errors import InputError

Tree = tuple  # a rooted tree, as the tuple of its branches; () is a leaf
TOLERANCE = 1e-11  # relative to the terms of a condition, for coefficients of about 11 digits


@functools.cache
def trees(nodes: int) -> tuple[Tree, ...]:
    """Return the rooted trees with the given number of nodes."""
    return tuple(sorted(set(_forests(nodes - 1))))


def _forests(nodes: int) -> list[tuple[Tree, ...]]:
    if nodes == 0:
        return [()]
    return [
        tuple(sorted((tree, *rest)))
        for first in range(1, nodes + 1)
        for tree in trees(first)
        for rest in _forests(nodes - first)
    ]


def size(tree: Tree) -> int:
    """Return the number of nodes of a tree."""
    return 1 + sum(map(size, tree))


def density(tree: Tree) -> int:
    """Return gamma of a rooted tree: the number of nodes times the densities of the branches."""
    return size(tree) * int(np.prod([density(branch) for branch in tree], dtype=int))


def weights(a: np.ndarray, tree: Tree) -> np.ndarray:
    """Return the elementary weights Phi_i (s,) of a rooted tree. They are the products over the
    branches of sum_j a_ij Phi_j(branch)."""
    out = np.ones(len(a))
    for branch in tree:
        out = out * (a @ weights(a, branch))
    return out


def attained_order(a: np.ndarray, b: np.ndarray, at_most: int = 6) -> int:
    """Return the order of a method by its order conditions, checked up to `at_most`."""
    for p in range(1, at_most + 1):
        for tree in trees(p):
            sizes = np.abs(b) @ weights(np.abs(a), tree) + 1 / density(tree)
            if abs(b @ weights(a, tree) - 1 / density(tree)) > TOLERANCE * sizes:
                return p - 1
    return at_most


def proven_order(a: np.ndarray, b: np.ndarray) -> int:
    """Return a lower bound of the order, by Butcher's simplifying assumptions. B(p), C(eta) and
    D(zeta) prove the order min(p, eta + zeta + 1, 2 eta + 2) (Hairer, Norsett & Wanner, II, Theorem
    7.4)."""
    c, size = a.sum(1), np.abs(a).sum(1)

    def holding(excess, terms) -> int:
        powers = range(1, 2 * len(b) + 1)
        fails = (k for k in powers if (abs(excess(k)) > TOLERANCE * terms(k)).any())
        return next(fails, 2 * len(b) + 1) - 1

    p = holding(lambda k: b @ c ** (k - 1) - 1 / k, lambda k: np.abs(b) @ size ** (k - 1) + 1 / k)
    eta = holding(
        lambda k: a @ c ** (k - 1) - c**k / k,
        lambda k: np.abs(a) @ size ** (k - 1) + size**k / k,
    )
    zeta = holding(
        lambda k: (b * c ** (k - 1)) @ a - b * (1 - c**k) / k,
        lambda k: np.abs(b * size ** (k - 1)) @ np.abs(a) + np.abs(b) * (1 + size**k) / k,
    )
    return min(p, eta + zeta + 1, 2 * eta + 2)


@displayed
@dataclass(frozen=True)
class Tableau:
    """A Runge-Kutta method. All sequences or arrays are converted to tuples.

    Fields:
        a: (s, s) coefficients. The nodes c are its row sums.
        b: (s,) weights.
        order: order of the method.
        error: (s + 1,) weights of (h f(t0, y0), k_1, ..., k_s) in the error estimate; empty for
            constant steps.
        error_order: power of h of the error estimate.
        filter: gamma of (1 - h gamma J)^-1, which damps a stiff estimate, or 0.
        dense: (s, degree) coefficients of theta, theta^2, ... in b_i(theta); empty for a cubic
            dense output.

    Raises:
        InputError: wrong shapes; an order that the order conditions (checked up to 6) deny; error
            weights that do not sum to zero; a dense output that does not end at y1.
    """

    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    order: int
    error: tuple[float, ...] = ()
    error_order: int = 0
    filter: float = 0.0
    dense: tuple[tuple[float, ...], ...] = ()

    def __post_init__(self) -> None:
        try:
            s = np.size(self.b)
        except ValueError as error:
            raise InputError(f"tableau: b is {shown(self.b)}, expected (s,) numbers") from error
        integer("tableau", "order", self.order, least=1)
        shapes: dict[str, list[tuple]] = {"a": [(s, s)], "b": [(s,)], "error": [(s + 1,), (0,)]}
        for name in ("a", "b", "error", "dense"):
            given = getattr(self, name)
            try:
                x = np.asarray(given, float)
            except (TypeError, ValueError) as error:
                raise InputError(f"tableau: {name} is {given}, expected numbers in rows") from error
            expected = shapes.get(name, [(0,), (s, *x.shape[1:2])])
            if x.shape not in expected or not np.isfinite(x).all():
                raise InputError(
                    f"tableau: {name} has shape {x.shape}, expected {expected[0]}, all finite"
                )
            object.__setattr__(self, name, _tuples(x))
        found = attained_order(np.array(self.a), np.array(self.b), min(self.order, 6))
        if found < min(self.order, 6):
            raise InputError(f"tableau: order {found} by its conditions, expected {self.order}")
        if self.error and abs(sum(self.error)) > TOLERANCE:
            raise InputError("tableau: the weights of the error estimate do not sum to zero")
        if self.dense and np.abs(np.sum(self.dense, 1) - self.b).max() > TOLERANCE:
            raise InputError("tableau: the dense output does not end in y1")

    @property
    def stages(self) -> int:
        return len(self.b)

    @property
    def essential(self) -> Tableau:
        """The explicit method without its error estimate and the stages that only it needs."""
        s = max(i for i, b in enumerate(self.b) if b) + 1
        return Tableau(tuple(row[:s] for row in self.a[:s]), self.b[:s], self.order)

    @functools.cached_property
    def c(self) -> tuple[float, ...]:
        return tuple(float(sum(row)) for row in self.a)


def _tuples(x: np.ndarray):
    return tuple(map(_tuples, x)) if x.ndim else float(x)


def _shifted_legendre(s: int) -> Polynomial:
    """Return the shifted Legendre polynomial P_s(2 x - 1)."""
    inside = Polynomial([-1.0, 2.0])
    return Polynomial(legendre.leg2poly([0] * s + [1]))(inside)


def _roots(p: Polynomial) -> np.ndarray:
    """Return the real roots to the last digit: eigenvalues, then Newton steps."""
    x = np.sort(np.real(p.roots()))
    for _ in range(3):
        x = x - p(x) / p.deriv()(x)
    return x


def _integrals(c: np.ndarray) -> list[Polynomial]:
    """Return the integrals from 0 of the Lagrange polynomials of nodes c."""
    out = []
    for j in range(len(c)):
        l = Polynomial([1.0])
        for other in np.delete(c, j):
            l = l * Polynomial([-other, 1.0]) / (c[j] - other)
        out.append(l.integ())
    return out


def _collocation(c: np.ndarray, a: np.ndarray | None, order: int) -> Tableau:
    """Return the collocation method of nodes c: a_ij = int_0^c_i l_j, b_j = int_0^1 l_j. `a`
    overrides the coefficients a_ij."""
    s = len(c)
    basis = _integrals(c)
    b = np.array([l(1.0) for l in basis])
    if a is None:
        a = np.array([[l(x) for l in basis] for x in c])
    dense = np.array([np.pad(l.coef[1:], (0, s - len(l.coef[1:]))) for l in basis])
    eigenvalues = np.linalg.eigvals(a)
    nonzero = eigenvalues[np.abs(eigenvalues) > 1e-8]
    gamma = float(np.real(np.prod(nonzero)) ** (1 / len(nonzero)))
    if np.abs(a[0]).max() == 0:  # the first stage is y0: omit the last node
        less = [l(1.0) for l in _integrals(c[:-1])]
        error, error_order = np.array([0.0, *(b - np.append(less, 0.0))]), s
    else:  # one more node at t0, of weight gamma
        powers = np.vander(c, s, increasing=True).T
        error = np.append(gamma, np.linalg.solve(powers, -gamma * np.eye(s)[0]))
        error_order = s + 1
    return Tableau(
        _tuples(a), _tuples(b), order, _tuples(error), error_order, gamma, _tuples(dense)
    )


@functools.cache
def gauss(stages: int) -> Tableau:
    """Return the Gauss-Legendre tableau: order 2 s, A-stable, symplectic, symmetric."""
    return _collocation(_roots(_shifted_legendre(stages)), None, 2 * stages)


@functools.cache
def radau_iia(stages: int) -> Tableau:
    """Return the Radau IIA tableau: order 2 s - 1, L-stable, stiffly accurate."""
    p = _shifted_legendre(stages) - _shifted_legendre(stages - 1)
    c = _roots(p)
    c[-1] = 1.0
    return _collocation(c, None, 2 * stages - 1)


def _lobatto(stages: int) -> np.ndarray:
    inner = _shifted_legendre(stages - 1).deriv()
    middle = _roots(inner) if stages > 2 else np.zeros(0)
    return np.concatenate([[0.0], middle, [1.0]])


@functools.cache
def lobatto_iiia(stages: int) -> Tableau:
    """Return the Lobatto IIIA tableau: order 2 s - 2, A-stable. Two stages are the trapezoidal
    rule."""
    return _collocation(_lobatto(stages), None, 2 * stages - 2)


@functools.cache
def lobatto_iiic(stages: int) -> Tableau:
    """Return the Lobatto IIIC tableau: order 2 s - 2, L-stable. It satisfies a_i1 = b_1 and sum_j
    a_ij c_j^(k-1) = c_i^k / k for k < s."""
    c = _lobatto(stages)
    b1 = _collocation(c, None, 2 * stages - 2).b[0]
    # columns 2..s from C(s - 1); the first is b_1
    k = np.arange(1, stages)
    powers = c[None, :] ** (k[:, None] - 1)  # (s - 1, s), with 0^0 = 1
    target = c[:, None] ** k / k - b1 * powers[:, 0]
    rest = np.linalg.solve(powers[:, 1:], target.T).T
    return _collocation(c, np.column_stack([np.full(stages, b1), rest]), 2 * stages - 2)


def explicit(
    rows: tuple[tuple[float, ...], ...],
    b: tuple[float, ...],
    order: int,
    error: tuple[float, ...] = (),
) -> Tableau:
    """Return an explicit tableau from the rows below the diagonal. `error` are weights of the
    k_i."""
    s = len(b)
    a = tuple(tuple(row) + (0.0,) * (s - len(row)) for row in ((), *rows))
    return Tableau(a, b, order, (0.0, *error) if error else (), order if error else 0)


@functools.cache
def of_diffrax(solver: type[diffrax.AbstractERK], order: int) -> Tableau:
    """Return the tableau of an explicit Runge-Kutta solver of diffrax."""
    t = solver.tableau
    assert isinstance(t, diffrax.ButcherTableau)
    rows = tuple(tuple(float(x) for x in row) for row in t.a_lower)
    b, error = (tuple(float(x) for x in row) for row in (t.b_sol, t.b_error))
    return explicit(rows, b, order, error)


EULER = explicit((), (1.0,), 1)
MIDPOINT = explicit(((1 / 2,),), (0.0, 1.0), 2)
HEUN = explicit(((1.0,),), (1 / 2, 1 / 2), 2, (-1 / 2, 1 / 2))
KUTTA3 = explicit(((1 / 2,), (-1.0, 2.0)), (1 / 6, 2 / 3, 1 / 6), 3)
#: The classical method. Its embedded method of order 3 uses a fifth stage, at y1.
RK4 = explicit(
    ((1 / 2,), (0.0, 1 / 2), (0.0, 0.0, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6)),
    (1 / 6, 1 / 3, 1 / 3, 1 / 6, 0.0),
    4,
    (0.0, 0.0, 0.0, 1 / 6, -1 / 6),
)
#: The classical method without its embedded method.
KUTTA4 = RK4.essential


#: Hairer's method of order 8 in 12 stages, without its error estimates and dense output
#: (Hairer, Norsett & Wanner, II.5)
DOP853 = explicit(
    (
        (0.05260015195876773,),
        (0.0197250569845379, 0.0591751709536137),
        (0.02958758547680685, 0.0, 0.08876275643042054),
        (0.2413651341592667, 0.0, -0.8845494793282861, 0.924834003261792),
        (0.037037037037037035, 0.0, 0.0, 0.17082860872947386, 0.12546768756682242),
        (0.037109375, 0.0, 0.0, 0.17025221101954405, 0.06021653898045596, -0.017578125),
        (0.03709200011850479, 0.0, 0.0, 0.17038392571223998, 0.10726203044637328,
         -0.015319437748624402, 0.008273789163814023),
        (0.6241109587160757, 0.0, 0.0, -3.3608926294469414, -0.868219346841726, 27.59209969944671,
         20.154067550477894, -43.48988418106996),
        (0.47766253643826434, 0.0, 0.0, -2.4881146199716677, -0.590290826836843, 21.230051448181193,
         15.279233632882423, -33.28821096898486, -0.020331201708508627),
        (-0.9371424300859873, 0.0, 0.0, 5.186372428844064, 1.0914373489967295, -8.149787010746927,
         -18.52006565999696, 22.739487099350505, 2.4936055526796523, -3.0467644718982196),
        (2.273310147516538, 0.0, 0.0, -10.53449546673725, -2.0008720582248625, -17.9589318631188,
         27.94888452941996, -2.8589982771350235, -8.87285693353063, 12.360567175794303,
         0.6433927460157636),
    ),
    (0.054293734116568765, 0.0, 0.0, 0.0, 0.0, 4.450312892752409, 1.8915178993145003,
      -5.801203960010585, 0.3111643669578199, -0.1521609496625161, 0.20136540080403034,
      0.04471061572777259),
    8,
)  # fmt: skip
