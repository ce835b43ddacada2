"""What several solvers share: tableaux, steps on groups, stages, Newton iterations."""
