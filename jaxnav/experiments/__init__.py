"""Experiments: what to train, what to measure, and the pages that are written from the results."""
