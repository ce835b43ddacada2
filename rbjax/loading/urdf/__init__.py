"""URDF: the tree of links and joints, its inertials and shapes, as a `mujoco.MjSpec`."""
