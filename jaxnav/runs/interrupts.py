"""Signals that ask a training run to end: Ctrl-C, and SIGTERM as schedulers send it."""

import signal
import threading
from types import FrameType

import jax
import numpy as np
from jax.experimental import multihost_utils

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupts:
    """Note the first signal, while this is entered, instead of ending.

    A second one ends the process at once. Outside the main thread, where Python can handle no signal, nothing is
    noted.
    """

    def __enter__(self) -> "Interrupts":
        self._asked = 0
        self._earlier = {}
        if threading.current_thread() is threading.main_thread():
            heeded = [number for number in _SIGNALS if signal.getsignal(number) not in (signal.SIG_IGN, None)]
            self._earlier = {number: signal.signal(number, self._note) for number in heeded}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._earlier.items():
            signal.signal(number, handler)

    def asked(self) -> int:
        """Return the signal that has come to any process of the run, else 0."""
        if jax.process_count() == 1:
            return self._asked
        return int(multihost_utils.process_allgather(np.int32(self._asked)).max())

    def _note(self, number: int, _: FrameType | None) -> None:
        self._asked = number
        for each in self._earlier:
            signal.signal(each, signal.SIG_DFL)
