"""How episodes are ranked, and how equal scores are ordered: by a hash, never by id or time."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

#: Episode id -> key that orders equal scores.
TieKey: TypeAlias = Callable[[str], str]


def tie_key(seed: int, *identity: object) -> str:
    """Key that orders episodes of equal score by nothing but a hash.

    Args:
        seed: seed of the selection.
        identity: (task, start, repetition) where they are known, else the episode's id. Never a
            time, a path or a running number of the collection.
    """
    text = "\x1f".join(str(part) for part in (seed, *identity))
    return hashlib.sha256(text.encode()).hexdigest()


def unique(tie: TieKey | None, seed: int = 0) -> TieKey:
    """A tie key that is different for each episode.

    Two episodes of one start may share a key. Without a second one, their order in the dataset
    would decide.

    Args:
        tie: the key that counts first; None: there is none.
        seed: seed of the key by id, which counts last.
    """

    def key(episode_id: str) -> str:
        by_id = tie_key(seed, episode_id)
        # The separator sorts before every printable character, so that this orders like a pair.
        return by_id if tie is None else f"{tie(episode_id)}\x1f{by_id}"

    return key


def ranking(scores: Mapping[str, float], tie: Callable[[str], Any]) -> list[str]:
    """Ids from the best score to the worst, equal scores in the order of their tie keys.

    Args:
        scores: id -> score.
        tie: id -> key that can be ordered.
    """
    return sorted(scores, key=lambda i: (-scores[i], tie(i)))
