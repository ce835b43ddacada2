"""A page for each task of `rb.envs.tasks`.

- `pages`: the pages, and their list
- `definition`: the docstring of a task and of its file, as prose, lists and tables
- `terms`: observations, variables, terminations, events, randomisations
- `training`: the measured trainings
"""
