"""The one root of every error that a user can cause, and its leaves."""

from __future__ import annotations


class CurationError(Exception):
    """Anything wrong with input, configuration or the outside world; the message is one line."""


class ConfigError(CurationError):
    """A parameter, a topic map or a command line that does not make sense."""


class EpisodeError(CurationError):
    """An episode that cannot be built, found or used."""


class BagError(CurationError):
    """A bag that cannot be read or written."""


class NotFittedError(CurationError):
    """A scorer, rule or length control that was used before `fit`."""


class SimError(CurationError):
    """The simulator could not be started, or its state diverged."""


class PolicyError(CurationError):
    """A policy that cannot be trained, loaded or driven."""
