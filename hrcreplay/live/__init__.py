"""Live sessions: the stages of the replay at the cycle time of a real robot, with inputs and outputs recorded."""
