from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from demonstrations import TOPIC_MAP, demonstration, libero_observation, step_values
from mlps import mlp

from curation_ros.core.errors import PolicyError
from policy_node.controller import PolicyController
from policy_node.mlp import WEIGHTS, MlpPolicy, standardise
from policy_node.policy import CARD, load_policy
from policy_node.testing import check_policy

FORMAT_1 = Path(__file__).parent / "format_1"


@pytest.fixture
def folder(tmp_path):
    return mlp().save(tmp_path / "policies" / "p")


def rewrite_card(folder, **changes):
    raw = json.loads((folder / CARD).read_text())
    raw.update(changes)
    (folder / CARD).write_text(json.dumps({k: v for k, v in raw.items() if v != "DROP"}))


def rewrite_weights(folder, change):
    """Change the arrays and make the card's digest fit again."""
    arrays = safetensors.numpy.load_file(folder / WEIGHTS)
    change(arrays)
    data = safetensors.numpy.save(arrays)
    (folder / WEIGHTS).write_bytes(data)
    rewrite_card(folder, weights_sha256=hashlib.sha256(data).hexdigest())


def assert_refused(folder, *words):
    with pytest.raises(PolicyError) as caught:
        load_policy(folder)
    message = str(caught.value)
    assert "\n" not in message
    for word in (str(folder), *words):
        assert word in message


def test_saved_policy_is_loaded_with_the_same_card_and_the_same_bits(folder):
    loaded, made = MlpPolicy.load(folder), mlp()
    assert loaded.card == made.card
    obs = np.random.default_rng(1).normal(size=(20, loaded.card.observation.width))
    for row in obs:
        np.testing.assert_array_equal(loaded.output(row), made.output(row))


def test_output_is_the_written_formula():
    made = mlp()
    arrays = made.arrays
    obs = np.random.default_rng(2).normal(size=21)
    x = standardise(obs, arrays["obs_mean"], arrays["obs_std"])
    x = np.maximum(arrays["layer0.weight"] @ x + arrays["layer0.bias"], 0.0)
    x = np.tanh(arrays["layer1.weight"] @ x + arrays["layer1.bias"])
    np.testing.assert_allclose(made.output(obs), x, atol=1e-6)


def test_save_never_overwrites_and_leaves_nothing_behind(folder):
    before = (folder / CARD).read_bytes()
    with pytest.raises(PolicyError, match="exists"):
        mlp(seed=8).save(folder)
    assert (folder / CARD).read_bytes() == before
    assert [p.name for p in folder.parent.iterdir()] == ["p"]


def test_save_into_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(PolicyError, match="file"):
        mlp().save(tmp_path / "file" / "p")


@pytest.mark.parametrize("name", [CARD, WEIGHTS])
def test_missing_file_is_refused(folder, name):
    (folder / name).unlink()
    assert_refused(folder, name, "No such file")


def test_missing_folder_is_refused(tmp_path):
    assert_refused(tmp_path / "nothing", CARD, "No such file")


def test_every_missing_key_is_refused(folder):
    whole = (folder / CARD).read_text()
    for key in json.loads(whole):
        rewrite_card(folder, **{key: "DROP"})
        assert_refused(folder, CARD, f"{key!r} is missing")
        (folder / CARD).write_text(whole)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format": 3}, ("'format' is 3", "expected 2")),
        ({"kind": "cnn"}, ("kind 'cnn' of policy is none of mlp",)),
        ({"columns": ["eef_position[0]"]}, ("found 1, expected 21",)),
        ({"columns": "eef_position"}, ("'columns'", "expected list")),
        ({"columns": [1]}, ("'columns' must be a list of str",)),
        ({"observation": {"terms": []}}, ("'observation'", "expected terms and fields")),
        ({"action": {}}, ("'action'", "expected a list")),
        ({"settings": {"hidden": [0]}}, ("hidden is 0",)),
        ({"settings": {"nose": 1}}, ("unknown key 'nose'",)),
        ({"settings": {"hidden": [9]}}, (WEIGHTS, "layer0.weight", "expected float32 (9, 21)")),
        ({"settings": {"hidden": [8, 8]}}, (WEIGHTS, "layer2.bias", "missing")),
        ({"seed": "7"}, ("'seed' is '7'", "expected int")),
        ({"seconds": True}, ("'seconds' is True",)),
        ({"episodes": [{"id": "a"}]}, ("'episodes'",)),
        ({"curve": [1, 2]}, ("'curve'",)),
        ({"clipped": {"twist": "much"}}, ("'clipped'",)),
        ({"weights_sha256": "0" * 64}, (WEIGHTS, "expected 000000000000")),
    ],
)
def test_card_that_does_not_fit_is_refused(folder, changes, words):
    rewrite_card(folder, **changes)
    assert_refused(folder, *words)


@pytest.mark.parametrize("text", ["", "{", "[]", "\xff", '"card"'])
def test_card_that_is_no_json_object_is_refused(folder, text):
    (folder / CARD).write_bytes(text.encode("latin-1"))
    assert_refused(folder, CARD)


def test_every_flipped_or_lost_byte_of_the_weights_is_noticed(folder):
    data = (folder / WEIGHTS).read_bytes()
    for k in (0, 9, len(data) // 2, len(data) - 1):
        damaged = bytearray(data)
        damaged[k] ^= 1
        (folder / WEIGHTS).write_bytes(damaged)
        assert_refused(folder, WEIGHTS, "SHA-256")
    (folder / WEIGHTS).write_bytes(data[:-1])
    assert_refused(folder, WEIGHTS, "SHA-256")


def test_weights_that_are_no_safetensors_are_refused(folder):
    data = b"not a safetensors file"
    (folder / WEIGHTS).write_bytes(data)
    rewrite_card(folder, weights_sha256=hashlib.sha256(data).hexdigest())
    assert_refused(folder, WEIGHTS, "not a safetensors file")


def set_nan(arrays):
    arrays["layer0.bias"][0] = np.nan


def set_zero_std(arrays):
    arrays["obs_std"][0] = 0.0


def set_float64(arrays):
    arrays["layer0.bias"] = arrays["layer0.bias"].astype(np.float64)


def set_short_mean(arrays):
    arrays["obs_mean"] = arrays["obs_mean"][:20]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (set_nan, ("layer0.bias", "not finite")),
        (set_zero_std, ("obs_std", "not positive")),
        (set_float64, ("layer0.bias", "float64 (8,), expected float32 (8,)")),
        (set_short_mean, ("obs_mean", "(20,), expected float64 (21,)")),
        (lambda arrays: arrays.pop("obs_std"), ("obs_std", "missing")),
    ],
)
def test_arrays_that_do_not_fit_are_refused(folder, change, words):
    rewrite_weights(folder, change)
    assert_refused(folder, WEIGHTS, *words)


@pytest.mark.parametrize("obs", [np.zeros(20), np.zeros((1, 21)), np.full(21, np.nan)])
def test_observation_that_does_not_fit_is_refused(obs):
    with pytest.raises(PolicyError, match="policy 0199"):
        mlp().output(obs)


@pytest.mark.parametrize("variant", ["relative", "fingers"])
def test_mlp_keeps_the_rules_of_a_policy(variant, tmp_path):
    episode = demonstration(1)
    steps = [step_values(episode, k) for k in range(0, 60, 9)]
    check_policy(lambda: mlp(variant), steps, tmp_path, TOPIC_MAP)


@pytest.mark.parametrize("variant", ["relative", "fingers"])
def test_mlp_observes_what_training_observed(variant):
    made, episode = mlp(variant), demonstration(1)
    for k, row in enumerate(libero_observation(variant).from_episode(episode)):
        made.observe(step_values(episode, k))
        command = made.act()
        expected = made.card.action.command(made.output(row))
        assert list(command) == ["twist", "gripper"]
        for name, values in command.items():
            np.testing.assert_array_equal(values, expected[name])


def test_values_at_the_start_are_kept_until_reset():
    made = mlp()
    first, other = step_values(demonstration(1), 0), step_values(demonstration(2), 0)
    made.observe(first)
    made.observe(other)
    held = made.act()["twist"]
    made.reset()
    made.observe(other)
    assert not np.array_equal(held, made.act()["twist"])


def test_refused_first_observation_is_not_the_start():
    made, values = mlp(), step_values(demonstration(1), 0)
    for wrong, words in (
        ({"bowl_position": np.full(3, np.nan)}, "is nan"),
        ({"bowl_position": np.ones(3), "phase": np.array([9.0])}, "phase index"),
        ({"eef_position": np.ones(2)}, "has shape"),
    ):
        with pytest.raises(PolicyError, match=words):
            made.observe({**values, **wrong})
    made.observe(values)
    fresh = mlp()
    fresh.observe(values)
    np.testing.assert_array_equal(made.act()["twist"], fresh.act()["twist"])


# --- format 1 -------------------------------------------------------------------------------


def test_policy_of_format_1_gives_the_commands_that_it_gave():
    """Trained and driven at commit d434e8b."""
    controller = PolicyController(load_policy(FORMAT_1))
    episode = demonstration(0)
    for step, twist, gripper in json.loads((FORMAT_1 / "commands.json").read_text()):
        command = controller.answer(step, step_values(episode, step))
        assert [value.hex() for value in command["twist"].tolist()] == twist
        assert command["gripper"].tolist() == [gripper]


def test_card_of_format_1_is_read(tmp_path):
    made = MlpPolicy.load(FORMAT_1)
    card = made.card
    assert (card.kind, card.variant, card.widths) == ("mlp", "fingers", (23, 16, 16, 4))
    assert card.observation == libero_observation("fingers")
    assert card.action == mlp("fingers").card.action
    assert (card.settings.steps, card.settings.start_jitter_m) == (130, 4e-3)
    assert (card.selection_name, card.seed, card.clipped) == ("best", 3, {"twist": 0.0})
    again = MlpPolicy.load(made.save(tmp_path / "p"))
    assert again.card == card
    assert json.loads((tmp_path / "p" / CARD).read_text())["format"] == 2


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"phase_labels": ["A", "B"]}, ("'phase_labels' are ['A', 'B']",)),
        ({"columns": ["eef_position[1]"]}, ("found 'eef_position[1]'",)),
        ({"widths": [20, 8, 4]}, ("[20, 8, 4]", "expected 23 first")),
        ({"widths": [23, 8, 3]}, ("[23, 8, 3]", "4 last")),
        ({"widths": []}, ("expected 23 first",)),
        ({"action_scale": 0}, ("scale is 0",)),
        ({"action_scale": True}, ("'action_scale' is True",)),
        ({"steps": 0}, ("steps is 0",)),
        ({"batch_size": "DROP"}, ("'batch_size' is missing",)),
    ],
)
def test_card_of_format_1_that_does_not_fit_is_refused(tmp_path, changes, words):
    for name in (CARD, WEIGHTS):
        (tmp_path / name).write_bytes((FORMAT_1 / name).read_bytes())
    rewrite_card(tmp_path, **changes)
    assert_refused(tmp_path, *words)


# --- robots ---------------------------------------------------------------------------------


def test_check_accepts_renamed_topics_and_refuses_other_meanings():
    made = mlp()
    fields = {n: replace(s, topic=f"robot2/{s.topic}") for n, s in TOPIC_MAP.fields.items()}
    renamed = replace(TOPIC_MAP, fields=fields)
    assert renamed.hash != TOPIC_MAP.hash
    made.check(renamed)
    fewer = {n: s for n, s in TOPIC_MAP.fields.items() if n != "plate_position"}
    with pytest.raises(PolicyError, match=r"policy 0199.*no field 'plate_position'"):
        made.check(replace(TOPIC_MAP, fields=fewer))
    phase = replace(TOPIC_MAP.fields["phase"], labels=("REACH", "GRASP"))
    with pytest.raises(PolicyError, match="phases are REACH, GRASP, expected PREGRASP"):
        made.check(replace(TOPIC_MAP, fields={**TOPIC_MAP.fields, "phase": phase}))
    with pytest.raises(PolicyError, match="gripper"):
        made.check(replace(TOPIC_MAP, gripper=None))
