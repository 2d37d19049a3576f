"""Errors that end as one clear line. Each names the exit code of the command line."""

from collections.abc import Iterator
from contextlib import contextmanager


class Gimp3dError(Exception):
    """Base of every error that a user can act on; the message says what, where, and what to do."""

    exit_code = 1


class BadInput(Gimp3dError):
    """A file, option or value cannot be used as given."""

    exit_code = 2


class IllPosed(Gimp3dError):
    """The input is legal but the task has no defined answer (docs/method.md)."""

    exit_code = 3


class Terminated(KeyboardInterrupt):
    """The system asked to stop (SIGTERM, SIGHUP); like Ctrl-C, no `except Exception` may swallow it."""

    def __init__(self, signal_number: int) -> None:
        super().__init__(signal_number)
        self.exit_code = 128 + signal_number


class Cancelled(Gimp3dError):
    """The caller asked to stop."""

    exit_code = 130


def one_line(text: object, most: int = 300) -> str:
    """What somebody outside says, for an error's line."""
    return " ".join(str(text).split())[:most]


@contextmanager
def refusing(what: str, *kinds: type[Exception]) -> Iterator[None]:
    """Errors of these kinds inside end as BadInput: `what` went wrong, with the reason in brackets."""
    try:
        yield
    except kinds as error:
        raise BadInput(f"{what} ({one_line(getattr(error, 'strerror', None) or error)})") from None
