"""A report that stands on its own: a window of a bag, what came of it, and the proof that it does again."""
