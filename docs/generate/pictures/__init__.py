"""The animated pictures of README: `python -m docs.generate.pictures [NAME ...]`, a few minutes.

    motions   robots with joints: the motion of each clip
    plane     motions seen from above, and many samples at once
    painting  frames of a motion, and animated WebP files

The policy of the clip `walking_policy` is `notebooks/data/go1_policy`: `rbjax train
go1_joystick_flat` on one H100, 112 s (`notebooks/walking_policy.py`). All other motions are
simulated here.
"""
