"""What if? Two results of the same frames: what is in one only, what has moved, what has another class."""
