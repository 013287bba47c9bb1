"""The index file: examinations in it, and what becomes of files of older versions."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from streams import record, short_episode

from curation_ros.core.decision.decision import Decision
from curation_ros.core.decision.examination import Examination
from curation_ros.core.errors import CurationError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.index import Index

#: The schema as it was at version 2.
VERSION_2 = """
CREATE TABLE episodes (
    id TEXT PRIMARY KEY, name TEXT NOT NULL, path TEXT NOT NULL, start_ns INTEGER NOT NULL,
    end_ns INTEGER NOT NULL, event TEXT NOT NULL, source TEXT NOT NULL,
    recovered INTEGER NOT NULL);
CREATE TABLE decisions (
    episode TEXT NOT NULL, revision INTEGER NOT NULL, verdict TEXT NOT NULL, reason TEXT NOT NULL,
    by TEXT NOT NULL, state_hash TEXT NOT NULL, span_start INTEGER NOT NULL,
    span_end INTEGER NOT NULL, content TEXT NOT NULL, PRIMARY KEY (episode, revision));
CREATE INDEX decisions_content ON decisions (content);
CREATE TABLE scores (
    episode TEXT NOT NULL, scorer TEXT NOT NULL, scoring_hash TEXT NOT NULL, value REAL,
    abstained TEXT, PRIMARY KEY (episode, scorer, scoring_hash));
CREATE TABLE selections (
    name TEXT PRIMARY KEY, path TEXT NOT NULL, created_at TEXT NOT NULL, kept INTEGER NOT NULL,
    total INTEGER NOT NULL);
CREATE TABLE examinations (
    bag TEXT NOT NULL, scoring_hash TEXT NOT NULL, stamp TEXT NOT NULL, result TEXT NOT NULL,
    PRIMARY KEY (bag, scoring_hash));
PRAGMA user_version = 2;
"""


EXAMINATION = Examination(
    "a", "n", steps=3, span=(0, 7), scores={"length": 3.0, "knn": None}, content="c0ffee"
)


def _decision(episode: str, content: str) -> Decision:
    return Decision(episode, "n", "keep", "good", (0, 1), evidence={"content": content})


# --- examinations -------------------------------------------------------------------------------


def test_examination_is_found_while_key_and_stamp_are_the_same(
    dataset: Dataset,
) -> None:
    bags = [dataset.bag_path(name) for name in ("a", "b", "c")]
    found = dict.fromkeys(bags, EXAMINATION)
    index = Index.covering(bags[0])
    assert index.path == dataset.index.path
    assert index.examinations("key", dict.fromkeys(bags, "1")) == {}
    index.keep_examinations("key", found, {bags[0]: "1", bags[1]: "1", bags[2]: ""})
    now = {bags[0]: "1", bags[1]: "2", bags[2]: ""}  # changed since; cannot be told
    assert index.examinations("key", now) == {bags[0]: found[bags[0]]}
    assert index.examinations("another key", now) == {}


def test_examinations_of_more_bags_than_one_statement_takes_are_found(
    dataset: Dataset,
) -> None:
    bags = [dataset.bag_path(f"{k:04d}") for k in range(1234)]
    found = dict.fromkeys(bags, EXAMINATION)
    stamps = dict.fromkeys(bags, "1")
    dataset.index.keep_examinations("key", found, stamps)
    assert dataset.index.examinations("key", stamps) == found


def test_examinations_outside_of_datasets_are_in_the_cache_of_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    bag = tmp_path / "bags" / "a"
    bag.mkdir(parents=True)
    index = Index.covering(bag)
    index.keep_examinations("key", {bag: EXAMINATION}, {bag: "1"})
    assert list(index.examinations("key", {bag: "1"})) == [bag]
    assert index.path.parent == tmp_path / "cache" / "curation_ros"
    assert [p.name for p in (tmp_path / "bags").iterdir()] == ["a"]


# --- older files --------------------------------------------------------------------------------


def _made_by_version_2(dataset: Dataset, rng: np.random.Generator) -> Path:
    """An index with a bag, a decision on it, and EXAMINATION of it; returns the bag."""
    episode = short_episode(rng, 3, name="pick-1")
    bag = record(dataset, episode)
    dataset.append_decision(_decision(episode.id, "c0ffee"))
    dataset.refresh()
    dataset.index.keep_examinations("key", {bag: EXAMINATION}, {bag: "1"})
    with closing(sqlite3.connect(dataset.index.path)) as new:
        rows = {
            t: new.execute(f"SELECT * FROM {t}").fetchall() for t in ("episodes", "examinations")
        }
    for file in dataset.path.glob("index.sqlite*"):
        file.unlink()
    with closing(sqlite3.connect(dataset.index.path)) as old:
        old.execute("PRAGMA journal_mode=WAL")
        old.executescript(VERSION_2)
        old.executemany("INSERT INTO episodes VALUES (?,?,?,?,?,?,?,?)", rows["episodes"])
        old.executemany("INSERT INTO examinations VALUES (?,?,?,?)", rows["examinations"])
        decided = (episode.id, 1, "keep", "good", "curator", "", 0, 1, "c0ffee")
        old.execute("INSERT INTO decisions VALUES (?,?,?,?,?,?,?,?,?)", decided)
        old.execute("INSERT INTO scores VALUES (?, 'knn', 'abc', 0.5, NULL)", (episode.id,))
        old.execute("INSERT INTO selections VALUES ('mine', 'mine.json', 'now', 1, 1)")
        old.commit()
    return bag


def test_index_of_version_2_is_upgraded_without_a_word_and_keeps_what_is_read(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    bag = _made_by_version_2(dataset, rng)
    dataset.bag_path(bag.name).rename(bag.with_name(".hidden"))  # nothing is read again
    assert dataset.index.examinations("key", {bag: "1"}) == {bag: EXAMINATION}
    assert [e.id for e in dataset.index.episodes()] == [bag.name]
    assert dataset.with_content("c0ffee", other_than="z") == (bag.name, "pick-1")
    dataset.append_decision(_decision("y", "beef"))
    assert dataset.with_content("beef", other_than="z") == ("y", "")
    with closing(sqlite3.connect(dataset.index.path)) as db:
        tables = db.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    assert {name for (name,) in tables} == {"episodes", "decisions", "examinations"}


def test_upgraded_index_equals_one_that_is_made_anew(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    _made_by_version_2(dataset, rng)
    assert dataset.refresh() == []

    def schema_and_rows() -> list[list[tuple[object, ...]]]:
        with closing(sqlite3.connect(dataset.index.path)) as db:
            queries = (
                "SELECT type, name, sql FROM sqlite_master ORDER BY name",
                "SELECT * FROM episodes",
                "SELECT * FROM decisions",
                "PRAGMA user_version",
            )
            return [db.execute(query).fetchall() for query in queries]

    upgraded = schema_and_rows()
    for file in dataset.path.glob("index.sqlite*"):
        file.unlink()
    assert dataset.rebuild() == []
    assert schema_and_rows() == upgraded


def test_connection_of_before_the_upgrade_ends_its_transaction_on_what_it_began_with(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    bag = _made_by_version_2(dataset, rng)
    with closing(sqlite3.connect(dataset.index.path)) as old:
        old.execute("BEGIN")
        assert old.execute("SELECT count(*) FROM scores").fetchone() == (1,)
        assert [e.id for e in dataset.index.episodes()] == [bag.name]
        assert old.execute("SELECT count(*) FROM scores").fetchone() == (1,)


@pytest.mark.parametrize("version", [1, 99])
def test_index_of_an_unknown_version_is_made_anew_by_refresh(
    dataset: Dataset, rng: np.random.Generator, version: int
) -> None:
    episode = short_episode(rng, 3)
    record(dataset, episode)
    dataset.append_decision(_decision(episode.id, "c0ffee"))
    with closing(sqlite3.connect(dataset.index.path)) as db:
        db.execute(f"PRAGMA user_version = {version}")
    with pytest.raises(CurationError, match=f"version {version}"):
        dataset.index.episodes()
    assert dataset.refresh() == []
    assert [e.id for e in dataset.index.episodes()] == [episode.id]
    assert dataset.with_content("c0ffee", other_than="z") == (episode.id, episode.name)


def test_amended_decision_replaces_the_content_of_its_revision(dataset: Dataset) -> None:
    logged = dataset.append_decision(_decision("a", "c0ffee"))
    assert logged is not None
    dataset.append_decision(replace(logged, evidence={"content": "beef"}), amend=True)
    assert dataset.with_content("c0ffee", other_than="z") is None
    assert dataset.with_content("beef", other_than="z") == ("a", "")
    assert dataset.with_content("beef", other_than="a") is None
