"""Prediction of the person within a horizon: reachable sets of the joints, and the volumes that the limbs sweep."""
