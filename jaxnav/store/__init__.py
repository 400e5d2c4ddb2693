"""Checkpoints, exported parameters and the run log. Imports no other part of jaxnav but its errors."""
