"""Prediction of the person within a horizon: reachable sets of the joints, and swept volumes of the limbs."""
