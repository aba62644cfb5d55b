"""Wrong input, said in one line.

Mitsuba reports what is wrong with a scene in RuntimeErrors of several lines, each preceded by the
place in Mitsuba's own source ("[parser.cpp:444] While loading …:\\n  - float \\"foo\\": 1").
:func:`one_line` keeps file, line and cause and drops the rest.
"""

from __future__ import annotations

import re


class InputError(Exception):
    """The user asked for something that cannot be done; the message is one line that says what."""


class Unsupported(ValueError):
    """The variant or the scene asks for something that this integrator does not do; the message is
    one sentence that names it."""


class Failed(RuntimeError):
    """Rendering cannot go on, for a reason outside of scene and parameters (workers that are gone,
    for example); the message is one line that says what, and what to do."""


# "[parser.cpp:444] " and "[PluginManager] ", where a message or a nested message starts
_ORIGIN = re.compile(r"(^|:\s+|\n\s*)\[[A-Za-z_]\w*(?:\.(?:cpp|h|py):\d+)?\]\s+")


def one_line(error: BaseException | str) -> str:
    """The text of ``error`` without Mitsuba's source positions, line breaks and bullets."""
    text = error if isinstance(error, str) else _root(error)
    while _ORIGIN.search(text):
        text = _ORIGIN.sub(r"\1", text)

    lines = [line.strip() for line in _without_traceback(text).splitlines()]
    text = ""
    for line in filter(None, lines):
        bullet = line.startswith(("- ", "→ "))
        separator = "; " if bullet and text and not text.endswith(":") else " "
        text += separator + line.removeprefix("- ").removeprefix("→ ")
    return text.strip() or type(error).__name__


def _without_traceback(text: str) -> str:
    # A Python plugin that refuses its parameters arrives with its traceback: keep both ends.
    head, found, rest = text.partition("Traceback (most recent call last):\n")
    if not found:
        return text
    lines = rest.splitlines()
    while lines and lines[0][:1].isspace():
        lines.pop(0)
    return head + re.sub(r"^[\w.]*(?:Error|Exception): ", "", "\n".join(lines))


def _root(error: BaseException) -> str:
    # Dr.Jit wraps what goes wrong in a kernel in "…error while performing… (see above)".
    while error.__cause__ is not None and "see above" in str(error):
        error = error.__cause__
    return str(error)


def is_interrupt(error: BaseException) -> bool:
    """Whether ``error`` is Ctrl-C, itself or below what was raised because of it."""
    below: BaseException | None = error
    while below is not None:
        if isinstance(below, KeyboardInterrupt):
            return True
        below = below.__cause__ or below.__context__
    return False
