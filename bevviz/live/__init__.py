"""Beside a running robot: receiving, stages and logging decoupled, outputs that cannot stop each other."""
