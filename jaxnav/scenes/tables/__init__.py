"""Compilation of scenes to tables over every pose."""
