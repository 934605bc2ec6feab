"""Many ticks in one kernel: the prediction and a method, from the fused people to the robot's motion."""
