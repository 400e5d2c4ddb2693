"""One episode: reset, step and observe; from worlds to environments, and a check of their contract."""
