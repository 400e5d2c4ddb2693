"""Procedural rooms, apartments and houses."""
