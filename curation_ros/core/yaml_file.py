"""Reads YAML files that people write."""

from __future__ import annotations

from pathlib import Path

import yaml

from curation_ros.core.errors import ConfigError


def read_yaml(path: Path, what: str) -> object:
    """Read a YAML file.

    Args:
        path: of the file.
        what: kind of the file for the error, such as `topic map`.

    Returns:
        What the file holds, as plain data.

    Raises:
        ConfigError: if the file cannot be read or is not YAML; it names the file and the line.
    """
    try:
        return yaml.safe_load(path.read_text())
    except OSError as err:
        raise ConfigError(f"{what} {path}: {err.strerror}") from err
    except (yaml.YAMLError, ValueError) as err:  # an impossible date is a ValueError
        mark = getattr(err, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark is not None else ""
        problem = getattr(err, "problem", None) or str(err).splitlines()[0]
        raise ConfigError(f"{what} {path} is not YAML{line}: {problem}") from err
