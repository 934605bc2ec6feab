"""Live sessions: run the stages of the replay at the cycle time of a real robot, and record inputs and outputs."""
