"""The person of a live session, a process of its own: a recording or Zenoh, as skeletons for the control loop."""
