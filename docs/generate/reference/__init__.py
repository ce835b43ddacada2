"""The reference, made from the code.

- `rooms`: the public names by room and subject
- `headings`: the headings of the subjects
- `pages`: a page for each room
- `registries`: joints, forces, solvers and other registries as tables
- `command_line`: the help of `rbjax`
"""
