"""Control of the robot for the next tick: separation, safety rows, the QP, speed scaling, the stop."""
