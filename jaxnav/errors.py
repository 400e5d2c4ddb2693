"""Exceptions for input that a user can mend, and for runs that a user ends."""


class InputError(ValueError):
    """Refuse bad input that a user can mend.

    A config, a scene file, a checkpoint or an argument; the message names the place and the mend.
    """


class MissingSplitError(InputError):
    """Refuse a scene file that holds no scene of a split."""


class Interrupted(KeyboardInterrupt):
    """End a run that was asked to end; what it did is saved.

    Attributes:
      signal: number of the signal that asked for it.
    """

    def __init__(self, signal: int, told: str) -> None:
        """Take the signal, and what to tell the user."""
        super().__init__(told)
        self.signal = signal
