"""What the robot does in the next tick: separation, safety rows, the QP, speed scaling, the stop."""
