from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scenes import GRASP, LIFT, LIFT_AT, RELEASE, RELEASE_AT, TRANSPORT, scene, without

from curation_ros.core.decision.balance import Balance, Shown, balance_of, phase_steps
from curation_ros.core.errors import ConfigError

WHOLE = {"PREGRASP": 20, "DESCEND": 20, "GRASP": GRASP, "LIFT": LIFT}
WHOLE |= {"TRANSPORT": TRANSPORT, "RELEASE": RELEASE}


def test_steps_of_each_phase_by_hand() -> None:
    assert phase_steps(scene()) == WHOLE
    assert list(phase_steps(scene()) or ()) == list(WHOLE)


def test_span_counts_the_steps_that_a_policy_is_trained_on() -> None:
    episode = scene()
    until_ns = (LIFT_AT + 9) * 50_000_000
    cut = WHOLE | {"LIFT": 10, "TRANSPORT": 0, "RELEASE": 0}
    assert phase_steps(episode, (0, until_ns)) == cut
    assert phase_steps(episode, (0, until_ns - 1)) == cut | {"LIFT": 9}
    late = (RELEASE_AT * 50_000_000, (RELEASE_AT + 1) * 50_000_000)
    assert phase_steps(episode, late) == dict.fromkeys(WHOLE, 0) | {"RELEASE": 2}


def test_unknown_phase_counts_for_none() -> None:
    episode = scene()
    phase = episode.fields["phase"].copy()
    phase[LIFT_AT : LIFT_AT + 5] = -1
    unknown = replace(episode, fields={**episode.fields, "phase": phase})
    assert phase_steps(unknown) == WHOLE | {"LIFT": LIFT - 5}


def test_graph_without_phases_says_so_and_warns_of_nothing() -> None:
    assert phase_steps(without(scene(), "phase")) is None
    balance = balance_of([("a", None), ("b", None)])
    assert balance == Balance(2, 0, {})
    assert balance.warnings() == []
    assert balance.describe() == "phases: unknown, because the topic map names none"


def test_demonstrations_and_steps_add_up() -> None:
    cut = WHOLE | {"LIFT": 10, "TRANSPORT": 0, "RELEASE": 0}
    balance = balance_of([("a", WHOLE), ("b", cut), ("c", cut), ("d", None)])
    assert (balance.n, balance.n_known) == (4, 3)
    assert balance.phases["GRASP"] == Shown(3, 3 * GRASP)
    assert balance.phases["LIFT"] == Shown(3, LIFT + 20)
    assert balance.phases["RELEASE"] == Shown(1, RELEASE)
    assert balance.describe() == (
        "phases shown by 3 demonstrations: PREGRASP 3, DESCEND 3, GRASP 3, LIFT 3, TRANSPORT 1, "
        "RELEASE 1; unknown for 1 others"
    )


def test_episode_with_two_spans_is_one_demonstration() -> None:
    balance = balance_of([("a", {"LIFT": 3, "RELEASE": 0}), ("a", {"LIFT": 2, "RELEASE": 1})])
    assert balance == Balance(1, 1, {"LIFT": Shown(1, 5), "RELEASE": Shown(1, 1)})


@pytest.mark.parametrize(("n_whole", "warned"), [(0, True), (16, True), (39, True), (40, False)])
def test_phase_that_fewer_than_half_show_is_told(n_whole: int, warned: bool) -> None:
    parts = [(str(k), {"LIFT": 5, "RELEASE": int(k < n_whole)}) for k in range(80)]
    found = balance_of(parts).warnings()
    assert len(found) == warned
    for line in found:
        assert line.startswith(f"RELEASE is shown by {n_whole} of 80 demonstrations kept: ")


def test_those_that_are_not_known_do_not_count_against_a_phase() -> None:
    parts = [("a", {"RELEASE": 1}), *((str(k), None) for k in range(9))]
    assert balance_of(parts).warnings() == []


def test_nothing_kept_has_no_balance_to_warn_of() -> None:
    assert balance_of([]).warnings() == []


def test_order_does_not_matter_and_json_reads_back(rng: np.random.Generator) -> None:
    parts = [(str(k), {"LIFT": 1 + k, "RELEASE": k % 3}) for k in range(9)]
    balance = balance_of(parts)
    assert balance_of([parts[k] for k in rng.permutation(9)]) == balance
    assert Balance.from_json(json.loads(json.dumps(balance.to_json()))) == balance


@pytest.mark.parametrize("raw", [{}, {"of": 1}, [], 3, {"of": 1, "known": 1, "shown": {"A": 1}}])
def test_json_that_is_no_balance_is_refused(raw: object) -> None:
    with pytest.raises(ConfigError, match="phases: "):
        Balance.from_json(raw)  # type: ignore[arg-type]
