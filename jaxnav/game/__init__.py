"""Playing an episode by hand in the terminal."""
