"""From the bags of other robots to policies, and back to the commands of the demonstrations."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from other_robots import (
    CLOSED,
    OPEN,
    SPEED_MM_S,
    TURN_DEG_S,
    arm,
    mill,
    read,
    record,
    samples_of,
    started,
)

from curation_ros.bags.cdr import CdrDecoder
from curation_ros.bags.messages import to_cdr
from curation_ros.cli.main import main as curation
from curation_ros.core.errors import PolicyError
from curation_ros.dataset.manifests import save_selection
from policy_node.action import CommandTerm
from policy_node.command_messages import CommandMessages
from policy_node.live import LivePolicy
from policy_node.policy import load_policy
from policy_node.settings import TrainingSettings
from policy_node.testing import check_policy
from policy_node.variants import Variant, draft_variant, read_training_config

pytest.importorskip("torch")

from policy_node.train import train

pytestmark = pytest.mark.policy

SETTINGS = TrainingSettings(steps=1500, hidden=(64, 64))
N_DEMONSTRATIONS = 8
#: Mean error of the commands of a demonstration, as a share of their scale.
TOLERANCE = 0.03
#: How many times larger the error of a policy would be that always commands the mean.
AT_LEAST = 3.0

#: Relative to where the blank was, as a person would write it.
RELATIVE_TO_THE_BLANK = Variant(
    "blank",
    ("spindle", "axes", "blank@start - spindle", "stage"),
    (CommandTerm("feed", (SPEED_MM_S,)), CommandTerm("turn", (TURN_DEG_S,)), CommandTerm("clamp")),
)


@pytest.fixture(scope="module")
def datasets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robots")
    return {
        robot: record(folder / robot, robot, range(N_DEMONSTRATIONS)) for robot in ("mill", "arm")
    }


@pytest.fixture(scope="module")
def policies(datasets, tmp_path_factory):
    """Trained on the bags, saved and loaded again."""
    folder = tmp_path_factory.mktemp("policies")
    variants = {
        "mill": ("mill", RELATIVE_TO_THE_BLANK),
        "drafted mill": ("mill", draft_variant(mill())),
        "arm": ("arm", draft_variant(arm())),
    }
    made = {}
    for name, (robot, variant) in variants.items():
        episodes = [(episode, None) for episode in read(datasets[robot])]
        trained = train(episodes, variant, seed=0, settings=SETTINGS)
        made[name] = load_policy(trained.policy.save(folder / name))
    return made


def driven(policy, robot, seed):
    """Demonstrated commands and those that the policy publishes, (T, D) by field, open loop."""
    topic_map = {"mill": mill, "arm": arm}[robot]()
    live = LivePolicy(policy, topic_map, CdrDecoder())
    messages = CommandMessages(topic_map, policy.commanded)
    decoder = CdrDecoder()
    published, shown = [], []
    live.event(started(robot, seed))
    for sample in samples_of(robot, seed):
        if sample.topic in topic_map.command_topics:
            if sample.topic in messages.topics:
                shown.append((sample.stamp_ns, sample.topic, sample.data))
            continue
        for answer in live.sample(sample):
            for topic, kind, content in messages.messages(answer.command, answer.stamp_ns):
                published.append((answer.stamp_ns, topic, to_cdr(kind, content)))
    assert live.problem == ""
    assert sorted(p[:2] for p in published) == sorted(s[:2] for s in shown)

    def values(found, spec):
        rows = [data for _, topic, data in sorted(found) if topic == spec.topic]
        return np.column_stack(decoder.decode(spec.type, spec.values, rows))

    fields = [topic_map.fields[name] for name in policy.commanded]
    return {spec.name: (values(shown, spec), values(published, spec)) for spec in fields}


def errors(found, scales):
    """Mean error by field as a share of the scale, and that of commanding the mean."""
    return {
        name: (
            float(np.mean(np.abs(shown - answered)) / scales[name]),
            float(np.mean(np.abs(shown - shown.mean(axis=0))) / scales[name]),
        )
        for name, (shown, answered) in found.items()
        if name in scales
    }


@pytest.mark.parametrize("name", ["mill", "drafted mill"])
@pytest.mark.parametrize("seed", [0, 7])
def test_six_axes_and_a_gripper_come_back(policies, name, seed):
    found = driven(policies[name], "mill", seed)
    assert {key: shown.shape[1] for key, (shown, _) in found.items()} == {
        "feed": 3,
        "turn": 3,
        "clamp": 1,
    }
    scales = {"feed": SPEED_MM_S, "turn": TURN_DEG_S}
    for field, (error, of_mean) in errors(found, scales).items():
        assert error < min(TOLERANCE, of_mean / AT_LEAST), field
    shown, answered = found["clamp"]
    assert set(np.unique(answered)) == {OPEN, CLOSED}
    assert np.mean(shown == answered) > 0.95


@pytest.mark.parametrize("seed", [0, 7])
def test_seven_joints_without_phase_and_gripper_come_back(policies, seed):
    found = driven(policies["arm"], "arm", seed)
    assert list(found) == ["goal"]
    [(error, of_mean)] = errors(found, {"goal": 0.4}).values()
    assert error < min(TOLERANCE, of_mean / AT_LEAST)


def test_policy_of_any_robot_keeps_the_rules(policies, datasets, tmp_path):
    for name, topic_map, robot in (("mill", mill(), "mill"), ("arm", arm(), "arm")):
        episode = read(datasets[robot])[0]
        steps = [{key: v[k] for key, v in episode.fields.items()} for k in range(0, 80, 16)]
        saved = policies[name].save(tmp_path / f"{name}-policy")
        check_policy(partial(load_policy, saved), steps, tmp_path / name, topic_map)


def test_card_has_scales_units_and_what_was_clipped(policies):
    card = policies["mill"].card
    by_name = {command.name: command for command in card.action.commands}
    assert by_name["feed"].scale == (SPEED_MM_S,) * 3
    assert by_name["feed"].unit == "mm/s"
    assert (by_name["clamp"].open_value, by_name["clamp"].closed_value) == (OPEN, CLOSED)
    assert card.clipped == {"feed": 0.0, "turn": 0.0}
    drafted = {c.name: c for c in policies["drafted mill"].card.action.commands}
    assert drafted["feed"].scale[0] == SPEED_MM_S  # the largest command of the demonstrations
    goal = policies["arm"].card.action.commands[0]
    assert goal.center[3] == pytest.approx(-2.2, abs=0.2)  # far from zero
    assert max(goal.scale) < 0.5


def test_small_scale_clips_and_the_policy_is_never_faster(datasets):
    slow = replace(RELATIVE_TO_THE_BLANK, action=(CommandTerm("feed", (30.0,)),))
    episodes = read(datasets["mill"])
    quick = TrainingSettings(steps=20, hidden=(8,))
    policy = train([(e, None) for e in episodes], slow, seed=0, settings=quick).policy
    feed = np.concatenate([episode.fields["feed"] for episode in episodes])
    assert policy.card.clipped == {"feed": pytest.approx(np.mean(np.abs(feed) > 30.0))}
    assert 0.2 < policy.card.clipped["feed"] < 0.8
    found = driven(policy, "mill", 0)
    assert list(found) == ["feed"]
    assert np.abs(found["feed"][1]).max() <= 30.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"observation": ("spindle", "nose")}, "no field 'nose'; it has spindle, axes, blank"),
        ({"observation": ("feed",)}, "field 'feed' has role action"),
        ({"observation": ("spindle - axes",)}, "'axes' has 6 in 'deg'"),
        ({"action": (CommandTerm("spindle"),)}, "its commands are feed, turn, clamp"),
        ({"action": (CommandTerm("feed", (1.0, 2.0)),)}, "2 numbers, expected 1 or 3"),
    ],
)
def test_variant_that_does_not_fit_the_robot_is_refused(datasets, change, words):
    variant = replace(RELATIVE_TO_THE_BLANK, **change)
    episodes = [(episode, None) for episode in read(datasets["mill"])]
    with pytest.raises(PolicyError, match=words) as caught:
        train(episodes, variant, seed=0, settings=SETTINGS)
    assert str(caught.value).startswith("variant blank: ")


def test_robot_with_another_unit_or_gripper_is_not_driven(policies):
    def other(name, **changes):
        fields = dict(mill().fields)
        fields[name] = replace(fields[name], **changes)
        return replace(mill(), fields=fields)

    wide = replace(mill(), gripper=replace(mill().gripper, open_value=140.0))
    for topic_map, words in (
        (other("spindle", unit="m"), "'spindle' of the topic map is in 'm', expected 'mm'"),
        (other("turn", unit="rad/s"), "'turn' .* 'rad/s', expected 3 in 'deg/s'"),
        (other("stage", labels=("A", "B")), "phases are A, B, expected APPROACH, HOLD"),
        (wide, "140 open to 0 closed, expected continuous 'clamp', 85 open to 0 closed"),
        (arm(), "no field 'spindle'; it has angles, goal"),
    ):
        with pytest.raises(PolicyError, match=words):
            policies["mill"].check(topic_map)


# --- the command ----------------------------------------------------------------------------


def run(capsys, *arguments):
    """Exit code, JSON rows or text, and stderr of a command."""
    code = curation([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    is_json = "--json" in arguments
    return code, [json.loads(line) for line in out.splitlines()] if is_json else out, err


@pytest.fixture(scope="module")
def selection(datasets):
    """A manifest of all demonstrations of the mill."""
    _, path = save_selection(datasets["mill"], rule="all", name="all")
    return path


def test_train_drafts_a_variant_for_a_robot_that_no_variant_fits(selection, tmp_path, capsys):
    code, [row], err = run(
        capsys, "train", "--selection", selection, "--steps", 5, "--out", tmp_path / "p", "--json"
    )
    assert (code, err) == (0, "")
    assert list(row) == ["policy", "loss", "steps", "seconds", "variant", "clipped"]
    assert (row["variant"], row["clipped"]) == ("draft", {"feed": 0.0, "turn": 0.0})
    card = load_policy(Path(row["policy"])).card
    assert card.observation.terms == ("spindle", "axes", "blank", "stage")
    assert card.action.fields == ("feed", "turn", "clamp")


def test_draft_is_printed_edited_and_trained_with(selection, tmp_path, capsys):
    code, text, _ = run(capsys, "train", "--selection", selection, "--draft")
    assert code == 0
    config = tmp_path / "training.yaml"
    config.write_text(text)
    assert read_training_config(config).variants == {"draft": draft_variant(mill())}
    raw = yaml.safe_load(text)
    raw["settings"] = {"hidden": [8], "steps": 7}
    raw["variants"] = {"mine": {**raw["variants"]["draft"], "observation": ["spindle", "blank"]}}
    config.write_text(yaml.safe_dump(raw))
    arguments = ("train", "--selection", selection, "--config", config, "--json")
    code, [row], _ = run(capsys, *arguments, "--out", tmp_path / "a")
    card = load_policy(tmp_path / "a").card
    assert (code, row["variant"], row["steps"]) == (0, "mine", 7)
    assert (card.settings.hidden, card.observation.terms) == ((8,), ("spindle", "blank"))
    code, [row], err = run(
        capsys, *arguments, "--steps", 3, "--action", "feed=10,clamp", "--observation",
        "spindle,blank@start - spindle", "--out", tmp_path / "b",
    )  # fmt: skip
    card = load_policy(tmp_path / "b").card
    assert (code, row["steps"], row["variant"]) == (0, 3, "mine-changed")
    assert card.observation.terms == ("spindle", "blank@start - spindle")
    assert (card.action.fields, card.action.commands[0].scale) == (("feed", "clamp"), (10.0,) * 3)
    share = row["clipped"]["feed"]
    assert share > 0.5
    assert err.startswith(f"warning: {share:.1%} of the commands of feed were beyond the scale")
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--variant", "relative"], 3, "no field 'eef_position'; it has spindle"),
        (["--variant", "nose"], 2, "no variant 'nose'; its variants are relative, fingers"),
        (["--observation", "nose"], 3, "no field 'nose'"),
        (["--action", "feed=fast"], 2, "'fast' is no number"),
        (["--config", "/nothing.yaml"], 2, "No such file"),
    ],
)
def test_wrong_variant_is_one_line(selection, capsys, arguments, code, words):
    found, rows, err = run(capsys, "train", "--selection", selection, *arguments, "--json")
    assert (found, rows, len(err.splitlines())) == (code, [], 1)
    assert words in err
