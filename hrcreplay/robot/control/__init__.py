"""Control of the robot in the next tick: separation, safety rows, the QP, speed scaling, the stop."""
