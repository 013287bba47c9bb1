"""Names of start states: a benchmark's official ones, and any number of generated ones.

Demonstrations use generated starts, and so does every choice. The official ones are for the final
measurement alone. Each task makes the states that these names stand for.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from curation_ros.core.errors import ConfigError
from curation_ros.core.types import Floats

_SPEC_HELP = (
    "expected official:FIRST:END, generated:SEED:COUNT or generated:SEED:FIRST:END, "
    "several separated by commas"
)


@dataclass(frozen=True)
class Start:
    """A start state and its name.

    Attributes:
        name: `official-07`, or `generated-0-012` with seed and index.
        state: (k,) as `Environment.reset` takes it.
    """

    name: str
    state: Floats


def names_of(spec: str, n_official: int) -> list[str]:
    """Names of the starts that a specification means; nothing is simulated for it.

    Args:
        spec: `official:0:50` (first, end), `generated:0:24` (seed, count),
            `generated:0:24:48` (seed, first, end); or several of these, separated by commas.
        n_official: number of official starts of the task.

    Raises:
        ConfigError: if the text is no such specification.
    """
    names: list[str] = []
    for part in spec.split(","):
        kind, *texts = part.strip().split(":")
        numbers = [int(text) for text in texts if re.fullmatch(r"[0-9]{1,9}", text)]
        if len(numbers) != len(texts):
            raise ConfigError(f"starts {spec!r}: {part.strip()!r} is no range; {_SPEC_HELP}")
        if kind == "official" and len(numbers) == 2:
            first, end = numbers
            if end > n_official:
                raise ConfigError(f"starts {spec!r}: there are {n_official} official starts")
        elif kind == "generated" and len(numbers) in (2, 3):
            first, end = (0, numbers[1]) if len(numbers) == 2 else (numbers[1], numbers[2])
        else:
            raise ConfigError(f"starts {spec!r}: {part.strip()!r} is unknown; {_SPEC_HELP}")
        if first >= end:
            raise ConfigError(f"starts {spec!r}: {part.strip()!r} is empty; {_SPEC_HELP}")
        seeds: Sequence[int] = () if kind == "official" else (numbers[0],)
        names += [_name(kind, *seeds, index) for index in range(first, end)]
    if len(set(names)) != len(names):
        raise ConfigError(f"starts {spec!r}: some start is named twice")
    return names


def official_name(index: int) -> str:
    """Name of an official start."""
    return _name("official", index)


def generated_name(seed: int, index: int) -> str:
    """Name of a generated start."""
    return _name("generated", seed, index)


def read_start_name(name: str) -> tuple[int | None, int]:
    """Read the name of a start.

    Returns:
        Seed, None for an official start; and index.

    Raises:
        ConfigError: if it is no such name.
    """
    found = re.fullmatch(r"(?:official|generated-([0-9]{1,9}))-([0-9]{1,9})", name)
    if not found:
        raise ConfigError(f"start {name!r} is unknown; expected official-07 or generated-0-012")
    return None if found[1] is None else int(found[1]), int(found[2])


def _name(kind: str, *numbers: int) -> str:
    *seeds, index = numbers
    digits = 2 if kind == "official" else 3
    return "-".join([kind, *map(str, seeds), f"{index:0{digits}d}"])
