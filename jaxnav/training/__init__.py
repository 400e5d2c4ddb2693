"""Exploration for the layout prior, rollouts, losses and the learner."""
