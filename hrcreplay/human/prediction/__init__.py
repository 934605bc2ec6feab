"""Where the person can get within a horizon: reachable sets of the joints, and the volumes that the limbs sweep."""
