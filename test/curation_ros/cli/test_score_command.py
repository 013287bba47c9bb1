from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from decided import decide_on

from curation_ros.bags import open_bag
from curation_ros.configuration import read_reference, read_settings
from curation_ros.core.decision.curation import Curation
from curation_ros.core.episode.findings import FINDINGS
from curation_ros.core.scorers import DEFAULT_SCORERS
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import find_episodes, read_episode

DONE, FOUND, USAGE, NOTHING = 0, 1, 2, 3
KEYS = ["episode", "name", "path", "length", "scores", "decision", "reason", "span", "findings"]
VERDICTS = {"pick-0": "keep", "pick-1": "keep", "pick-2": "discard", "pick-3": "discard"}

Run = Callable[..., Any]


def _options(folder: Path) -> list[object]:
    return ["--reference", folder / "reference", "--config", folder / "curation.yaml"]


def _bag(folder: Path, name: str = "pick-0") -> Path:
    for path in find_episodes([folder / "data"]):
        event = open_bag(path).event()
        if event is not None and event.name == name:
            return path
    raise AssertionError(name)


# --- what is printed ----------------------------------------------------------------------------


def test_json_has_exactly_the_keys_and_types_of_the_contract(curation: Run, folder: Path) -> None:
    told = curation("score", folder / "data", *_options(folder), "--json")
    assert told.code == DONE
    assert len(told.rows) == 5
    for row in told.rows:
        assert list(row) == KEYS
        assert isinstance(row["episode"], str)
        assert len(row["episode"]) == 36
        assert row["path"] == str(folder / "data" / "episodes" / row["episode"])
        assert isinstance(row["length"], int)
        assert list(row["scores"]) == ["gripper_timing", "knn", "length"]
        assert all(v is None or isinstance(v, float) for v in row["scores"].values())
        first, last = row["span"]
        assert isinstance(first, int)
        assert 0 <= first < last
        for finding in row["findings"]:
            assert list(finding) == ["id", "kind", "message", "span"]
            assert finding["kind"] == FINDINGS[finding["id"]][0]
    decided = {row["name"]: row["decision"] for row in told.rows}
    assert decided == {**VERDICTS, "pick-4": "review"}
    [gap] = [f for row in told.rows for f in row["findings"] if f["id"] == "gap"]
    assert gap["message"].startswith("topic 'phase': silent for 1.000 s")
    assert "NaN" not in told.out


def test_json_is_what_the_library_says(curation: Run, folder: Path) -> None:
    told = curation("score", folder / "data", *_options(folder), "--json")
    settings = read_settings(folder / "curation.yaml", {})
    fitted = Curation.fit(settings, read_reference([folder / "reference"], None))
    for row in told.rows:
        episode = read_episode(Path(row["path"]))
        decision = decide_on(fitted, episode)
        assert row["scores"] == dict(decision.scores)
        assert (row["decision"], row["reason"]) == (decision.verdict, decision.reason)
        assert row["span"] == list(decision.span)
        assert row["length"] == len(episode)


def test_score_that_was_not_given_is_null(curation: Run, folder: Path) -> None:
    told = curation("score", _bag(folder), "--config", folder / "curation.yaml", "--json")
    [row] = told.rows
    assert row["scores"]["knn"] is None
    assert '"knn": null' in told.out
    assert (row["decision"], row["reason"]) == ("review", "no reference")


def test_table_is_for_people(curation: Run, folder: Path) -> None:
    told = curation("score", folder / "data", *_options(folder))
    assert told.code == DONE
    for name in VERDICTS:
        assert name in told.out
    assert "{" not in told.out
    rule = "rule evidence: the first that can tell: object_coupling, then grip_consistency"
    said = " ".join(told.err.split())
    assert rule in said
    assert "then keep where gripper_timing >=" in said


@pytest.mark.parametrize("kind", ["dataset", "bag", "file", "folder", "mixed"])
def test_datasets_bags_and_files_may_be_named(curation: Run, folder: Path, kind: str) -> None:
    bag = _bag(folder)
    [mcap] = bag.glob("*.mcap")
    loose = folder / "loose"
    loose.mkdir()
    shutil.copy(mcap, loose / "copy.mcap")
    paths, n = {
        "dataset": ([folder / "data"], 5),
        "bag": ([bag], 1),
        "file": ([mcap], 1),
        "folder": ([loose], 1),
        "mixed": ([bag, loose / "copy.mcap"], 2),
    }[kind]
    told = curation("score", *paths, "--config", folder / "curation.yaml", "--json")
    assert (told.code, len(told.rows)) == (DONE, n)
    assert all("error" not in row for row in told.rows)


def test_bag_of_another_recorder_is_scored_with_a_topic_map(curation: Run, folder: Path) -> None:
    bag = _bag(folder)
    [mcap] = bag.glob("*.mcap")
    foreign = folder / "foreign"
    foreign.mkdir()
    shutil.copy(mcap, foreign / "foreign_0.mcap")
    text = (bag / "metadata.yaml").read_text()
    (foreign / "metadata.yaml").write_text(
        text[: text.index("  custom_data:")].replace(mcap.name, "foreign_0.mcap")
    )
    told = curation("score", foreign, "--config", folder / "curation.yaml", "--json")
    assert told.code == NOTHING
    assert "give a topic map" in told.rows[0]["error"]
    topics = Path(__file__).resolve().parents[3] / "config" / "topics.yaml"
    options = ("--config", folder / "curation.yaml", "--topic-map", topics, "--json")
    first, second = (curation("score", foreign, *options) for _ in range(2))
    assert first.code == DONE
    assert first.rows == second.rows
    assert first.rows[0]["episode"] != bag.name
    assert first.rows[0]["length"] == 240


def test_scorers_may_be_chosen_and_the_one_that_decides_is_added(
    curation: Run, folder: Path
) -> None:
    told = curation(
        "score", _bag(folder), *_options(folder), "--scorers", "length, smoothness", "--json"
    )
    assert told.code == DONE
    decide = ["object_coupling", "grip_consistency", "phase_events", "gripper_timing"]
    assert list(told.rows[0]["scores"]) == ["length", "smoothness", *decide]
    assert told.rows[0]["decision"] == "keep"
    alone = curation("score", _bag(folder), "--scorers", "length", "--rule", "none", "--json")
    assert alone.rows[0]["scores"] == {"length": -240.0}
    assert alone.rows[0]["decision"] == "review"


@pytest.mark.parametrize("rule", ["threshold", "evidence"])
def test_value_is_what_the_rule_takes(curation: Run, folder: Path, rule: str) -> None:
    for value, verdict in (("0.99", "discard"), ("0.5", "keep")):
        options = ["--scorers", "gripper_timing", "--rule", rule, "--value", value, "--json"]
        told = curation("score", _bag(folder), *options)
        assert told.code == DONE
        decided = verdict if rule == "threshold" else "keep"  # the object has the first word
        assert told.rows[0]["decision"] == decided


def test_shipped_config_scores_without_a_reference(curation: Run, folder: Path) -> None:
    [row] = curation("score", _bag(folder), "--json").rows
    assert list(row["scores"]) == list(DEFAULT_SCORERS)
    assert (row["decision"], row["span"][0]) == ("keep", 0)
    assert row["reason"].startswith("object_coupling: what was grasped stayed with the effector")


# --- files that cannot be read ------------------------------------------------------------------


def _spoilt(folder: Path) -> dict[str, Path]:
    """One of each kind of file that is no bag."""
    bag = _bag(folder)
    [mcap] = bag.glob("*.mcap")
    raw = mcap.read_bytes()
    made = {
        "missing": folder / "missing.mcap",
        "text": folder / "text.mcap",
        "empty": folder / "empty.mcap",
        "torn": folder / "torn.mcap",
        "no folder": folder / "no folder",
        "empty folder": folder / "empty folder",
    }
    made["text"].write_text("this is no bag")
    made["empty"].write_bytes(b"")
    made["torn"].write_bytes(raw[: len(raw) // 2])
    made["empty folder"].mkdir()
    return made


@pytest.mark.parametrize("kind", ["missing", "text", "empty", "torn", "no folder", "empty folder"])
def test_file_that_is_no_bag_is_told_by_path(curation: Run, folder: Path, kind: str) -> None:
    path = _spoilt(folder)[kind]
    told = curation("score", path, "--config", folder / "curation.yaml", "--json")
    assert told.code == NOTHING
    [row] = told.rows
    assert list(row) == ["path", "error", "finding"]
    assert row["path"] == str(path)
    assert str(path) in row["error"]
    assert "\n" not in row["error"]
    shown = curation("score", path, "--config", folder / "curation.yaml")
    assert shown.code == NOTHING
    assert "warning: " in shown.err
    assert "internal error" not in shown.err
    assert "Traceback" not in shown.err


def test_unreadable_files_cost_none_of_the_others(curation: Run, folder: Path) -> None:
    spoilt = _spoilt(folder)
    torn = folder / "data" / "episodes" / "torn"
    torn.mkdir()
    shutil.copy(spoilt["torn"], torn / "torn_0.mcap")
    told = curation("score", *spoilt.values(), folder / "data", *_options(folder), "--json")
    assert told.code == DONE
    bad = [row for row in told.rows if "error" in row]
    assert {row["path"] for row in bad} == {*map(str, spoilt.values()), str(torn)}
    assert len(told.rows) - len(bad) == 5


@pytest.mark.parametrize("custom", ["{", "[]", "5", '{"id": 5}', "{}"])
def test_bag_whose_own_words_are_spoilt_is_told_by_path(
    curation: Run, folder: Path, custom: str
) -> None:
    bag = _bag(folder)
    path = bag / "metadata.yaml"
    lines = path.read_text().splitlines()
    for key in ("episode", "topic_map", "topics"):
        changed = [f"    {key}: '{custom}'" if x.startswith(f"    {key}: ") else x for x in lines]
        assert changed != lines
        path.write_text("\n".join(changed) + "\n")
        told = curation("score", bag, "--config", folder / "curation.yaml", "--json")
        if key == "topics" and custom.endswith("}"):  # nothing noted: found by their names
            assert told.code == DONE
        else:
            assert told.code == NOTHING
            assert str(bag) in told.rows[0]["error"]


# --- exit codes ---------------------------------------------------------------------------------


def test_check_tells_findings_by_the_exit_code(curation: Run, folder: Path) -> None:
    options = [*_options(folder), "--json", "--check"]
    assert curation("score", _bag(folder, "pick-0"), *options).code == DONE
    assert curation("score", _bag(folder, "pick-4"), *options).code == FOUND
    assert curation("score", _bag(folder, "pick-0"), folder / "none", *options).code == FOUND
    assert curation("score", _bag(folder, "pick-4"), *_options(folder)).code == DONE


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--config", "none.yaml"], USAGE, "none.yaml"),
        (["--config", "bad.yaml"], USAGE, "bad.yaml is not YAML"),
        (["--topic-map", "bad.yaml"], USAGE, "bad.yaml is not YAML"),
        (["--topic-map", "none.yaml"], USAGE, "none.yaml"),
        (["--scorers", "nose"], USAGE, "no scorer 'nose'"),
        (["--scorers", "length,,knn"], USAGE, "no scorer ''"),
        (["--rule", "nose"], USAGE, "invalid choice: 'nose'"),
        (["--rule", "nose", "--value", "1"], USAGE, "invalid choice: 'nose'"),
        (["--rule", "none", "--value", "1"], USAGE, "rule 'none' takes no value, found 1"),
        (["--reference", "empty"], NOTHING, "empty"),
        (["--reference", "none"], NOTHING, "none"),
        (["--reference", "bad.yaml"], NOTHING, "bad.yaml"),
        (["--nose"], USAGE, "--nose"),
    ],
)
def test_wrong_usage_is_one_line_and_a_code(
    curation: Run,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    code: int,
    said: str,
) -> None:
    (folder / "bad.yaml").write_text("a: [")
    (folder / "empty").mkdir()
    monkeypatch.chdir(folder)
    told = curation("score", _bag(folder), *arguments, "--json")
    assert (told.code, told.out) == (code, "")
    *_, last = told.err.splitlines()
    assert "error: " in last
    assert said in last
    assert "internal error" not in told.err


def test_reference_that_cannot_be_trusted_is_named(curation: Run, folder: Path) -> None:
    told = curation(
        "score",
        _bag(folder),
        "--reference",
        folder / "data",
        "--config",
        folder / "curation.yaml",
        "--json",
    )
    assert told.code == NOTHING
    assert "pick-4" in told.err


# --- writing ------------------------------------------------------------------------------------


def test_written_decisions_are_those_that_were_printed(curation: Run, folder: Path) -> None:
    options = [*_options(folder), "--json", "--write"]
    told = curation("score", folder / "data", *options)
    assert told.code == DONE
    decided = Dataset(folder / "data").latest_decisions()
    assert {i: d.verdict for i, d in decided.items()} == {
        row["episode"]: row["decision"] for row in told.rows
    }
    again = curation("score", folder / "data", *options)
    assert again.rows == told.rows
    assert all(len(Dataset(folder / "data").decisions(i)) == 1 for i in decided)


def test_verdicts_that_are_replaced_are_counted(curation: Run, folder: Path) -> None:
    data = folder / "data"
    person = curation("override", data, "pick-0", "discard", "--by", "Ada", "--json")
    assert person.code == DONE
    first = curation("score", data, *_options(folder), "--write", "--json")
    assert "replaced" not in first.err
    before = {row["episode"]: row["decision"] for row in first.rows}
    other = ["--rule", "top-k", "--rule-scorer", "length", "--value", "1", "--write", "--json"]
    told = curation("score", data, *other)
    changed = [(before[r["episode"]], r["decision"]) for r in told.rows]
    counts = Counter((old, new) for old, new in changed if old != new)
    assert counts
    [line] = [line for line in told.err.splitlines() if "replaced" in line]
    for (old, new), n in counts.items():
        assert f"{n} from {old} to {new}" in line
    assert "replaced" not in curation("score", data, *other).err


def test_nothing_is_written_without_being_asked(curation: Run, folder: Path) -> None:
    before = sorted(p for p in folder.rglob("*"))
    curation("score", folder / "data", *_options(folder), "--json")
    # But the index, which is a cache of what is in the files.
    assert sorted(p for p in folder.rglob("*") if "index.sqlite" not in p.name) == before


def test_decision_of_a_person_that_counts_is_named_where_nothing_is_written(
    curation: Run, folder: Path
) -> None:
    data = folder / "data"
    rows = curation("score", data, *_options(folder), "--json").rows
    decisions = {r["name"]: r["decision"] for r in rows}
    assert decisions["pick-0"] == "keep"
    assert curation("override", data, "pick-0", "keep", "--by", "Ada", "--json").code == DONE
    told = curation("score", data, *_options(folder), "--json")
    assert (told.rows, told.err) == (rows, "")
    assert curation("override", data, "pick-0", "discard", "--by", "Ada", "--json").code == DONE
    told = curation("score", data, *_options(folder), "--json")
    assert told.rows == rows
    assert "overridden by a person (their decision stands): pick-0 (discard, by Ada)" in told.err


@pytest.mark.parametrize("as_json", [True, False])
def test_decision_of_a_person_stays_in_force_beside_new_scores(
    curation: Run, folder: Path, as_json: bool
) -> None:
    person = curation("override", folder / "data", "pick-0", "discard", "--by", "Ada", "--json")
    assert person.code == DONE
    options = [*_options(folder), "--write", *(["--json"] if as_json else [])]
    told = curation("score", folder / "data", *options)
    assert told.code == DONE
    if as_json:
        [row] = [r for r in told.rows if r["name"] == "pick-0"]
        assert (row["decision"], row["reason"]) == ("discard", "Ada decided")
        assert row["scores"]["gripper_timing"] == 1.0  # closed as long as it is looked at
    else:
        assert "Ada decided" in told.out


def test_part_that_is_kept_of_a_salvage_is_shown_to_people(curation: Run, folder: Path) -> None:
    early = _bag(folder, "pick-2")
    told = curation("score", early, "--json")
    [row] = told.rows
    whole_ns = 10_000_000 + 239 * 50_000_000  # the first step is 10 ms after the start
    assert row["decision"] == "salvage"
    assert row["span"][0] <= 10_000_000 < row["span"][1] < whole_ns
    shown = curation("score", early).out
    assert "from" not in shown
    assert f"until {row['span'][1] / 1e9:.2f} s" in shown
    assert f"of {whole_ns / 1e9:.2f} s" in shown
    assert "object coupling" in shown
    assert "of 11.96 s" not in curation("score", _bag(folder, "pick-0")).out


def test_write_takes_one_dataset(curation: Run, folder: Path) -> None:
    data = folder / "data"
    assert curation("score", data, data, *_options(folder), "--write", "--json").code == USAGE
    told = curation("score", _bag(folder), *_options(folder), "--write", "--json")
    assert (told.code, told.out) == (NOTHING, "")
    assert "no folder 'episodes'" in told.err


def test_decisions_that_cannot_be_written_are_told(curation: Run, folder: Path) -> None:
    (folder / "data" / "decisions").write_text("in the way")
    told = curation("score", folder / "data", *_options(folder), "--write", "--json")
    assert told.code == NOTHING
    assert str(folder / "data" / "decisions") in told.err
    assert "internal error" not in told.err


# --- the real executable ------------------------------------------------------------------------


def test_executable_prints_json_into_a_pipe_that_may_close(folder: Path) -> None:
    command = [Path(sys.executable).parent / "curation", "score", folder / "data", "--json"]
    command += ["--config", folder / "curation.yaml"]
    with subprocess.Popen(
        [str(c) for c in command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        first = json.loads(process.stdout.readline())
        process.stdout.close()
        err = process.stderr.read()
        code = process.wait()
    assert list(first) == KEYS
    assert (code, err) == (DONE, "")


def test_bag_under_another_name_is_found_and_not_logged(curation: Run, folder: Path) -> None:
    bag = _bag(folder)
    bag.rename(bag.with_name("my favourite"))
    told = curation("score", folder / "data", *_options(folder), "--write", "--json")
    assert told.code == DONE
    [row] = [r for r in told.rows if r["name"] == "pick-0"]
    assert [f["id"] for f in row["findings"]] == ["wrong-id"]
    assert row["decision"] == "review"
    said = " ".join(told.err.split())
    assert "my favourite: not logged: its folder is not named after its episode" in said
    assert f"rename it to {bag.name}" in said
    assert not Dataset(folder / "data").decision_log(bag.name).exists()


def test_reference_among_what_is_scored_is_told(curation: Run, folder: Path) -> None:
    options = ["--reference", folder / "reference", "--config", folder / "curation.yaml"]
    told = curation("score", folder / "reference", *options)
    assert "5 of the 5 episodes are in the reference" in " ".join(told.err.split())
    told = curation("score", folder / "data", *options)
    assert "in the reference" not in told.err


def test_summary_counts_verdicts(curation: Run, folder: Path) -> None:
    told = curation("score", folder / "data", *_options(folder))
    assert "2 keep, 1 review, 2 discard; 5 scored (0 cached), 0 unreadable" in " ".join(
        told.err.split()
    )
