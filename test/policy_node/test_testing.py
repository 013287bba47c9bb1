"""The conformance check: it accepts policies of other kinds, and names each broken rule."""

from __future__ import annotations

import numpy as np
import pytest
from demonstrations import TOPIC_MAP, demonstration, step_values
from toy_policies import ChunkedPolicy, ImagePolicy, image_steps

from curation_ros.core.errors import PolicyError
from policy_node import testing
from policy_node.testing import check_policy


def steps(n=9):
    episode = demonstration(1)
    return [step_values(episode, 5 * k) for k in range(n)]


@pytest.mark.parametrize("ensembles", [False, True])
@pytest.mark.parametrize("horizon", [1, 4, 20])
def test_chunked_policy_keeps_the_rules(tmp_path, horizon, ensembles):
    check_policy(lambda: ChunkedPolicy(horizon, ensembles), steps(), tmp_path, TOPIC_MAP)


def test_image_policy_keeps_the_rules(tmp_path):
    check_policy(ImagePolicy, image_steps(5), tmp_path)


def test_few_steps_are_refused(tmp_path):
    with pytest.raises(ValueError, match="2 steps are given, expected at least 3"):
        check_policy(ChunkedPolicy, steps(2), tmp_path)


# --- policies that break a rule -------------------------------------------------------------


class NamesTooMuch(ChunkedPolicy):
    observed = ("eef_position", "bowl_position")

    def observe(self, values):
        values = {"bowl_position": None, **values}
        super().observe(values)


class NamesTooLittle(ChunkedPolicy):
    def observe(self, values):
        super().observe(values)
        self._bowl = values["bowl_position"]


class RaisesKeyError(ChunkedPolicy):
    def observe(self, values):
        super().observe({"eef_position": values["eef_position"]})


class ForgetsWhenRefusing(ChunkedPolicy):
    def observe(self, values):
        try:
            super().observe(values)
        except PolicyError:
            self.reset()
            raise


class ActsBlindly(ChunkedPolicy):
    def act(self):
        if self._step < 0:
            return {"twist": np.zeros(3), "gripper": np.zeros(1)}
        return super().act()


class LacksTheGripper(ChunkedPolicy):
    def act(self):
        return {"twist": super().act()["twist"]}


class GivesAList(ChunkedPolicy):
    def act(self):
        return {**super().act(), "gripper": [1.0]}


class GivesNan(ChunkedPolicy):
    def act(self):
        return {**super().act(), "gripper": np.array([np.nan])}


class AdvancesInAct(ChunkedPolicy):
    """A chunk that is popped by each call, the most likely mistake."""

    def act(self):
        command = super().act()
        self._step += 1
        return command


class TiresOverEpisodes(ChunkedPolicy):
    def reset(self):
        super().reset()
        self._n_episodes = getattr(self, "_n_episodes", 0) + 1

    def _plan(self, place):
        return super()._plan(place) / self._n_episodes


class SharesItsState(ChunkedPolicy):
    _shared: dict = {}  # noqa: RUF012 - the fault

    def reset(self):
        super().reset()
        self._chunks = self._shared
        self._shared.clear()


class KeepsTheArray(ChunkedPolicy):
    def observe(self, values):
        super().observe(values)
        self._place = values["eef_position"]

    def act(self):
        super().act()
        return {"twist": -self._place, "gripper": np.ones(1)}


class WritesIntoTheArray(ChunkedPolicy):
    def observe(self, values):
        super().observe(values)
        values["eef_position"] *= 0.5


class GivesItsOwnArray(ChunkedPolicy):
    def observe(self, values):
        super().observe(values)
        self._command = super().act()

    def act(self):
        super().act()
        return self._command


class ForgetsItsHorizon(ChunkedPolicy):
    @classmethod
    def load(cls, folder):
        made = super().load(folder)
        made.horizon = 2
        return made


class WritesNoKind(ChunkedPolicy):
    def save(self, folder):
        path = super().save(folder)
        card = path / testing.CARD
        card.write_text(card.read_text().replace("toy-chunked", "toy"))
        return path


class Overwrites(ChunkedPolicy):
    def save(self, folder):
        return folder if folder.exists() else super().save(folder)


class LoadsNothing(ChunkedPolicy):
    @classmethod
    def load(cls, folder):
        return super().load(folder) if folder.exists() else cls()


class RefusesItsRobot(ChunkedPolicy):
    def check(self, topic_map):
        raise PolicyError("never")


class TakesAnyRobot(ChunkedPolicy):
    def check(self, topic_map):
        pass


BROKEN = {
    NamesTooMuch: testing.REFUSED,
    NamesTooLittle: testing.OBSERVED,
    RaisesKeyError: testing.REFUSED,
    ForgetsWhenRefusing: testing.UNCHANGED,
    ActsBlindly: testing.NOTHING,
    LacksTheGripper: testing.COMMANDED,
    GivesAList: testing.COMMANDED,
    GivesNan: testing.COMMANDED,
    AdvancesInAct: testing.ACT_REPEATS,
    TiresOverEpisodes: testing.REPEATS,
    SharesItsState: testing.SEPARATE,
    KeepsTheArray: testing.COPIES,
    WritesIntoTheArray: testing.LEAVES,
    GivesItsOwnArray: testing.OWN_ANSWER,
    ForgetsItsHorizon: testing.SAVED,
    WritesNoKind: testing.KIND,
    Overwrites: testing.KEEPS,
    LoadsNothing: testing.LOADS,
    RefusesItsRobot: testing.ACCEPTS,
    TakesAnyRobot: testing.MISSES,
}


@pytest.mark.parametrize("kind", BROKEN, ids=lambda kind: kind.__name__)
def test_broken_rule_is_named(kind, tmp_path):
    with pytest.raises(AssertionError) as caught:
        check_policy(kind, steps(), tmp_path, TOPIC_MAP)
    assert str(caught.value).startswith(BROKEN[kind])


def test_every_rule_has_a_policy_that_breaks_it():
    rules = {
        value
        for name, value in vars(testing).items()
        if name.isupper() and isinstance(value, str) and value.endswith(".")
    }
    assert rules == set(BROKEN.values())
