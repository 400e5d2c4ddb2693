"""What a scene is: procedural worlds, importers, and compilation to flat tables (NumPy, on the host)."""
