"""Camera poses and clock offsets, the floor, and the cell file that stores them."""
