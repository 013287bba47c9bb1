from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from demonstrations import (
    PERIOD_NS,
    RELATIVE,
    TOPIC_MAP,
    VARIANTS,
    demonstration,
    libero_observation,
    step_values,
)

from curation_ros.core.episode.topic_map import topic_map_from_json
from curation_ros.core.errors import PolicyError
from policy_node.controller import PolicyController
from policy_node.mlp import MlpPolicy, standardise
from policy_node.settings import TrainingSettings

torch = pytest.importorskip("torch")

from policy_node.train import train  # noqa: E402 - needs torch
from policy_node.training_data import normalisation  # noqa: E402 - needs torch

pytestmark = pytest.mark.policy

#: Largest difference of float32 sums in torch and ours.
TOLERANCE = 1e-6
LOSS_FACTOR = 10.0


@pytest.fixture(autouse=True)
def _one_thread():
    torch.set_num_threads(1)


def whole(*seeds):
    return [(demonstration(seed), None) for seed in seeds]


def quick(episodes, seed=0, variant=RELATIVE, selection=("", ""), **settings):
    numbers = TrainingSettings(**{"steps": 30, "hidden": (16, 16), **settings})
    return train(episodes, variant, seed=seed, settings=numbers, selection=selection)


def arrays(trained):
    return trained.policy.arrays


def assert_same_bits(a, b):
    assert arrays(a).keys() == arrays(b).keys()
    for name, array in arrays(a).items():
        np.testing.assert_array_equal(array, arrays(b)[name])


def test_same_seed_gives_the_same_bits_and_another_seed_others():
    first, again, other = (quick(whole(0, 1), seed) for seed in (5, 5, 6))
    assert_same_bits(first, again)
    assert first.curve == again.curve
    assert first.policy.card.id != again.policy.card.id
    assert not np.array_equal(arrays(first)["layer0.weight"], arrays(other)["layer0.weight"])


def test_bits_do_not_depend_on_threads_or_the_global_generator():
    first = quick(whole(0, 1))
    torch.manual_seed(99)
    before = torch.get_rng_state()
    torch.set_num_threads(2)
    assert_same_bits(first, quick(whole(0, 1)))
    assert torch.get_num_threads() == 2
    assert torch.equal(before, torch.get_rng_state())


def test_order_of_the_episodes_does_not_matter():
    span = (5 * PERIOD_NS, 20 * PERIOD_NS)
    chosen = [*whole(0, 1, 2), (demonstration(3), span)]
    first = quick(chosen)
    assert_same_bits(first, quick(chosen[::-1]))
    ids = [episode["id"] for episode in first.policy.card.episodes]
    assert ids == sorted(ids)


def test_early_steps_do_not_depend_on_how_many_follow():
    short, long = quick(whole(0), steps=100), quick(whole(0), steps=200)
    assert short.curve == long.curve[:1]


@pytest.mark.parametrize("variant", VARIANTS)
def test_torch_and_numpy_agree(variant):
    chosen = whole(0, 1, 2)
    trained = train(chosen, VARIANTS[variant], seed=0, settings=TrainingSettings(steps=150))
    obs = np.concatenate([libero_observation(variant).from_episode(e) for e, _ in chosen])
    kept = arrays(trained)
    with torch.no_grad():
        theirs = trained.network(
            torch.from_numpy(standardise(obs, kept["obs_mean"], kept["obs_std"]))
        ).numpy()
    ours = np.array([trained.policy.output(row) for row in obs])
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=TOLERANCE)


def test_saved_and_loaded_policy_acts_the_same(tmp_path):
    trained = quick(whole(0, 1), selection=("best", "abc"))
    loaded = MlpPolicy.load(trained.policy.save(tmp_path / trained.policy.card.id))
    assert loaded.card == trained.policy.card
    assert (loaded.card.selection_name, loaded.card.selection_hash) == ("best", "abc")
    for row in libero_observation().from_episode(demonstration(0)):
        np.testing.assert_array_equal(loaded.output(row), trained.policy.output(row))


def test_card_tells_what_was_trained_on():
    span = (5 * PERIOD_NS, 20 * PERIOD_NS)
    card = quick([(demonstration(1), span), *whole(0)], seed=3).policy.card
    assert [e["span"] for e in card.episodes] == [None, list(span)]
    assert [e["n_steps"] for e in card.episodes] == [60, 16]
    assert (card.seed, card.settings.steps, card.widths) == (3, 30, (21, 16, 16, 4))
    assert card.topic_map_hash == TOPIC_MAP.hash
    assert card.clipped == {"twist": 0.0}
    assert card.variant == "relative"
    assert set(card.versions) == {"python", "numpy", "torch", "curation_ros"}


def test_span_decides_what_is_learned():
    cut = quick([(demonstration(0), (0, 30 * PERIOD_NS))])
    late = quick([(demonstration(0), (31 * PERIOD_NS, 60 * PERIOD_NS))])
    spec = libero_observation()
    rows = spec.from_episode(demonstration(0))
    for trained, part in ((cut, rows[:30]), (late, rows[30:])):
        mean, std = normalisation(part, spec, 2e-3)
        np.testing.assert_array_equal(arrays(trained)["obs_mean"], mean)
        np.testing.assert_array_equal(arrays(trained)["obs_std"], std)


def test_standardisation_has_a_floor_and_leaves_the_one_hot_alone():
    spec = libero_observation()
    obs = np.concatenate([spec.from_episode(demonstration(seed)) for seed in range(3)])
    mean, std = normalisation(obs, spec, 2e-3)
    height = spec.columns.index("bowl_position@start[2]")
    assert std[height] == 2e-3
    assert obs[:, height].std() < 1e-12
    assert (mean[spec.is_one_hot] == 0).all()
    assert (std[spec.is_one_hot] == 1).all()
    eef = spec.columns.index("eef_position[0]")
    assert std[eef] == obs[:, eef].std()


def test_jitter_of_the_start_changes_training_but_not_the_normalisation():
    with_noise, without = quick(whole(0, 1), start_jitter_m=4e-3), quick(whole(0, 1))
    assert not np.array_equal(
        arrays(with_noise)["layer0.weight"], arrays(without)["layer0.weight"]
    )
    np.testing.assert_array_equal(arrays(with_noise)["obs_std"], arrays(without)["obs_std"])
    assert without.policy.card.settings.start_jitter_m == 0.0


def test_network_cannot_tell_starts_apart_that_are_closer_than_the_jitter():
    # Two episodes at one place, told apart by 2 mm of plate, with opposite gripper commands.
    first = demonstration(0)
    fields = {
        **first.fields,
        "plate_position": first.fields["plate_position"] + 2e-3,
        "gripper": -first.fields["gripper"],
    }
    pair = [(first, None), (replace(first, id="other", fields=fields), None)]
    settings = {"steps": 600, "hidden": (64, 64)}
    # Blind to the difference, the best answer is 0, with a loss of 1 in one output of four.
    assert quick(pair, start_jitter_m=0.02, **settings).loss > 0.2
    assert quick(pair, start_jitter_m=0.0, **settings).loss < 0.02


def test_task_is_learned():
    reported = []
    trained = train(
        whole(*range(8)),
        RELATIVE,
        seed=0,
        settings=TrainingSettings(steps=600, hidden=(64, 64)),
        progress=lambda step, loss: reported.append((step, loss)),
    )
    assert [step for step, _ in trained.curve] == [100, 200, 300, 400, 500, 600]
    assert tuple(reported) == trained.curve
    assert trained.loss == trained.curve[-1][1] < trained.curve[0][1] / LOSS_FACTOR
    # And so is the gripper, on an episode that was never seen.
    unseen = demonstration(100)
    controller = PolicyController(trained.policy)
    grippers = [
        controller.answer(k, step_values(unseen, k))["gripper"] for k in range(len(unseen))
    ]
    assert np.mean(np.array(grippers) == unseen.fields["gripper"]) > 0.95


def test_last_entry_of_the_curve_covers_what_is_left():
    assert [step for step, _ in quick(whole(0), steps=130).curve] == [100, 130]


def test_loss_that_is_not_finite_is_refused_with_its_step():
    with pytest.raises(PolicyError, match=r"loss is nan in step \d+"):
        quick(whole(0), lr=1e30)


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"steps": 0}, "steps"),
        ({"batch_size": 0}, "batch_size"),
        ({"hidden": (16, 0)}, "hidden"),
        ({"hidden": ()}, "hidden"),
        ({"lr": 0.0}, "lr"),
        ({"std_floor": 0.0}, "std_floor"),
        ({"weight_decay": -1.0}, "weight_decay"),
        ({"start_jitter_m": -1.0}, "start_jitter_m"),
        ({"seed": -1}, "seed"),
        ({"seed": 2**63}, "seed"),
    ],
)
def test_setting_out_of_range_is_refused(settings, word):
    with pytest.raises(PolicyError, match=word):
        quick(whole(0), **settings)


def test_no_episode_or_one_twice_is_refused():
    with pytest.raises(PolicyError, match="no episodes"):
        quick([])
    with pytest.raises(PolicyError, match="given twice"):
        quick(whole(0, 1, 0))


def test_two_spans_of_one_episode_are_two_parts():
    spans = [(0, 20 * PERIOD_NS), (41 * PERIOD_NS, 60 * PERIOD_NS)]
    card = quick([(demonstration(0), span) for span in spans]).policy.card
    assert [e["n_steps"] for e in card.episodes] == [20, 20]


def test_differing_topic_maps_are_refused():
    other = replace(demonstration(1), topic_map=replace(TOPIC_MAP, max_gap_s=1.0))
    with pytest.raises(PolicyError, match="has topic map"):
        quick([*whole(0), (other, None)])


def test_clipped_commands_are_on_the_card():
    fast = demonstration(0)
    twist = fast.fields["twist"].copy()
    twist[:15] = 0.5
    fast = replace(fast, fields={**fast.fields, "twist": twist})
    assert quick([(fast, None)]).policy.card.clipped == {"twist": 0.25}


def test_episodes_without_phases_are_refused_by_a_variant_with_phases():
    raw = TOPIC_MAP.to_json()
    del raw["fields"]["phase"]
    bare = topic_map_from_json({**raw, "state": []})
    with pytest.raises(PolicyError, match="variant relative: the topic map has no field 'phase'"):
        quick([(demonstration(0, topic_map=bare), None)])
