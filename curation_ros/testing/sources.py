"""What every source of episodes must do, as checks that a source of any format can run through.

For example, in a test of that format::

    import pytest
    from curation_ros.testing.sources import SOURCE_RULES, check_source

    @pytest.mark.parametrize("rule", SOURCE_RULES)
    def test_source(rule):
        check_source(MySource(), recordings, rules=[rule])
"""

from __future__ import annotations

import os
import pickle
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import CurationError
from curation_ros.sources import Source
from curation_ros.testing.rules import Rules, expect


@dataclass(frozen=True)
class _Case:
    """A source under test, and a path with sound episodes."""

    source: Source
    path: Path

    @cached_property
    def found(self) -> list[Path]:
        """Paths of the episodes."""
        return self.source.find(self.path)

    @cached_property
    def episodes(self) -> list[Episode]:
        """All of them, read once."""
        return [self.source.read(path) for path in self.found]

    @contextmanager
    def copy(self) -> Iterator[Path]:
        """A copy of the recordings elsewhere, under the same name."""
        with tempfile.TemporaryDirectory() as folder:
            target = Path(folder) / self.path.name
            if self.path.is_dir():
                shutil.copytree(self.path, target)
            else:
                shutil.copy2(self.path, target)
            yield target


#: Rule -> its check. Each rule is a sentence about every source.
SOURCE_RULES: Rules[_Case] = Rules()
_rule = SOURCE_RULES.rule


def check_source(source: Source, path: Path, *, rules: Collection[str] = ()) -> None:
    """Check that a source does what every source must do.

    Args:
        source: the source.
        path: a file or folder that it recognises, with at least one sound episode that comes with
            its topic map. With two or more episodes more is checked. Nothing in it is changed.
        rules: keys of SOURCE_RULES; by default all of them.

    Raises:
        AssertionError: naming the source, the rule it breaks, and how.
        KeyError: if there is no such rule.
    """
    SOURCE_RULES.check(_Case(source, path), type(source).__name__, rules)


# --- finding ------------------------------------------------------------------------------------


@_rule("Its name is one lower-case word.")
def _has_a_name(case: _Case) -> None:
    name = case.source.name
    expect(name.isidentifier() and name == name.lower(), f"its name is {name!r}")


@_rule("It recognises its recordings, and nothing else; it never raises.")
def _recognises(case: _Case) -> None:
    expect(case.source.recognises(case.path), f"it does not recognise {case.path}")
    with tempfile.TemporaryDirectory() as folder:
        text = Path(folder) / "notes.txt"
        text.write_text("nothing was recorded here")
        empty = Path(folder) / "empty"
        empty.mkdir()
        for other in (text, empty, Path(folder), Path(folder) / "missing"):
            expect(not case.source.recognises(other), f"it recognises {other.name or other}")


@_rule("It finds at least one episode, each once, always in the same order.")
def _finds(case: _Case) -> None:
    expect(case.found, f"it finds no episode at {case.path}")
    expect(len(set(case.found)) == len(case.found), "it finds an episode twice")
    expect(case.source.find(case.path) == case.found, "it finds other episodes the second time")


@_rule("The path of an episode is recognised, and leads to that episode alone.")
def _episodes_have_paths(case: _Case) -> None:
    for path in case.found:
        expect(path.is_relative_to(case.path), f"{path} is not inside {case.path}")
        expect(case.source.recognises(path), f"it does not recognise {path}")
        inside = case.source.find(path)
        expect(inside == [path], f"at {path} it finds {inside}")


# --- reading ------------------------------------------------------------------------------------


@_rule("An episode has steps, in the order of their stamps, inside its window.")
def _has_steps(case: _Case) -> None:
    for episode in case.episodes:
        stamps = episode.stamps_ns
        expect(len(stamps) > 0, f"{episode.id} has no step")
        expect(stamps.dtype == np.int64, f"stamps_ns are {stamps.dtype}, expected int64")
        expect((np.diff(stamps) > 0).all(), f"stamps of {episode.id} do not increase")
        first, last = int(stamps[0]), int(stamps[-1])
        window = f"{episode.start_ns} to {episode.end_ns}"
        expect(
            episode.start_ns <= first and last <= episode.end_ns,
            f"stamps from {first} to {last} are not inside {window}",
        )


@_rule("An episode has the fields of its topic map, as (T, D) arrays of float64.")
def _has_fields(case: _Case) -> None:
    for episode in case.episodes:
        expected = list(episode.topic_map.fields)
        expect(sorted(episode.fields) == sorted(expected), f"fields are {list(episode.fields)}")
        for name, values in episode.fields.items():
            shape = (len(episode), len(episode.topic_map.fields[name].values))
            expect(values.shape == shape, f"{name} has shape {values.shape}, expected {shape}")
            expect(values.dtype == np.float64, f"{name} is {values.dtype}, expected float64")


@_rule("A second reading is equal.")
def _reads_the_same(case: _Case) -> None:
    for path, episode in zip(case.found, case.episodes, strict=True):
        again = case.source.read(path)
        expect(_is_equal(again, episode), f"{path} reads differently the second time")


@_rule("It builds the fields of a given topic map, and no others.")
def _reads_by_a_map(case: _Case) -> None:
    path, episode = case.found[0], case.episodes[0]
    again = case.source.read(path, episode.topic_map)
    expect(_is_equal(again, episode), "by the map of the episode it reads another episode")
    smaller = episode.topic_map.only([episode.topic_map.clock])
    clock = case.source.read(path, smaller)
    expect(list(clock.fields) == [smaller.clock], f"fields are {list(clock.fields)}")
    expect(clock.topic_map == smaller, "the episode has another map than the one given")


# --- identity -----------------------------------------------------------------------------------


@_rule("Each episode has an id of its own.")
def _ids_differ(case: _Case) -> None:
    ids = [episode.id for episode in case.episodes]
    expect(all(ids), "an id is empty")
    expect(len(set(ids)) == len(ids), f"ids are {ids}")


@_rule("Id and content do not depend on where the recordings lie.")
def _identity_travels(case: _Case) -> None:
    with case.copy() as copy:
        moved = [case.source.read(path) for path in case.source.find(copy)]
    for before, after in zip(case.episodes, moved, strict=True):
        expect(after.id == before.id, f"{before.id} has the id {after.id} elsewhere")
        expect(_is_equal(after, before), f"{before.id} is another episode elsewhere")


@_rule("A claimed id changes nothing but the finding `wrong-id`.")
def _claimed_id(case: _Case) -> None:
    path, episode = case.found[0], case.episodes[0]
    right = case.source.read(path, claimed_id=episode.id)
    expect(_is_equal(right, episode), "its own id, claimed for it, changes the episode")
    wrong = case.source.read(path, claimed_id="00000000-0000-7000-8000-000000000000")
    expect(wrong.digest == episode.digest, "another claimed id changes the episode")
    others = {f.id for f in wrong.findings} - {f.id for f in episode.findings}
    expect(others <= {"wrong-id"}, f"another claimed id gives the findings {sorted(others)}")


@_rule("The stamp of an episode stays, and changes with the files of its recording.")
def _stamps_change(case: _Case) -> None:
    with case.copy() as copy:
        for path in case.source.find(copy):
            before = case.source.stamp(path)
            expect(before, f"{path.name} has no stamp")
            expect(
                case.source.stamp(path) == before, f"the stamp of {path.name} changed by itself"
            )
        paths = case.source.find(copy)
        stamps = [case.source.stamp(path) for path in paths]
        for file in _files(copy):
            os.utime(file, ns=(1_700_000_000_000_000_000, 1_700_000_000_000_000_000))
        for path, before in zip(paths, stamps, strict=True):
            expect(case.source.stamp(path) != before, f"the stamp of {path.name} did not change")


# --- faults -------------------------------------------------------------------------------------


@_rule("A path that does not exist is a CurationError that names it; its stamp is empty.")
def _missing_path(case: _Case) -> None:
    with case.copy() as copy:
        paths = case.source.find(copy)
    for path in paths:
        expect(case.source.stamp(path) == "", f"{path.name} is gone and has a stamp")
        try:
            case.source.read(path)
        except CurationError as err:
            expect(copy.name in str(err), f"the error is {err}")
        else:
            raise AssertionError(f"{path.name} is gone and can be read")


@_rule("A truncated recording is a CurationError, or an episode with a finding.")
def _truncated(case: _Case) -> None:
    with case.copy() as copy:
        paths = case.source.find(copy)
        for file in _files(copy):
            with file.open("r+b") as stream:
                stream.truncate(file.stat().st_size // 2)
        for path, whole in zip(paths, case.episodes, strict=True):
            try:
                found = case.source.read(path)
            except CurationError:
                continue
            expect(
                found.digest == whole.digest or found.findings,
                f"of {path.name} half is left, and nothing is found",
            )


@_rule("It can be sent to a worker.")
def _travels(case: _Case) -> None:
    travelled: Source = pickle.loads(pickle.dumps(case.source))
    again = travelled.read(case.found[0])
    expect(_is_equal(again, case.episodes[0]), "its copy reads another episode")


def _is_equal(a: Episode, b: Episode) -> bool:
    return (a.digest, a.name, a.findings, a.topic_map) == (
        b.digest,
        b.name,
        b.findings,
        b.topic_map,
    )


def _files(path: Path) -> list[Path]:
    return [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
