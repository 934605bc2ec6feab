"""A robot double: the controller's side of EGM, with faults on request and a report of what it was told."""
