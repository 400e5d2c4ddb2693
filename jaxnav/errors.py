"""Exceptions for input that a user can fix, and for runs that a user ends."""


class InputError(ValueError):
    """Bad input that a user can fix: a configuration, a scene file, a checkpoint or an argument.

    The message names the place of the problem and the remedy.
    """


class MissingSplitError(InputError):
    """A scene file without any scene of a split."""


class Interrupted(KeyboardInterrupt):
    """End of a run that was asked to end; its state is saved.

    Attributes:
      signal: number of the signal that ended the run.
    """

    def __init__(self, signal: int, message: str) -> None:
        """Store the signal, and the message for the user."""
        super().__init__(message)
        self.signal = signal
