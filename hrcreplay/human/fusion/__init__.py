"""Merges the skeletons of several cameras into one person: inverse kinematics, Kalman filter, gating, residual."""
