"""What a scene is: generated rooms, scene files, and compilation to flat tables (NumPy, on the host)."""
