"""Tolerances that tests hold: the test below tests/, the text before the number, perhaps digits."""

from __future__ import annotations

from docs.generate.figures.kinds import Figure, Held

LOOPS, MOTION = "constraints/test_benchmarks.py", "wheeled/test_motion.py"
BEAMS, REDUCED = "flexible/test_beam_motions.py", "flexible/test_reduced_basis.py"
ROTATIONS, TOPS = "rotations/test_representation.py", "body/test_tops.py"
TEXTS = {
    "operations": ("dynamics/test_minimum.py", '"free_body": (18, ', 2),
    "forces": ("forces/test_fluid_box.py", '100, "unrolled") < '),
    "own-force": ("forces/test_by_a_stranger.py", "/ (2 * STEP)) < "),
    "joints": ("dynamics/test_joints.py", "data.qfrc_inverse, atol="),
    "rollout-gradient": ("motion/test_rollout.py", "/ (2 * h)) < "),
    "variational": ("motion/test_variational.py", "assert off[NAME].max() < "),
    "andrews.positions": (LOOPS, 'want["q"], rtol='),
    "andrews.velocities": (LOOPS, 'want["v"], rtol='),
    "andrews.multipliers": (LOOPS, 'want["lam"], rtol='),
    "pendulum.energy": (LOOPS, "np.abs(energy).max() < "),
    "slider-crank": (LOOPS, "path.q[1:, :2], want, atol="),
    "four-bars": (LOOPS, "assert_allclose(found, want, atol="),
    "forty-four-bars": (LOOPS, "abs(energy - first) < "),
    "dae-orders": ("constraints/test_differential_algebraic.py", "due[clear], rtol=0, atol=", 2),
    "soft-equalities": ("loading/test_compliant.py", "data.qacc, rtol=0, atol="),
    "wheels.full-model": ("wheeled/test_full_model.py", 'x["by multipliers"]) < '),
    "wheels.oracles": ("wheeled/test_rolling.py", "*path.v[-1]], due, rtol="),
    "wheels.files": ("wheeled/test_from_file.py", "ORACLE = "),
    "wheels.rows": (MOTION, "assert off < ("),
    "wheels.rows-of-model": (MOTION, "np.abs(off).max() < "),
    "wheels.energy": (MOTION, "abs(after - before - work) < "),
    "wheels.gradients": (MOTION, "np.abs(due)[counts]).max() < "),
    "rotations.f64": (ROTATIONS, "[(np.float64, "),
    "rotations.f32": (ROTATIONS, "(np.float32, "),
    "rotations.values": ("rotations/exact.py", "VALUE, DERIVATIVE = "),
    "rotations.derivatives": ("rotations/exact.py", "VALUE, DERIVATIVE = 1e-15, "),
    "free-top": (TOPS, "TOLERANCE = "),
    "heavy-top": (TOPS, 'sample["x"]).max() <= '),
    "contact": ("contact/test_solve.py", "found.acceleration, d.qacc, floor=1.0) < "),
    "optimal-cost": ("control/test_ddp.py", "DIGITS = "),
    "optimum-gradient": ("control/test_implicit.py", "differences(run, p), atol="),
    "lqr": ("control/test_lqr.py", "assert worst < "),
    "minimum-energy": ("control/test_collocation.py", 'given("minimum_energy")["cost"]) < '),
    "brachistochrone": (
        "control/test_collocation.py",
        '="gauss_legendre"\n    )\n    assert found.success and abs(found.duration - case["T"]) < ',
    ),
    "beams.elastica": ("flexible/strain/test_statics.py", 'elastica_error(12, ["10"])[0] < '),
    "beams.roll-up": ("flexible/strain/test_statics.py", "np.abs(at[:2] - want).max() < "),
    "beams.bend": ("flexible/strain/test_statics.py", "np.abs(got - want).max() < "),
    "beams.frequency": ("flexible/test_beam_frequencies.py", "(7, ["),
    "beams.reduced.frequencies": (REDUCED, "frequencies(model)[:5] / want - 1) < "),
    "beams.reduced.bend": (REDUCED, "assert max(errors) < "),
    "beams.reduced.swing": (REDUCED, "after(small, 600) - after(whole, 600)).max() < "),
    "beams.spin-up": (BEAMS, "rtol=0, atol="),
    "beams.trend": (BEAMS, "(np.abs(trend) < "),
    "beams.gradient": (BEAMS, "assert_allclose(found[i], want, rtol="),
    "beams.identities": ("dynamics/test_modal_link.py", "np.eye(model.nv), atol="),
    "orders": ("solvers/test_orders.py", "WITHIN = ", 2),
    "solver-gradients": ("solvers/test_transformations.py", "DERIVATIVE = "),
    "manifold": ("stability/runs/test_drift.py", "    assert error < "),
    "stability-limits": ("stability/theory/test_linear_theory.py", "EXACT = "),
}
FIGURES: dict[str, Figure] = {f"held.{name}": Held(*text) for name, text in TEXTS.items()}
