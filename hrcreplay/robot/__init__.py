"""The robot: model, programmed path, separation, constraints, controllers. Has no side effects."""
