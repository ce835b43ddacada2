"""Tasks, one a file. Each file registers functions that return a `Task`; `rb.envs.tasks` imports
all files of this folder.

Files:
    cart_pole.py: balance and swing-up of a pole on a cart.
    flexible_arm.py: an arm that bends reaches a goal and damps its swing.
    g1.py: a Unitree G1 that follows velocity commands.
    go1.py: a Unitree Go1 that follows velocity commands, on flat or rough ground.
    hopper.py: a planar hopper that stands or hops.
    ice.py: a car with tyre slip races on ice.
    legged.py: what the legged tasks share.
    running_hopper.py: a planar hopper that runs, with smooth rewards.
    trailer.py: a car parks its trailer backwards.
    walker.py: a planar walker that stands, walks or runs.
    panda.py: an arm that picks up a cube.
"""
