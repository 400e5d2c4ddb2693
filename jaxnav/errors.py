"""Exceptions for input that a user can mend, and for runs that a user ends."""


class InputError(ValueError):
    """Bad input that a user can mend: a config, a scene file, a checkpoint or an argument.

    The message names the place and the mend.
    """


class MissingSplitError(InputError):
    """A scene file without any scene of a split."""


class Interrupted(KeyboardInterrupt):
    """End of a run that was asked to end; its state is saved.

    Attributes:
      signal: number of the signal that asked for the end.
    """

    def __init__(self, signal: int, message: str) -> None:
        """Store the signal, and the message for the user."""
        super().__init__(message)
        self.signal = signal
