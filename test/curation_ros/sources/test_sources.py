"""Sources of episodes: MCAP and a toy format meet the rules, and both can be scored."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from episodes import make_episode
from npz_source import NpzSource, write_npz
from streams import record

from curation_ros.cli.main import main
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import CurationError, EpisodeError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import find_episodes, read_episode, stamp_of
from curation_ros.sources import SOURCES, episodes_at, source_of
from curation_ros.sources.mcap import McapSource
from curation_ros.testing.sources import SOURCE_RULES, check_source

SAMPLE_BAG = Path(__file__).resolve().parents[3] / "bags" / "sample"
ROLES = {
    "eef_position": "effector",
    "joint_position": "observation",
    "twist": "action",
    "gripper": "gripper",
    "bowl_position": "object",
}


@pytest.fixture
def npz(tmp_path: Path, rng: np.random.Generator) -> Path:
    file = tmp_path / "recorded" / "demos.npz"
    file.parent.mkdir()
    write_npz(file, {f"demo-{k}": make_episode(rng, 240 + k) for k in range(3)}, ROLES)
    return file


# --- the rules ----------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", SOURCE_RULES)
def test_mcap_meets_the_rule(rule: str) -> None:
    check_source(McapSource(), SAMPLE_BAG, rules=[rule])


@pytest.mark.parametrize("rule", SOURCE_RULES)
def test_single_mcap_file_meets_the_rule(rule: str) -> None:
    [file] = SAMPLE_BAG.glob("*.mcap")
    check_source(McapSource(), file, rules=[rule])


@pytest.mark.parametrize("rule", SOURCE_RULES)
def test_toy_format_meets_the_rule(rule: str, npz: Path) -> None:
    check_source(NpzSource(), npz, rules=[rule])


class _Broken(NpzSource):
    """A source whose reading can be spoilt."""

    def read(self, path: Path, *args: Any, **options: Any) -> Episode:
        return self.spoil(super().read(path, *args, **options))

    def spoil(self, episode: Episode) -> Episode:
        return episode


class _ShoutsItsName(_Broken):
    name = "NPZ file"


class _TakesAnything(_Broken):
    def recognises(self, path: Path) -> bool:
        return True


class _Raises(_Broken):
    def recognises(self, path: Path) -> bool:
        return bool(np.load(path))


class _FindsAllAgain(_Broken):
    def find(self, path: Path) -> list[Path]:
        return super().find(path if path.suffix == ".npz" else path.parent)


class _FindsNothing(_Broken):
    def find(self, path: Path) -> list[Path]:
        return []


class _GivesEveryEpisodeOneId(_Broken):
    def spoil(self, episode: Episode) -> Episode:
        return replace(episode, id="1")


class _MintsIds(_Broken):
    def spoil(self, episode: Episode) -> Episode:
        return replace(episode, id=os.urandom(8).hex())


class _GoesBack(_Broken):
    def spoil(self, episode: Episode) -> Episode:
        return replace(episode, stamps_ns=episode.stamps_ns[::-1])


class _ReadsSinglePrecision(_Broken):
    def spoil(self, episode: Episode) -> Episode:
        fields: Any = {k: v.astype(np.float32) for k, v in episode.fields.items()}
        return replace(episode, fields=fields)


class _IgnoresTheMap(_Broken):
    def read(
        self, path: Path, topic_map: TopicMap | None = None, *, claimed_id: str = ""
    ) -> Episode:
        return super().read(path)


class _BelievesTheClaim(_Broken):
    def read(
        self, path: Path, topic_map: TopicMap | None = None, *, claimed_id: str = ""
    ) -> Episode:
        episode = super().read(path, topic_map)
        return replace(episode, id=claimed_id or episode.id)


class _HasNoStamp(_Broken):
    def stamp(self, path: Path) -> str:
        return ""


class _StampsAlike(_Broken):
    def stamp(self, path: Path) -> str:
        return "1" if self.recognises(path) else ""


class _LetsErrorsThrough(_Broken):
    def read(self, path: Path, *args: Any, **options: Any) -> Episode:
        try:
            return super().read(path, *args, **options)
        except CurationError as err:
            raise ValueError(str(err)) from err


class _HoldsALock(_Broken):
    def __reduce__(self) -> Any:
        raise TypeError("cannot pickle")


@pytest.mark.parametrize(
    ("kind", "broken"),
    [
        (_ShoutsItsName, "Its name is one"),
        (_TakesAnything, "It recognises its recordings"),
        (_Raises, "It recognises its recordings"),
        (_FindsAllAgain, "The path of an episode"),
        (_FindsNothing, "It finds at least one"),
        (_GivesEveryEpisodeOneId, "Each episode has an id"),
        (_MintsIds, "A second reading"),
        (_GoesBack, "An episode has steps"),
        (_ReadsSinglePrecision, "An episode has the fields"),
        (_IgnoresTheMap, "It builds the fields"),
        (_BelievesTheClaim, "A claimed id"),
        (_HasNoStamp, "The stamp of an episode"),
        (_StampsAlike, "The stamp of an episode"),
        (_LetsErrorsThrough, "A path that does not exist"),
        (_LetsErrorsThrough, "A truncated recording"),
        (_HoldsALock, "It can be sent"),
    ],
)
def test_source_that_breaks_a_rule_is_told_which(
    kind: type[NpzSource], broken: str, npz: Path
) -> None:
    [rule] = [sentence for sentence in SOURCE_RULES if sentence.startswith(broken)]
    with pytest.raises(AssertionError) as refused:
        check_source(kind(), npz, rules=[rule])
    assert f"{kind.__name__} breaks a rule: {rule}" in str(refused.value)
    check_source(NpzSource(), npz, rules=[rule])


# --- the table ----------------------------------------------------------------------------------


def test_names_of_the_table_are_those_of_the_sources() -> None:
    assert {name: source.name for name, source in SOURCES.items()} == {n: n for n in SOURCES}


def test_file_that_no_source_knows_is_read_by_the_first_which_says_what_it_is(
    tmp_path: Path,
) -> None:
    (tmp_path / "notes.txt").write_text("hello, these are notes")
    assert episodes_at(tmp_path) == []
    assert episodes_at(tmp_path / "notes.txt") == [tmp_path / "notes.txt"]
    with pytest.raises(CurationError, match=r"notes\.txt is no MCAP file"):
        read_episode(tmp_path / "notes.txt")
    assert episodes_at(tmp_path / "missing") == []


def test_folder_that_cannot_be_listed_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> list[Path]:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(EpisodeError, match=f"{tmp_path}: Permission denied"):
        episodes_at(tmp_path)


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """The one line that another format needs."""
    monkeypatch.setitem(SOURCES, "npz", NpzSource())


@pytest.mark.usefixtures("registered")
def test_folder_may_hold_several_formats(npz: Path) -> None:
    bag = npz.parent / "bag"
    shutil.copytree(SAMPLE_BAG, bag)
    demos = [npz / f"demo-{k}" for k in range(3)]
    assert find_episodes([npz.parent]) == [bag, *demos]
    assert find_episodes([demos[1], npz, bag]) == [demos[1], demos[0], demos[2], bag]
    assert source_of(bag).name == "mcap"
    assert source_of(demos[0]).name == source_of(npz).name == "npz"
    assert stamp_of(demos[0]) != ""
    assert read_episode(demos[1]).name == "demo-1"
    assert read_episode(bag).id == read_episode(SAMPLE_BAG).id


@pytest.mark.usefixtures("registered")
def test_dataset_may_hold_another_format(dataset: Dataset, npz: Path) -> None:
    bag = record(dataset, make_episode(n_steps=30))
    shutil.copy(npz, dataset.episodes_folder)
    inside = dataset.episodes_folder / npz.name
    assert find_episodes([dataset.path]) == [bag, *(inside / f"demo-{k}" for k in range(3))]
    assert read_episode(inside / "demo-0").findings == ()


# --- through the package ------------------------------------------------------------------------


@dataclass(frozen=True)
class _Told:
    code: int
    rows: list[dict[str, Any]]


@pytest.fixture
def scored(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Callable[..., _Told]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def run(*arguments: object) -> _Told:
        code = main(["score", *map(str, arguments), "--json"])
        out = capsys.readouterr().out
        return _Told(code, [json.loads(line) for line in out.splitlines()])

    return run


def _of_interest(rows: Sequence[dict[str, Any]]) -> list[tuple[Any, ...]]:
    return [(r["path"], r["episode"], r["decision"], r["scores"]) for r in rows]


@pytest.mark.usefixtures("registered")
def test_episodes_of_another_format_are_scored_kept_and_scored_again(
    scored: Callable[..., _Told], npz: Path
) -> None:
    first = scored(npz)
    assert first.code == 0
    assert [row["path"] for row in first.rows] == [f"{npz}/demo-{k}" for k in range(3)]
    assert all("error" not in row for row in first.rows)
    assert all(row["scores"]["smoothness"] is not None for row in first.rows)
    assert len({row["episode"] for row in first.rows}) == 3
    npz.touch()
    again = scored(npz)
    assert _of_interest(again.rows) == _of_interest(first.rows)
    one = scored(npz / "demo-1")
    assert _of_interest(one.rows) == _of_interest(first.rows[1:2])


@pytest.mark.usefixtures("registered")
def test_episodes_of_another_format_may_be_the_reference(
    scored: Callable[..., _Told], npz: Path, rng: np.random.Generator
) -> None:
    reference = npz.with_name("reference.npz")
    write_npz(reference, {f"good-{k}": make_episode(rng, 238 + k) for k in range(6)}, ROLES)
    told = scored(npz, "--reference", reference, "--scorers", "knn")
    assert told.code == 0
    assert all(row["scores"]["knn"] is not None for row in told.rows)


@pytest.mark.usefixtures("registered")
def test_spoilt_file_of_another_format_is_a_row_with_its_error(
    scored: Callable[..., _Told], npz: Path
) -> None:
    whole = npz.read_bytes()
    npz.write_bytes(whole[: len(whole) // 2])
    shutil.copytree(SAMPLE_BAG, npz.parent / "sample")
    told = scored(npz.parent / "sample", npz / "demo-1")
    assert [row.get("finding") for row in told.rows] == [None, "unreadable"]
    assert str(npz) in told.rows[1]["error"]
