"""Checks of the messages of refusals."""


def assert_message_names(message: object, *parts: str) -> None:
    """Check that a message names a place, a field and a mend, or whatever parts are given, in this order.

    The wording in between is free.
    """
    position = 0
    for part in parts:
        position = str(message).find(part, position)
        assert position >= 0, f"{part!r} is missing or misplaced in {message}"
        position += len(part)
