"""Files that a person configures us by: the topic map, the curation, the reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from curation_ros.bags.reader import find_bags, read_episode
from curation_ros.core.episode import Episode
from curation_ros.core.errors import ConfigError
from curation_ros.core.scoring import Curation
from curation_ros.core.topic_map import TopicMap, read_topic_map

_SOURCE = Path(__file__).resolve().parents[1]


def share_file(relative: str) -> Path:
    """A file of this package's share folder: of the source tree, or of an installation.

    Raises:
        ConfigError: if it is in neither.
    """
    # The prefix is some folders above <prefix>/lib/python3.x/site-packages, with pip and colcon
    # alike. It need not be sys.prefix: a workspace of colcon lies over an environment.
    share = Path("share") / "curation_ros" / relative
    for candidate in (_SOURCE / relative, *(folder / share for folder in _SOURCE.parents)):
        if candidate.is_file():
            return candidate
    raise ConfigError(f"{relative}: neither in {_SOURCE} nor in {share} of a folder above it")


def topic_map_or_default(path: str) -> TopicMap:
    """The topic map of a file, or for an empty path that of the LIBERO robot.

    Raises:
        ConfigError: if the file is none.
    """
    return read_topic_map(Path(path) if path else share_file("config/topics.yaml"))


def read_curation(config: Path | None, overrides: Mapping[str, Any]) -> Curation:
    """Make an unfitted Curation from a YAML file and what a caller sets beside it.

    Args:
        config: `config/curation.yaml` or one like it; None takes the defaults.
        overrides: keywords of Curation that win over the file; empty values do not.

    Raises:
        ConfigError: naming file and key.
    """
    settings: dict[str, Any] = {}
    if config is not None:
        try:
            raw = yaml.safe_load(config.read_text())
        except OSError as err:
            raise ConfigError(f"curation config {config}: {err.strerror}") from err
        except (yaml.YAMLError, UnicodeDecodeError) as err:
            reason = str(err).splitlines()[0]
            raise ConfigError(f"curation config {config} is not YAML: {reason}") from err
        if not isinstance(raw, dict):
            raise ConfigError(f"curation config {config}: expected a mapping, found {raw!r:.60}")
        settings.update(raw)
    settings.update({k: v for k, v in overrides.items() if v})
    try:
        return Curation(**settings)
    except TypeError as err:
        raise ConfigError(f"curation config {config}: {err}") from err


def read_reference(paths: Sequence[Path], topic_map: TopicMap | None) -> list[Episode]:
    """Read the reference demonstrations.

    Args:
        paths: datasets or bags.
        topic_map: the one that the episodes to judge are built by; None: that of each bag.

    Raises:
        CurationError: if one cannot be read, or there is none.
    """
    episodes = [read_episode(bag, topic_map) for bag in find_bags(paths)]
    if not episodes:
        raise ConfigError(f"reference {', '.join(map(str, paths))}: no episode in it")
    return episodes
