"""Exceptions for input that a user can mend."""


class InputError(ValueError):
    """Refuse bad input that a user can mend.

    A config, a scene file, a checkpoint or an argument; the message names the place and the mend.
    """


class MissingSplitError(InputError):
    """Refuse a scene file that holds no scene of a split."""
