"""The person: kinematics, inverse kinematics, fusion, reachable sets, swept volumes. Pure functions."""
