"""The live driver: the stages of the replay at a real robot's pace, with everything it hears and says on record."""
