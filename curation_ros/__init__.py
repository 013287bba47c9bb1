"""Curate robot demonstrations: read episodes, score them, decide, and select what to train on.

>>> import curation_ros as cr
>>> collection = cr.open("bags/sample")
>>> collection
Collection('bags/sample', 1 episode)
>>> episode = collection.episodes[0]
>>> episode.name, len(episode)
('demo-0002', 223)
>>> [scored] = cr.score(collection)
>>> scored.verdict
'keep'
>>> round(scored.scores["smoothness"], 3)
-2.491

Data that never was in a bag is scored in the same way, see `Episode.from_arrays`. Tables are
pandas frames if pandas is installed, otherwise lists of dicts.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from curation_ros.version import __version__

if TYPE_CHECKING:
    from curation_ros.api import Collection as Collection
    from curation_ros.api import ScoredEpisodes as ScoredEpisodes
    from curation_ros.api import open as open
    from curation_ros.api import read_episode as read_episode
    from curation_ros.api import score as score
    from curation_ros.batch.scored import Scored as Scored
    from curation_ros.core.decision.decision import Decision as Decision
    from curation_ros.core.decision.manifest import Manifest as Manifest
    from curation_ros.core.episode.episode import Episode as Episode
    from curation_ros.core.episode.findings import Finding as Finding
    from curation_ros.core.episode.topic_map import TopicMap as TopicMap
    from curation_ros.core.episode.topic_map import read_topic_map as read_topic_map
    from curation_ros.core.errors import CurationError as CurationError

#: Name -> the module that defines it. A module is imported when its name is first used, so that
#: `import curation_ros` costs next to nothing.
_HOMES = {
    "open": "curation_ros.api",
    "score": "curation_ros.api",
    "read_episode": "curation_ros.api",
    "Collection": "curation_ros.api",
    "ScoredEpisodes": "curation_ros.api",
    "Scored": "curation_ros.batch.scored",
    "Episode": "curation_ros.core.episode.episode",
    "Finding": "curation_ros.core.episode.findings",
    "TopicMap": "curation_ros.core.episode.topic_map",
    "read_topic_map": "curation_ros.core.episode.topic_map",
    "Decision": "curation_ros.core.decision.decision",
    "Manifest": "curation_ros.core.decision.manifest",
    "CurationError": "curation_ros.core.errors",
}

__all__ = [
    "Collection",
    "CurationError",
    "Decision",
    "Episode",
    "Finding",
    "Manifest",
    "Scored",
    "ScoredEpisodes",
    "TopicMap",
    "__version__",
    "open",
    "read_episode",
    "read_topic_map",
    "score",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
