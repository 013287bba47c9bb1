from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from demonstrations import PERIOD_NS, RELATIVE, TOPIC_MAP, VARIANTS, demonstration

from curation_ros.core.episode.topic_map import topic_map_from_json
from curation_ros.core.errors import PolicyError
from policy_node.action import CommandTerm
from policy_node.mlp import MlpPolicy
from policy_node.settings import TrainingSettings

torch = pytest.importorskip("torch")

from policy_node import train_many as module  # noqa: E402 - needs torch
from policy_node.train import TrainedPolicy, train  # noqa: E402
from policy_node.train_many import FailedTraining, TrainingJob, train_many  # noqa: E402
from policy_node.training_data import TrainingData  # noqa: E402

pytestmark = pytest.mark.policy

N_EQUAL = 100
#: Largest difference of the first N_EQUAL losses: sums are taken in another order.
TOLERANCE = 1e-5
QUICK = {"steps": 30, "hidden": (16, 16)}


@pytest.fixture(autouse=True)
def _one_thread():
    torch.set_num_threads(1)


def whole(*seeds):
    return [(demonstration(seed, 40 + 7 * seed), None) for seed in seeds]


def job_of(key, episodes, seed, variant=RELATIVE, selection=("", "")):
    return TrainingJob(key, episodes, variant, seed, selection)


def quick(jobs, group=module.GROUP, progress=None, **settings):
    numbers = TrainingSettings(**{**QUICK, **settings})
    return list(train_many(jobs, numbers, group=group, progress=progress))


def alone(one, **settings):
    """The policy that `train` gives for a job."""
    numbers = TrainingSettings(**{**QUICK, **settings})
    return train(
        one.episodes, one.variant, seed=one.seed, settings=numbers, selection=one.selection
    )


def assert_same_bits(a, b):
    assert isinstance(a, TrainedPolicy)
    assert isinstance(b, TrainedPolicy)
    assert a.losses == b.losses
    for name, array in a.policy.arrays.items():
        np.testing.assert_array_equal(array, b.policy.arrays[name])


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("start_jitter_m", [0.0, 4e-3])
def test_first_losses_are_those_of_train_for_sets_of_any_size_in_one_group(
    variant, start_jitter_m
):
    sets = [whole(0), whole(0, 1, 2), whole(3, 4), whole(0, 1, 2)]
    jobs = [job_of(f"{k}", own, 10 + k, VARIANTS[variant]) for k, own in enumerate(sets)]
    # More steps than are drawn at once: later draws are the same, too.
    settings = {"steps": N_EQUAL + 20, "start_jitter_m": start_jitter_m, "hidden": (256, 256)}
    for job, together in zip(jobs, quick(jobs, **settings), strict=True):
        expected = alone(job, **settings).losses
        assert len(together.losses) == len(expected) == settings["steps"]
        np.testing.assert_allclose(
            together.losses[:N_EQUAL], expected[:N_EQUAL], rtol=0, atol=TOLERANCE
        )
        # Rounding grows with every step, but another batch would differ a hundred times more.
        np.testing.assert_allclose(together.losses, expected, rtol=0.01, atol=0)
        assert np.ptp(expected[N_EQUAL:]) > 0.05 * expected[-1]


@pytest.mark.parametrize("hidden", [(16,), (32, 8), (8, 32, 16)])
def test_networks_of_any_shape_are_those_of_train(hidden):
    settings = {"steps": 20, "hidden": hidden, "batch_size": 33, "start_jitter_m": 1e-3}
    job = job_of("a", whole(0, 1), 3)
    (together,) = quick([job], **settings)
    expected = alone(job, **settings)
    for name, array in expected.policy.arrays.items():
        np.testing.assert_allclose(together.policy.arrays[name], array, rtol=0, atol=1e-4)
    assert together.losses == pytest.approx(expected.losses, rel=0, abs=TOLERANCE)


def test_commands_of_any_width_are_those_of_train():
    """Three outputs, and no gripper."""
    narrow = replace(RELATIVE, name="narrow", action=(CommandTerm("twist"),))
    job = job_of("a", whole(0, 1), 3, narrow)
    (together,) = quick([job])
    expected = alone(job)
    assert expected.policy.card.widths == (21, 16, 16, 3)
    assert together.losses == pytest.approx(expected.losses, rel=0, abs=TOLERANCE)


def test_card_is_that_of_train():
    span = (5 * PERIOD_NS, 20 * PERIOD_NS)
    job = job_of("a", [*whole(1), (demonstration(0), span)], 3, selection=("best", "abc"))
    (together,) = quick([job])
    expected = alone(job)
    own = {"id": "", "created_at": "", "curve": (), "seconds": 0.0}
    assert replace(together.policy.card, **own) == replace(expected.policy.card, **own)
    assert [step for step, _ in together.curve] == [step for step, _ in expected.curve]
    assert together.policy.card.id != expected.policy.card.id
    assert together.seconds > 0.0


def test_saved_and_loaded_policy_has_the_weights_of_the_network(tmp_path):
    (trained,) = quick([job_of("a", whole(0, 1), 3)])
    loaded = MlpPolicy.load(trained.policy.save(tmp_path / trained.policy.card.id))
    weight = trained.network[0].weight.detach().numpy()
    np.testing.assert_array_equal(loaded.arrays["layer0.weight"], weight)


def test_bits_depend_neither_on_the_group_nor_on_threads():
    jobs = [job_of(f"{k}", whole(k, k + 1), k) for k in range(4)]
    together = quick(jobs, group=4)
    torch.set_num_threads(2)
    for group in (1, 3):
        for a, b in zip(together, quick(jobs, group=group), strict=True):
            assert_same_bits(a, b)
    assert torch.get_num_threads() == 2


def test_global_generator_and_gradients_are_as_before_while_results_are_taken():
    torch.manual_seed(99)
    before = torch.get_rng_state()
    torch.set_num_threads(2)
    jobs = [job_of(f"{k}", whole(0), k) for k in range(2)]
    results = train_many(jobs, TrainingSettings(**QUICK), group=1)
    next(results)
    assert torch.is_grad_enabled()
    assert torch.get_num_threads() == 2
    assert torch.equal(before, torch.get_rng_state())


def test_results_come_in_the_order_of_the_jobs_whatever_their_variants():
    variants = itertools.islice(itertools.cycle(VARIANTS.values()), 5)
    jobs = [job_of(f"{k}", whole(k), 40 - k, v) for k, v in enumerate(variants)]
    cards = [trained.policy.card for trained in quick(jobs, group=2)]
    assert [card.seed for card in cards] == [job.seed for job in jobs]
    assert [card.variant for card in cards] == [job.variant.name for job in jobs]


def test_other_phases_may_be_in_one_group():
    raw = TOPIC_MAP.to_json()
    raw["fields"]["phase"]["labels"].append("WAIT")
    more = [(demonstration(1, topic_map=topic_map_from_json(raw)), None)]
    jobs = [job_of(f"{k}", own, 0) for k, own in enumerate([whole(0), more, whole(2)])]
    together = quick(jobs)
    assert [t.policy.card.observation.width for t in together] == [21, 22, 21]
    for job, trained in zip(jobs, together, strict=True):
        assert_same_bits(trained, quick([job])[0])


def test_equal_sets_are_prepared_once(monkeypatch):
    made = []

    class Counted(TrainingData):
        def __init__(self, *args):
            super().__init__(*args)
            made.append(self)

    monkeypatch.setattr(module, "TrainingData", Counted)
    chosen, other = whole(0, 1), [(demonstration(0), (0, 20 * PERIOD_NS))]
    jobs = [
        job_of("a", chosen, 0),
        job_of("b", chosen[::-1], 1),
        job_of("c", other, 2),
        job_of("d", chosen[:1], 3),
    ]
    assert len(quick(jobs)) == 4
    assert len(made) == 3


def test_no_job_gives_nothing():
    assert quick([]) == []


def test_progress_tells_each_job():
    reported = []
    jobs = [job_of(key, whole(0), seed) for seed, key in enumerate("ab")]
    together = quick(jobs, steps=130, progress=lambda *args: reported.append(args))
    assert [(key, step) for key, step, _ in reported] == [
        ("a", 100),
        ("b", 100),
        ("a", 130),
        ("b", 130),
    ]
    assert tuple((step, loss) for key, step, loss in reported if key == "b") == together[1].curve


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning", "ignore:invalid:RuntimeWarning")
def test_loss_that_is_not_finite_costs_its_job_alone():
    # Finite as recorded, but their mean is not.
    episode = demonstration(1)
    bad_fields = {**episode.fields, "eef_position": episode.fields["eef_position"] * 1e308 * 6}
    bad = [(replace(episode, fields=bad_fields), None)]
    sets = {"first": whole(0, 1), "bad": bad, "last": whole(2)}
    jobs = [job_of(key, own, 7) for key, own in sets.items()]
    first, failed, last = quick(jobs, steps=230)
    with pytest.raises(PolicyError) as err:
        alone(jobs[1])
    assert failed == FailedTraining("bad", str(err.value))
    assert "loss is nan in step 0" in failed.reason
    for job, trained in ((jobs[0], first), (jobs[2], last)):
        assert_same_bits(trained, quick([job], steps=230)[0])


def test_loss_that_ceases_to_be_finite_is_named_with_its_step():
    reported = []
    jobs = [job_of(f"{k}", whole(k), k) for k in range(2)]
    for job, failed in zip(
        jobs, quick(jobs, lr=1e30, progress=lambda *args: reported.append(args)), strict=True
    ):
        with pytest.raises(PolicyError) as err:
            alone(job, lr=1e30)
        assert failed == FailedTraining(job.key, str(err.value))
    assert reported == []


def test_job_that_cannot_be_trained_costs_itself_alone():
    jobs = [
        job_of("none", [], 0),
        job_of("twice", whole(0, 0), 0),
        job_of("seed", whole(0), -1),
        job_of("pixels", whole(0), 0, replace(RELATIVE, observation=("pixels",))),
        job_of("good", whole(0), 0),
    ]
    *failed, good = quick(jobs)
    assert [result.key for result in failed] == ["none", "twice", "seed", "pixels"]
    for result, word in zip(
        failed, ("no episodes", "given twice", "seed is -1", "pixels"), strict=True
    ):
        assert word in result.reason
    assert_same_bits(good, quick(jobs[-1:])[0])


def test_group_out_of_range_is_refused_before_a_result_is_asked_for():
    with pytest.raises(PolicyError, match="group is 0"):
        train_many([job_of("a", whole(0), 0)], group=0)


def test_key_of_two_jobs_is_refused():
    with pytest.raises(PolicyError, match="key 'a' is given to 2 jobs"):
        train_many([job_of("a", whole(0), 0), job_of("a", whole(1), 1)])
