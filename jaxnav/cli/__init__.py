"""Typed configuration and the train, eval, play and import commands."""
