"""The robot: model, programmed path, separation, constraints, controllers. Pure."""
