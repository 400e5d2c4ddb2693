"""A run that stops after its first chunk and goes on."""

import pytest

from jaxnav.runs.config import RunConfig
from jaxnav.runs.run import Run
from jaxnav.runs.train import train
from jaxnav.training.trainer import Trainer


def train_in_two(config: RunConfig, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Train a run that is stopped after its first chunk, and start it again."""
    done, once = [], Trainer.train

    def stop_after_the_first(self, *arguments):
        if done:
            raise KeyboardInterrupt
        done.append(arguments)
        return once(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "train", stop_after_the_first)
        with pytest.raises(KeyboardInterrupt):
            train(config)
    return train(config)
