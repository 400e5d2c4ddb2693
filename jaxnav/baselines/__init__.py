"""Agents that learn nothing: shortest path, frontier search, uniformly random."""
