"""Pictures of scenes, episodes and results."""
