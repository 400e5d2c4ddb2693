"""Exceptions for input that a user can fix, and for runs that a user ends."""

from collections.abc import Collection


class InputError(ValueError):
    """Bad input that a user can fix: a configuration, a scene file, a checkpoint or an argument.

    The message names the place of the problem and the remedy.
    """


def check_choice(option: str, value: str | None, choices: Collection[str]) -> None:
    """Check that an option has one of the names that it accepts; None stands for its default.

    The command line reads the same names from types (`jaxnav.choices`), but calls from Python may give any.

    Raises:
      InputError: the value is none of the choices.
    """
    if value is not None and value not in choices:
        raise InputError(f"{option} {value!r}: choose one of {', '.join(choices)}")


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
