"""The one exception for input that a user can mend."""


class InputError(ValueError):
    """Bad input: a config, a scene file, a checkpoint or an argument. The message names the place and the mend."""
