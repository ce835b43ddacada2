"""Planar kinematics of wheeled robots: lanes, velocities of wheels, odometry."""
