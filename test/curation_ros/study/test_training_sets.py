"""Training sets that rest on decisions of the curator: whole, salvaged, cut at random."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from made_pool import DROPS, MARGIN, MARGINS, pool_of, scenes_of
from scenes import N_STEPS, RELEASE_AT, without

from curation_ros.core.errors import EpisodeError
from curation_ros.dataset.dataset import Dataset
from curation_ros.files import append_line
from curation_ros.study.pools import Pool
from curation_ros.study.training_sets import TrainingSet, training_set


@pytest.fixture
def pool(tmp_path: Path) -> Pool:
    return pool_of(tmp_path, scenes_of())


@pytest.fixture
def reference(tmp_path: Path) -> Dataset:
    return Dataset(tmp_path / "reference", create=True)


@pytest.fixture
def more(tmp_path: Path) -> Dataset:
    """Four further demonstrations; the second by name has failed."""
    made = Dataset(tmp_path / "more", create=True)
    for k, outcome in enumerate(("succeeded", "failed", "succeeded", "succeeded")):
        line = {"episode": f"z-{9 - k}", "name": f"bowl-{k:04}", "outcome": outcome}
        append_line(made.path / "truth.jsonl", line)
    return made


def spans(made: TrainingSet) -> dict[str, tuple[int, int] | None]:
    return {bag.name: span for bag, span in made.bags}


def last_steps(pool: Pool, made: TrainingSet) -> dict[str, int]:
    """Id of each demonstration that is there in part -> its last step."""
    return {
        i: len(pool.timelines[i].within(span)) - 1
        for i, span in spans(made).items()
        if span is not None
    }


def test_kept_episodes_are_whole_and_broken_ones_are_salvaged(
    pool: Pool, reference: Dataset
) -> None:
    whole = training_set(pool, "decided", reference, 0)
    assert spans(whole) == {"a-0": None, "a-1": None}
    assert (whole.n_pool, whole.n_good, whole.n_salvaged) == (2, 2, 0)
    both = training_set(pool, "decided+salvaged", reference, 0)
    assert (both.n_pool, both.n_good, both.n_salvaged) == (5, 2, 3)
    assert both.needs == whole.needs == ("object pose",)
    assert last_steps(pool, both) == {f"a-{k}": at - MARGIN for k, at in enumerate(DROPS, start=2)}
    assert both.to_json(pool.timelines)["contamination"] == 0


@pytest.mark.parametrize("margin", MARGINS)
def test_margin_counts_control_steps(pool: Pool, reference: Dataset, margin: int) -> None:
    made = training_set(pool, f"salvaged-{margin}", reference, 0)
    # Something is kept away from the break even without a margin: the step of the break itself.
    ends = [at - max(1, margin) for at in DROPS]
    assert list(last_steps(pool, made).values()) == ends


def test_equal_sets_have_one_id(pool: Pool, reference: Dataset) -> None:
    def id_of(row: str) -> str:
        return training_set(pool, row, reference, 0).id

    assert id_of("decided+salvaged") == id_of(f"salvaged-{MARGIN}+decided")
    assert id_of("decided") == id_of("oracle")
    ids = {id_of(row) for row in ("decided", "salvaged", "salvaged-0", "decided+salvaged")}
    assert len(ids) == 4


def test_demonstration_of_two_terms_is_there_once_with_its_longer_part(
    pool: Pool, reference: Dataset
) -> None:
    for row in ("salvaged-15+salvaged-0", "salvaged-0+salvaged-15"):
        made = training_set(pool, row, reference, 0)
        assert spans(made) == spans(training_set(pool, "salvaged-0", reference, 0))
    for row in ("everything+salvaged", "salvaged+everything"):
        made = training_set(pool, row, reference, 0)
        assert made.id == training_set(pool, "everything", reference, 0).id


def test_random_cuts_depend_on_seed_and_names_only(
    pool: Pool, reference: Dataset, tmp_path: Path
) -> None:
    def cuts(pool: Pool, draw: int) -> list[int]:
        return list(
            last_steps(pool, training_set(pool, "random_cut", reference, 0, draw)).values()
        )

    drawn = [tuple(cuts(pool, k)) for k in range(40)]
    assert len(set(drawn)) > 30
    assert drawn[3] == tuple(cuts(pool, 3))
    named_draw = training_set(pool, "random_cut#3", reference, 0, 7)
    assert tuple(last_steps(pool, named_draw).values()) == drawn[3]
    ends = [end for some in drawn for end in some]
    assert min(ends) >= 1
    assert min(ends) < N_STEPS / 8
    assert N_STEPS * 7 / 8 < max(ends) < N_STEPS
    # Other ids, same names: a dataset that was collected again.
    again = [replace(e, id=f"b{9 - k}") for k, e in enumerate(scenes_of())]
    other = pool_of(tmp_path / "again", again)
    by_name = [
        last_steps(other, training_set(other, "random_cut", reference, 0, 3))[f"b{9 - k}"]
        for k in (2, 3, 4)
    ]
    assert by_name == list(drawn[3])


def test_more_takes_the_first_that_succeeded(
    pool: Pool, reference: Dataset, more: Dataset
) -> None:
    made = training_set(pool, "oracle+more@2", reference, 0, more=more)
    assert set(spans(made)) == {"a-0", "a-1", "z-9", "z-7"}
    assert (made.n_pool, made.n_good, made.n_more) == (2, 2, 2)
    assert made.needs == ("labels", "more clean demonstrations")
    assert made.to_json(pool.timelines)["n"] == 4
    with pytest.raises(EpisodeError, match="3 succeeded, cannot keep 4"):
        training_set(pool, "more@4", reference, 0, more=more)


def test_phases_of_a_set_are_counted_within_the_spans(pool: Pool, reference: Dataset) -> None:
    row = training_set(pool, "decided+salvaged", reference, 0).to_json(pool.timelines)
    assert set(row["spans"]) == {"a-2", "a-3", "a-4"}
    assert row["phases"]["LIFT"]["demonstrations"] == 5
    assert row["phases"]["TRANSPORT"]["demonstrations"] == 2
    assert row["phases"]["RELEASE"] == {"demonstrations": 2, "steps": 2 * (N_STEPS - RELEASE_AT)}
    kept = [at - MARGIN + 1 for at in DROPS]
    steps = sum(counts["steps"] for counts in row["phases"].values())
    assert steps == 2 * N_STEPS + sum(kept)
    assert "spans" not in training_set(pool, "decided", reference, 0).to_json(pool.timelines)


def test_without_poses_gripper_and_phase_decide_and_nothing_is_needed(
    tmp_path: Path, reference: Dataset
) -> None:
    pool = pool_of(tmp_path, [without(e, "object") for e in scenes_of()])
    made = training_set(pool, "decided+salvaged", reference, 0)
    assert made.needs == ("nothing",)
    assert (made.n_pool, made.n_salvaged) == (5, 3)


def test_too_short_a_beginning_is_left_out_unless_the_margin_is_smaller(
    tmp_path: Path, reference: Dataset
) -> None:
    pool = pool_of(tmp_path, scenes_of(), (0, 80))
    assert training_set(pool, "salvaged-0", reference, 0).n_salvaged == 3
    assert training_set(pool, "salvaged-80", reference, 0).n_salvaged < 3


def test_pool_without_decisions_is_named(pool: Pool, reference: Dataset) -> None:
    with pytest.raises(EpisodeError, match="pool 'made': the curator has not decided"):
        training_set(replace(pool, curated=None), "decided", reference, 0)
