from __future__ import annotations

import multiprocessing
import uuid

import pytest

from curation_ros.core.episode.identity import foreign_episode_id, new_episode_id, resolve_prefix
from curation_ros.core.errors import EpisodeError

SHA = "ab" * 32
KNOWN = [
    ("0197aaaa-0000-7000-8000-000000000001", "pick-1"),
    ("0197aaaa-0000-7000-8000-000000000002", "pick-2"),
    ("0197bbbb-0000-7000-8000-000000000003", "pick-2"),
    ("0197cccc-0000-7000-8000-000000000004", ""),
]


def test_ids_are_version_7_in_the_order_of_their_minting() -> None:
    ids = [new_episode_id() for _ in range(2000)]
    assert {uuid.UUID(i).version for i in ids} == {7}
    assert len(set(ids)) == len(ids)
    assert ids == sorted(ids)
    assert all(i == i.lower() and len(i) == 36 for i in ids)


def _mint(n: int) -> list[str]:
    return [new_episode_id() for _ in range(n)]


def test_processes_that_mint_at_once_mint_different_ids() -> None:
    with multiprocessing.get_context("fork").Pool(2) as pool:
        minted = pool.map(_mint, [300] * 4)
    assert len({i for ids in minted for i in ids}) == 4 * 300


def test_foreign_bag_has_the_same_id_everywhere() -> None:
    found = foreign_episode_id(SHA, 1_700_000_000_000_000_000)
    assert found == str(uuid.uuid5(uuid.NAMESPACE_URL, f"sha256:{SHA}:1700000000000000000"))
    assert uuid.UUID(found).version == 5
    assert foreign_episode_id(SHA, 1_700_000_000_000_000_001) != found
    assert foreign_episode_id("cd" * 32, 1_700_000_000_000_000_000) != found


@pytest.mark.parametrize(
    "typed",
    [
        KNOWN[0][0],
        "pick-1",
        "  pick-1\n",
        "0197aaaa-0000-7000-8000-000000000001",
        "0197AAAA-0000-7000-8000-000000000001",
    ],
)
def test_whole_id_and_short_name_find_their_episode(typed: str) -> None:
    assert resolve_prefix(typed, KNOWN) == KNOWN[0][0]


@pytest.mark.parametrize("typed", ["0197c", "0197C", "0197cccc-0000"])
def test_beginning_of_an_id_finds_its_episode(typed: str) -> None:
    assert resolve_prefix(typed, KNOWN) == KNOWN[3][0]


@pytest.mark.parametrize(("typed", "n"), [("0197", 4), ("0197a", 2), ("pick-2", 2)])
def test_what_means_several_episodes_is_refused_with_their_number(typed: str, n: int) -> None:
    with pytest.raises(EpisodeError, match=f"means {n} episodes") as refused:
        resolve_prefix(typed, KNOWN)
    assert KNOWN[1][0] in str(refused.value)


@pytest.mark.parametrize("typed", ["", " ", "pick", "pick-3", "7aaaa", "0198"])
def test_what_means_no_episode_is_refused(typed: str) -> None:
    with pytest.raises(EpisodeError, match="no episode has the id or name"):
        resolve_prefix(typed, KNOWN)


def test_nothing_is_found_among_nothing() -> None:
    with pytest.raises(EpisodeError, match="0 are known"):
        resolve_prefix("pick-1", [])


def test_name_wins_over_the_beginning_of_another_id() -> None:
    pairs = [*KNOWN, ("ffff0000-0000-7000-8000-000000000005", "0197a")]
    assert resolve_prefix("0197a", pairs) == "ffff0000-0000-7000-8000-000000000005"
