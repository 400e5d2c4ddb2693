"""Training of a run."""

from jaxnav.cli.train import train

__all__ = ["train"]
