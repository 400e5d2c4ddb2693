"""A run that stops after its first chunk and resumes."""

import pytest

from jaxnav.runs.config import RunConfig
from jaxnav.runs.run import Run
from jaxnav.runs.train import train
from jaxnav.training.trainer import Trainer


def train_in_two(config: RunConfig, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Train a run that is stopped after its first chunk, and resume it."""
    chunks = []
    train_chunk = Trainer.train

    def stop_after_first_chunk(self, *arguments):
        if chunks:
            raise KeyboardInterrupt
        chunks.append(arguments)
        return train_chunk(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "train", stop_after_first_chunk)
        with pytest.raises(KeyboardInterrupt):
            train(config)
    return train(config)
