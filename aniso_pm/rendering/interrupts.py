"""Ctrl-C that Python loses.

KeyboardInterrupt is raised wherever Python happens to be. In a finaliser, or in a callback of a
compiled library, it is printed or dropped, and the program goes on as if nobody had asked it to
stop.
"""

from __future__ import annotations

import signal
import threading


class Interrupts:
    """Remembers Ctrl-C while it is entered, where that raises KeyboardInterrupt."""

    def __init__(self):
        self._seen = self._listens = False

    def __enter__(self) -> Interrupts:
        usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
        # Other threads have no say in what becomes of signals.
        if usual and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, self._note)
            self._listens = True
        return self

    def __exit__(self, *_):
        if self._listens:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _note(self, number, frame):
        self._seen = True
        signal.default_int_handler(number, frame)

    def check(self):
        """Raise KeyboardInterrupt if there was one that nobody has acted on."""
        if self._seen:
            raise KeyboardInterrupt
