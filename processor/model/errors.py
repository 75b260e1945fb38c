"""Errors for people: one message that names what came, what was expected and what to do."""

import difflib
import re
from collections.abc import Iterable
from pathlib import Path

LONGEST_NAME = 256  # characters: longer names are not names, and comparing them would take seconds


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return " (did you mean ...?)" with the names most like one that is not known; nothing where none is like it."""
    by_form = {_plain(one): one for one in known}
    like = [by_form[form] for form in difflib.get_close_matches(_plain(name), by_form, n=2, cutoff=0.6)]
    return f" (did you mean {' or '.join(map(repr, like))}?)" if like else ""


def _plain(name: str) -> str:
    """Return a name without case and separators, as names are mistyped."""
    return "".join(character for character in name[:LONGEST_NAME].lower() if character.isalnum())


LONGEST_WORD, LONGEST_MESSAGE = 1_000, 6_000  # characters: an array typed as a word is cut to a fifth


class PlainError(ValueError):
    """An error of one message for people; of what came by the megabyte, the message shows the beginning.

    It is a ValueError, as callers of the Python interface expect of wrong arguments: where code catches ValueError
    around what may raise one of these, it lets these pass first.
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(_shortened(message))


def _shortened(message: str) -> str:
    short = re.sub(rf"\S{{{LONGEST_WORD},}}", lambda word: f"{word[0][: LONGEST_WORD // 5]}...", message)
    cut = len(short) - LONGEST_MESSAGE
    return f"{short[:LONGEST_MESSAGE]}... ({cut} characters more)" if cut > 0 else short


class InputError(PlainError):
    """Input that cannot be used. The message names the file, what was expected, what came and what to do.

    ``path`` is the file or folder that the message begins with, None where it begins otherwise; ``problem`` is the
    message without it.
    """

    def __init__(self, problem: str = "", *, path: Path | str | None = None) -> None:
        super().__init__(problem if path is None else f"{path}: {problem}")
        self.path = None if path is None else Path(path)
        self.problem = _shortened(problem)


class UsageError(PlainError):
    """A command, recipe or parameter that the program does not understand; the message says what it would take."""
