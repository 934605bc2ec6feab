"""Proof by sampling: motions that the human model allows, followed in search of a point outside a predicted volume.

Written apart from what it tests: kinematics, integration and containment are its own.
"""
