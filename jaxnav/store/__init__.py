"""Checkpoints, exported parameters and the run log."""
