"""The environment: one episode, its spaces, and a check of its contract."""
