from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from demonstrations import PERIOD_NS, TOPIC_MAP, demonstration

from curation_ros.core.episode.topic_map import topic_map_from_json
from curation_ros.core.errors import PolicyError
from policy_node.observation import VARIANTS
from policy_node.policy import Policy

torch = pytest.importorskip("torch")

from policy_node import batch_training  # noqa: E402 - needs torch
from policy_node.batch_training import FailedTraining, TrainingJob, train_many  # noqa: E402
from policy_node.train import TrainedPolicy, TrainingSet, train  # noqa: E402

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


def quick(jobs, **settings):
    return list(train_many(jobs, **{**QUICK, **settings}))


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
    jobs = [TrainingJob(f"{k}", own, 10 + k, variant) for k, own in enumerate(sets)]
    # More steps than are drawn at once: later draws are the same, too.
    settings = {"steps": N_EQUAL + 20, "start_jitter_m": start_jitter_m}
    for job, together in zip(jobs, train_many(jobs, **settings), strict=True):
        alone = train(job.episodes, seed=job.seed, variant=variant, **settings)
        assert len(together.losses) == len(alone.losses) == settings["steps"]
        np.testing.assert_allclose(
            together.losses[:N_EQUAL], alone.losses[:N_EQUAL], rtol=0, atol=TOLERANCE
        )
        # Rounding grows with every step, but another batch would differ a hundred times more.
        np.testing.assert_allclose(together.losses, alone.losses, rtol=0.01, atol=0)
        assert np.ptp(alone.losses[N_EQUAL:]) > 0.05 * alone.losses[-1]


@pytest.mark.parametrize("hidden", [(16,), (32, 8), (8, 32, 16)])
def test_networks_of_any_shape_are_those_of_train(hidden):
    settings = {"steps": 20, "hidden": hidden, "batch_size": 33, "start_jitter_m": 1e-3}
    job = TrainingJob("a", whole(0, 1), 3)
    (together,) = train_many([job], **settings)
    alone = train(job.episodes, seed=3, **settings)
    for name, array in alone.policy.arrays.items():
        np.testing.assert_allclose(together.policy.arrays[name], array, rtol=0, atol=1e-4)
    assert together.losses == pytest.approx(alone.losses, rel=0, abs=TOLERANCE)


def test_card_is_that_of_train():
    span = (5 * PERIOD_NS, 20 * PERIOD_NS)
    job = TrainingJob("a", [*whole(1), (demonstration(0), span)], 3, selection=("best", "abc"))
    (together,) = quick([job])
    alone = train(job.episodes, seed=3, selection=("best", "abc"), **QUICK)
    own = {"id": "", "created_at": "", "curve": (), "seconds": 0.0}
    assert replace(together.policy.card, **own) == replace(alone.policy.card, **own)
    assert [step for step, _ in together.curve] == [step for step, _ in alone.curve]
    assert together.policy.id != alone.policy.id
    assert together.seconds > 0.0


def test_saved_and_loaded_policy_has_the_weights_of_the_network(tmp_path):
    (trained,) = quick([TrainingJob("a", whole(0, 1), 3)])
    loaded = Policy.load(trained.policy.save(tmp_path / trained.policy.id))
    weight = trained.network[0].weight.detach().numpy()
    np.testing.assert_array_equal(loaded.arrays["layer0.weight"], weight)


def test_bits_depend_neither_on_the_group_nor_on_threads():
    jobs = [TrainingJob(f"{k}", whole(k, k + 1), k) for k in range(4)]
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
    results = train_many([TrainingJob(f"{k}", whole(0), k) for k in range(2)], group=1, **QUICK)
    next(results)
    assert torch.is_grad_enabled()
    assert torch.get_num_threads() == 2
    assert torch.equal(before, torch.get_rng_state())


def test_results_come_in_the_order_of_the_jobs_whatever_their_variants():
    variants = itertools.islice(itertools.cycle(VARIANTS), 5)
    jobs = [TrainingJob(f"{k}", whole(k), 40 - k, v) for k, v in enumerate(variants)]
    cards = [trained.policy.card for trained in quick(jobs, group=2)]
    assert [card.seed for card in cards] == [job.seed for job in jobs]
    assert [card.variant for card in cards] == [job.variant for job in jobs]


def test_other_phases_may_be_in_one_group():
    raw = TOPIC_MAP.to_json()
    raw["fields"]["phase"]["labels"].append("WAIT")
    more = [(demonstration(1, topic_map=topic_map_from_json(raw)), None)]
    jobs = [TrainingJob(f"{k}", own, 0) for k, own in enumerate([whole(0), more, whole(2)])]
    together = quick(jobs)
    assert [t.policy.spec.width for t in together] == [21, 22, 21]
    for job, trained in zip(jobs, together, strict=True):
        assert_same_bits(trained, quick([job])[0])


def test_equal_sets_are_prepared_once(monkeypatch):
    made = []

    class Counted(TrainingSet):
        def __init__(self, *args):
            super().__init__(*args)
            made.append(self)

    monkeypatch.setattr(batch_training, "TrainingSet", Counted)
    chosen, other = whole(0, 1), [(demonstration(0), (0, 20 * PERIOD_NS))]
    jobs = [
        TrainingJob("a", chosen, 0),
        TrainingJob("b", chosen[::-1], 1),
        TrainingJob("c", other, 2),
        TrainingJob("d", chosen[:1], 3),
    ]
    assert len(quick(jobs)) == 4
    assert len(made) == 3


def test_no_job_gives_nothing():
    assert quick([]) == []


def test_progress_tells_each_job():
    reported = []
    jobs = [TrainingJob(key, whole(0), seed) for seed, key in enumerate("ab")]
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
    jobs = [TrainingJob(key, own, 7) for key, own in sets.items()]
    first, failed, last = quick(jobs, steps=230)
    with pytest.raises(PolicyError) as err:
        train(bad, seed=7, **QUICK)
    assert failed == FailedTraining("bad", str(err.value))
    assert "loss is nan in step 0" in failed.reason
    for job, trained in ((jobs[0], first), (jobs[2], last)):
        assert_same_bits(trained, quick([job], steps=230)[0])


def test_loss_that_ceases_to_be_finite_is_named_with_its_step():
    reported = []
    jobs = [TrainingJob(f"{k}", whole(k), k) for k in range(2)]
    for job, failed in zip(
        jobs, quick(jobs, lr=1e30, progress=lambda *args: reported.append(args)), strict=True
    ):
        with pytest.raises(PolicyError) as err:
            train(job.episodes, seed=job.seed, lr=1e30, **QUICK)
        assert failed == FailedTraining(job.key, str(err.value))
    assert reported == []


def test_job_that_cannot_be_trained_costs_itself_alone():
    jobs = [
        TrainingJob("none", [], 0),
        TrainingJob("twice", whole(0, 0), 0),
        TrainingJob("seed", whole(0), -1),
        TrainingJob("pixels", whole(0), 0, variant="pixels"),
        TrainingJob("good", whole(0), 0),
    ]
    *failed, good = quick(jobs)
    assert [result.key for result in failed] == ["none", "twice", "seed", "pixels"]
    for result, word in zip(
        failed, ("no episodes", "given twice", "seed is -1", "pixels"), strict=True
    ):
        assert word in result.reason
    assert_same_bits(good, quick(jobs[-1:])[0])


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"steps": 0}, "steps"),
        ({"batch_size": 0}, "batch_size"),
        ({"hidden": ()}, "hidden"),
        ({"lr": float("nan")}, "lr"),
        ({"std_floor": 0.0}, "std_floor"),
        ({"weight_decay": -1.0}, "weight_decay"),
        ({"start_jitter_m": -1.0}, "start_jitter_m"),
        ({"action_scale": 0.0}, "action scale"),
        ({"group": 0}, "group"),
    ],
)
def test_setting_out_of_range_is_refused_before_a_result_is_asked_for(settings, word):
    with pytest.raises(PolicyError, match=word):
        train_many([TrainingJob("a", whole(0), 0)], **settings)


def test_key_of_two_jobs_is_refused():
    with pytest.raises(PolicyError, match="key 'a' is given to 2 jobs"):
        train_many([TrainingJob("a", whole(0), 0), TrainingJob("a", whole(1), 1)])
