"""Public functions without a case on the grid, by room.

They read, write, draw, search, train, print, make objects, or run on the host: files of their own
test them.
"""

ELSEWHERE: dict[str, set[str]] = {
    "rb": {"compile", "compiler_options", "load", "operation_count", "scenes", "threads",
           "write_back", "write_mjcf"},
    "rotations": {"representations"},
    "spatial": set(),
    "body": {"formulation", "formulations"},
    "dynamics": set(),
    "forces": {"on_each", "tendon_reach"},
    "joints": {"kind", "kinds", "register", "hinge_motion"},
    "loading": {"compile_model", "load", "scenes", "write_back", "write_mjcf"},
    # rows are functions of frames: tests/constraints/test_pairs.py and test_rows.py
    "constraints": {"along", "assemble", "coordinate", "cosine", "displacement", "distance",
                    "formulations", "kinds", "mobility", "places", "time", "turn"},
    "contact": {"laws", "pairs"},
    "wheeled": {"at", "controlled", "fidelities", "from_file", "kinds", "simulate",
                "with_trailers", "write_mjcf"},
    "planning": {"clear", "clear_along", "drives", "grid_a_star", "grid_dijkstra",
                 "grid_dijkstra_many", "hybrid_a_star", "methods", "plan", "refine", "smooth",
                 "time_scaling"},
    # searches, training, sentences; `solve` has cases by its methods
    "kinematics": {"inverse_kinematics"},
    "control": {"actor_critic", "inverse_kinematics", "methods", "mpc", "region_of_attraction",
                "through_time"},
    "control.laws": {"region_of_attraction"},
    "control.learning": {"actor_critic", "through_time"},
    "control.linear": {"unreachable_directions"},
    "control.optimal": {"methods", "mpc"},
    # recordings, fits and their statistics, which run in NumPy on the host
    "sysid": {"base_parameters", "combinations", "compare", "consistent", "design_experiment",
              "diagnose", "differentiate", "equations", "estimates", "findings", "free_run",
              "held_out", "identifiability", "identify", "in_si", "low_pass", "many_starts",
              "monte_carlo", "parameter_names",
              "prediction_error", "random_motions", "read_csv", "read_npz", "regress",
              "regress_with_zeros", "report", "select", "split", "squares", "torque_rows",
              "whiteness", "zeros_of"},
    "estimation": set(),
    "sensors": {"kinds", "register", "sensor_of"},
    # theory by polynomials in NumPy, runs of a million steps, pictures
    "stability": {"adams", "alpha_degrees", "attempt", "backward_differentiation", "characteristic",
                  "dissipation", "drift", "equilibrium", "gradient_growth", "growth_factors",
                  "imaginary_limit", "linear_analysis", "lyapunov", "measured_order",
                  "measured_stable_step", "motion_matrices", "multistep", "order_by_conditions",
                  "oscillation_limit", "oscillator_factors", "pece", "period_elongation",
                  "plot_regions", "plot_spectral_radius", "real_limit",
                  "reduced_linearisation", "scenes", "spectral_radius", "stability_function",
                  "stability_region", "stable_step", "stiff_stability", "trend", "truth",
                  "verdict"},
    # makers of solvers, which tests/solvers steps
    "solvers": {"adams_bashforth", "adams_moulton", "all", "bdf", "chord", "gauss_legendre",
                "generalized_alpha", "hht_alpha", "implicit_midpoint", "lobatto_iiia",
                "lobatto_iiic", "newmark", "newton", "pece", "radau_iia", "rkmk",
                "ros2", "ros34pw2", "stoermer_verlet", "symplectic_euler", "trapezoid",
                "very_chord", "yoshida4", "yoshida6"},
    "plotting": {"animate", "animate_top_view", "bare", "draw", "draw_solids", "poses", "skeleton",
                 "solids", "strobe", "time_plot", "top_view"},
    "validation": {"compare"},
    "recommend": {"control_method", "fidelity", "formulation", "solver"},
    "demo": {"demo"},
    # within rbjax: arithmetic on single numbers, parts of a model, the compiler
    "lanes": {"add", "as_arrays", "batch_first", "batch_last", "elimination_order",
              "fusion_barrier", "horner", "inner", "inverse", "is_literal", "is_zero", "ldlt",
              "matmat", "matrix_transpose", "matvec", "mul", "neg", "outer", "pack",
              "polynomial_sincos", "quaternion_matrix", "rotation_z", "sincos", "sub", "total",
              "unpack"},
    "model": {"with_constants", "partition", "prepare", "spans",
              "without_constants"},
    "compiler": {"compile", "explain", "threads"},
}  # fmt: skip
