"""Skeletons of several cameras to one moving person: inverse kinematics, Kalman filter, gating, model residual."""
