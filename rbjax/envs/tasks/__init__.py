"""Tasks, one a file. Each file registers functions that return a `Task`; `rb.envs.tasks` imports
all files of this folder."""
