"""The one root of every error that a user can cause, and its leaves."""

from __future__ import annotations


class CurationError(Exception):
    """Anything wrong with input, configuration or the outside world; the message is one line.

    Attributes:
        finding: id in `findings.FINDINGS` of what is wrong with the input; empty if the input is
            not to blame. By default that of the class.
    """

    finding: str = ""

    def __init__(self, *args: object, finding: str = "") -> None:
        """Make an error of its message and, where one fits, the id of a finding."""
        super().__init__(*(_one_line(a) if isinstance(a, str) else a for a in args))
        if finding:
            self.finding = finding


def _one_line(text: str) -> str:
    """The text with line breaks and other control characters as escapes.

    Names of topics and files may have any.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


class ConfigError(CurationError):
    """A parameter, a topic map or a command line that does not make sense."""

    finding = "bad-config"


class EpisodeError(CurationError):
    """An episode that cannot be built, found or used."""

    finding = "unusable"


class BagError(CurationError):
    """A bag that cannot be read or written."""

    finding = "unreadable"


class NotFittedError(CurationError):
    """A scorer, rule or length control that was used before `fit`."""


class SimError(CurationError):
    """The simulator could not be started, or its state diverged."""


class PolicyError(CurationError):
    """A policy that cannot be trained, loaded or driven."""
