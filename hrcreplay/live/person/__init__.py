"""The process that supplies a live session with skeletons, from a recording or from Zenoh."""
