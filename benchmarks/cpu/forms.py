"""Public functions under plain jit, batch 1,024, against their fastest form under XLA.

`python -m benchmarks.cpu.forms [--full]`: twenty functions, by default five, in results of their
own; one core, f64, Panda, default flags. Forms: plain `jit(vmap(f))` with the driver "auto" (what a
user writes); the other driver; chunks of 240 (`lax.map`); XLA's fusion pass off; its fusion
emitters off. The result is plain over the fastest.
"""

from __future__ import annotations

import benchmarks.shared.one_core  # noqa: F401  isort: skip

import argparse

import jax
import jax.numpy as jnp

import rbjax as rb
from benchmarks.shared.progress import add_full, progress, sized
from benchmarks.shared.robots import compiled, ours, states
from benchmarks.shared.timing import markdown_table, measure, save
from benchmarks.shared.under_xla import under_xla
from rbjax.compiling import WITHOUT_EMITTERS, xla_accepts

BATCH = 1024
FUNCTIONS = {
    "forward_kinematics": lambda m, q, v, u: rb.forward_kinematics(m, q),
    "body_velocities": lambda m, q, v, u: rb.body_velocities(m, q, v),
    "jacobian": lambda m, q, v, u: rb.jacobian(m, q, m.body_names[-1]),
    "inverse_dynamics": rb.inverse_dynamics,
    "forward_dynamics": rb.forward_dynamics,
    "mass_matrix": lambda m, q, v, u: rb.mass_matrix(m, q),
    "inverse_mass_matrix": lambda m, q, v, u: rb.inverse_mass_matrix(m, q),
    "bias_forces": lambda m, q, v, u: rb.bias_forces(m, q, v),
    "gravity_forces": lambda m, q, v, u: rb.gravity_forces(m, q),
    "coriolis_matrix": lambda m, q, v, u: rb.coriolis_matrix(m, q, v),
    "applied_forces": lambda m, q, v, u: rb.applied_forces(m, rb.State(q, v)),
    "inverse_dynamics_derivatives": rb.inverse_dynamics_derivatives,
    "forward_dynamics_derivatives": rb.forward_dynamics_derivatives,
    "inertial_regressor": rb.inertial_regressor,
    "kinetic_energy": lambda m, q, v, u: rb.kinetic_energy(m, q, v),
    "potential_energy": lambda m, q, v, u: rb.potential_energy(m, q),
    "center_of_mass": lambda m, q, v, u: rb.center_of_mass(m, q),
    "centroidal_momentum": lambda m, q, v, u: rb.centroidal_momentum(m, q, v),
    "integrate": lambda m, q, v, u: rb.integrate(m, q, v),
    "difference": lambda m, q, v, u: rb.difference(m, q, q + v),
}
FEW = ("forward_kinematics", "inverse_dynamics", "forward_dynamics", "mass_matrix", "integrate")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add_full(parser, "all functions", "five of them")
    full = parser.parse_args().full
    model = ours("panda")
    given = tuple(jnp.asarray(x) for x in states(compiled("panda"), BATCH))
    rows = []
    for name in progress(FUNCTIONS if full else FEW):
        f = FUNCTIONS[name]

        def plain(*x, f=f, model=model):
            return jax.vmap(lambda *one: f(model, *one))(*x)

        def rolled(*x, plain=plain):
            return plain(*x, model=model.replace(driver="rolled"))

        def mapped(*x, f=f, model=model):
            return jax.lax.map(lambda one: f(model, *one), x, batch_size=240)

        forms = {
            "plain": (plain, None),
            "rolled": (rolled, None),
            "chunks": (mapped, None),
            "no fusion": (plain, {"xla_disable_hlo_passes": "fusion"}),
        }
        if xla_accepts(*WITHOUT_EMITTERS):
            forms["no emitters"] = (plain, dict([WITHOUT_EMITTERS]))
        row = {"function": name}
        for form, (g, options) in forms.items():
            timed = measure(g, *given, budget_s=0.4, compiler_options=options)
            row[form] = timed["run_min_s"] / BATCH * 1e9
        row["plain over fastest"] = row["plain"] / min(row[form] for form in forms)
        rows.append(row)
        print(row, flush=True)
    print(markdown_table(rows, rows[0]))
    print(save(sized("cpu-forms", full), rows))


if __name__ == "__main__":
    with under_xla():
        main()
