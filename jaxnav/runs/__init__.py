"""Training runs: configuration, directory, scenes, training, evaluation and exported policies."""
