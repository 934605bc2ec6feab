"""What the robot would do if nobody were there: tasks, paths, references, inverse kinematics."""
