from __future__ import annotations

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
import safetensors.numpy
from demonstrations import TOPIC_MAP

from curation_ros.core.errors import PolicyError
from policy_node.observation import ObservationSpec
from policy_node.policy import CARD, WEIGHTS, Card, Policy, standardise

HIDDEN = 8


def card(**changes) -> Card:
    spec = ObservationSpec(changes.get("variant", "relative"))
    values = {
        "id": "01990000-0000-7000-8000-000000000000",
        "created_at": "2026-01-01T00:00:00+00:00",
        "variant": spec.variant,
        "columns": spec.columns,
        "phase_labels": spec.phase_labels,
        "action_scale": 0.2,
        "widths": (spec.width, HIDDEN, 4),
        "topic_map_hash": TOPIC_MAP.hash,
        "selection_name": "all",
        "selection_hash": "abc",
        "episodes": (
            {"id": "a", "span": [0, 5], "n_steps": 3},
            {"id": "b", "span": None, "n_steps": 2},
        ),
        "seed": 7,
        "steps": 100,
        "batch_size": 256,
        "lr": 1e-3,
        "weight_decay": 1e-4,
        "std_floor": 2e-3,
        "start_jitter_m": 4e-3,
        "clipped_fraction": 0.0,
        "curve": ((100, 0.5),),
        "seconds": 1.5,
        "versions": {"python": "3.11"},
    }
    return Card(**{**values, **changes})


def policy(**changes) -> Policy:
    made = card(**changes)
    rng = np.random.default_rng(0)
    width = len(made.columns)
    weights = [
        (rng.normal(size=(n_out, n_in)).astype(np.float32), np.ones(n_out, np.float32))
        for n_in, n_out in ((width, HIDDEN), (HIDDEN, 4))
    ]
    return Policy(made, weights, rng.normal(size=width), rng.uniform(0.1, 1.0, width))


@pytest.fixture
def folder(tmp_path):
    return policy().save(tmp_path / "policies" / "p")


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
        Policy.load(folder)
    message = str(caught.value)
    assert "\n" not in message
    for word in (str(folder), *words):
        assert word in message


def test_saved_policy_is_loaded_with_the_same_card_and_the_same_bits(folder):
    loaded, made = Policy.load(folder), policy()
    assert loaded.card == made.card
    assert loaded.id == made.card.id
    obs = np.random.default_rng(1).normal(size=(20, loaded.spec.width))
    for row in obs:
        np.testing.assert_array_equal(loaded.output(row), made.output(row))


def test_output_is_the_written_formula():
    made = policy()
    arrays = made.arrays
    obs = np.random.default_rng(2).normal(size=21)
    x = standardise(obs, arrays["obs_mean"], arrays["obs_std"])
    x = np.maximum(arrays["layer0.weight"] @ x + arrays["layer0.bias"], 0.0)
    x = np.tanh(arrays["layer1.weight"] @ x + arrays["layer1.bias"])
    np.testing.assert_allclose(made.output(obs), x, atol=1e-6)
    xyz, gripper = made.act(obs)
    np.testing.assert_allclose(xyz, 0.2 * x[:3], atol=1e-6)
    assert gripper == np.sign(x[3])
    assert isinstance(gripper, float)


def test_save_never_overwrites_and_leaves_nothing_behind(folder):
    before = (folder / CARD).read_bytes()
    with pytest.raises(PolicyError, match="exists"):
        policy(seed=8).save(folder)
    assert (folder / CARD).read_bytes() == before
    assert [p.name for p in folder.parent.iterdir()] == ["p"]


def test_save_into_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(PolicyError, match="file"):
        policy().save(tmp_path / "file" / "p")


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
        ({"format": 2}, ("'format' is 2", "expected 1")),
        ({"variant": "pixels"}, ("'pixels' is none of",)),
        ({"variant": "fingers"}, ("bowl_position@start[0]", "expected 'finger_position[0]'")),
        ({"phase_labels": ["A", "B", "C", "D", "E", "F"]}, ("phase=PREGRASP", "phase=A")),
        ({"phase_labels": []}, ("phase labels",)),
        ({"columns": ["eef_position[0]"]}, ("found 1, expected 21",)),
        ({"columns": "eef_position"}, ("'columns'", "expected list")),
        ({"columns": [1]}, ("'columns' must be a list of str",)),
        ({"widths": [20, 8, 4]}, ("[20, 8, 4]", "expected 21 first")),
        ({"widths": [21, 8, 3]}, ("[21, 8, 3]", "4 last")),
        ({"widths": []}, ("expected 21 first",)),
        ({"widths": [21, 9, 4]}, (WEIGHTS, "layer0.weight", "expected float32 (9, 21)")),
        ({"widths": [21, 8, 8, 4]}, (WEIGHTS, "layer2.bias", "missing")),
        ({"widths": [21, 4]}, (WEIGHTS, "layer1.bias", "not expected")),
        ({"action_scale": 0}, ("action scale is 0",)),
        ({"action_scale": True}, ("'action_scale' is True",)),
        ({"seed": "7"}, ("'seed' is '7'", "expected int")),
        ({"episodes": [{"id": "a"}]}, ("'episodes'",)),
        ({"curve": [1, 2]}, ("'curve'",)),
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
        policy().act(obs)


def test_check_accepts_renamed_topics_and_refuses_other_meanings():
    made = policy()
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
