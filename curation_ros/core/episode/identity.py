"""Identity of episodes: minted once, carried everywhere, never derived from a position."""

from __future__ import annotations

import re
import uuid
from collections.abc import Iterable

from uuid6 import uuid7

from curation_ros.core.errors import EpisodeError

_UUID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")


def new_episode_id() -> str:
    """Mint a UUID version 7: unique anywhere, sortable by the time of its minting."""
    return str(uuid7())


def is_uuid(text: str) -> bool:
    """Whether a text has the form in which ids are minted."""
    return _UUID.fullmatch(text) is not None


def foreign_episode_id(sha256_hex: str, start_ns: int) -> str:
    """Identity of an episode that our recorder did not record.

    Args:
        sha256_hex: digest of its recording, such as the first .mcap file of a bag.
        start_ns: first stamp of the episode.

    Returns:
        A UUID version 5, the same on every machine for the same recording.
    """
    return str(uuid.uuid5(uuid.NAMESPACE_URL, f"sha256:{sha256_hex}:{start_ns}"))


def resolve_prefix(prefix: str, names_by_id: Iterable[tuple[str, str]]) -> str:
    """Find the one episode with a short name, or with an id that begins with a text.

    Args:
        prefix: what was typed: a whole id, an unambiguous beginning of one, or a short name.
        names_by_id: pairs (id, short name) of the known episodes.

    Raises:
        EpisodeError: if nothing or more than one episode fits.
    """
    pairs = list(names_by_id)
    wanted = prefix.strip()
    found: set[str] = set()
    if wanted:
        found = {i for i, name in pairs if wanted in (i, name)}
        found = found or {i for i, _ in pairs if i.startswith(wanted.lower())}
    if len(found) == 1:
        return found.pop()
    if not found:
        raise EpisodeError(f"no episode has the id or name {prefix!r}; {len(pairs)} are known")
    raise EpisodeError(
        f"{prefix!r} means {len(found)} episodes ({', '.join(sorted(found)[:3])} ...): "
        "type more characters of the id"
    )
