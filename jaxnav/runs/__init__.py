"""A training run: its configuration, directory, scenes, training and evaluation."""
