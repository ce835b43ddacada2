"""How a search for an optimum ended, as a number that a program can return."""

GOING, CONVERGED, BUDGET, INFEASIBLE, STUCK, NOT_FINITE = range(6)

SENTENCES = {
    CONVERGED: "converged",
    BUDGET: "budget spent: raise iterations, or start nearer",
    INFEASIBLE: "infeasible: the constraints cannot be held together",
    STUCK: "stuck: no step lowers the cost; change the start, or look for a kink in a cost",
    NOT_FINITE: "not finite: the cost or the dynamics of the first guess is nan or infinite",
}
