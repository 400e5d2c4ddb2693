"""Scenes: generated worlds, scene files and compiled tables (NumPy, host)."""
