"""The policy node without ROS: samples and events in, commands out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from curation_ros.bags.cdr import CdrDecoder
from curation_ros.core.episode.status import EpisodeEvent
from curation_ros.core.episode.stream import Sample
from curation_ros.core.episode.topic_map import FieldSpec, TopicMap
from curation_ros.core.errors import CurationError
from curation_ros.core.types import Floats
from policy_node.controller import PolicyController
from policy_node.joining import EqualStamps, Joiner
from policy_node.policy import Command, Policy


@dataclass(frozen=True)
class Answer:
    """A command.

    Attributes:
        stamp_ns: of the observation that it answers.
        command: (d,) values by command field.
    """

    stamp_ns: int
    command: Command


class LivePolicy:
    """Joins samples to the observations of a policy, and gives the policy's answers.

    Attributes:
        topic_map: the observed fields alone: what to subscribe to.
        problem: why the last observation of the running episode has no answer; empty if it has.
    """

    def __init__(
        self,
        policy: Policy,
        topic_map: TopicMap,
        decoder: CdrDecoder,
        join: Callable[[TopicMap], Joiner] = EqualStamps,
    ) -> None:
        """Wait for an episode.

        Args:
            policy: what answers.
            topic_map: of the robot.
            decoder: reads the samples.
            join: makes what joins the samples, see `policy_node.joining`.

        Raises:
            PolicyError: if the policy was trained on topics that mean something else.
        """
        policy.check(topic_map)
        self.topic_map = topic_map.only(policy.observed)
        self.problem = ""
        self._controller = PolicyController(policy)
        self._decoder = decoder
        self._joiner = join(self.topic_map)
        self._episode: EpisodeEvent | None = None
        self._answered_ns: int | None = None

    @property
    def is_driving(self) -> bool:
        """Whether an episode runs."""
        return self._episode is not None

    def event(self, event: EpisodeEvent) -> list[Answer]:
        """Take the start or the end of an episode; observations may have come before its start.

        Returns:
            Answers that are due now, oldest first.
        """
        if event.event == "started":
            self._episode, self._answered_ns, self.problem = event, None, ""
            self._controller.reset()
            self._joiner.clear(event.start_ns)
        elif self._episode is not None and event.id == self._episode.id:
            self._episode = None
            self._joiner.clear()
        return self._answers()

    def sample(self, sample: Sample) -> list[Answer]:
        """Take a sample of an observed topic.

        Returns:
            Answers that are due now, oldest first. An observation that is repeated is answered
            with the same command again.
        """
        try:
            values = {
                spec.name: self._decoded(spec, sample)
                for spec in self.topic_map.fields.values()
                if spec.topic == sample.topic
            }
        except CurationError as err:
            self.problem = str(err)
        else:
            self._joiner.add(sample.topic, sample.stamp_ns, values)
        return self._answers()

    def _decoded(self, spec: FieldSpec, sample: Sample) -> Floats:
        columns = self._decoder.decode(spec.type, spec.values, [sample.data])
        if spec.labels:
            text = str(columns[0][0])
            return np.array([float(spec.labels.index(text) if text in spec.labels else -1)])
        return np.array([float(column[0]) for column in columns])

    def _answers(self) -> list[Answer]:
        episode = self._episode
        if episode is None:
            return []
        answers = []
        for stamp_ns, values, missing in self._joiner.take(episode.start_ns):
            if missing:
                self.problem = f"{episode.name}: {missing}"
                continue
            command = self._answer(stamp_ns, values, episode)
            if command is not None:
                answers.append(Answer(stamp_ns, command))
        return answers

    def _answer(
        self, stamp_ns: int, values: Mapping[str, Floats], episode: EpisodeEvent
    ) -> Command | None:
        is_first = self._answered_ns is None
        if is_first and self._joiner.starts_at_start and stamp_ns != episode.start_ns:
            self.problem = (
                f"{episode.name}: its first observation was not received: not driving it"
            )
            return None
        if self._answered_ns is not None and stamp_ns < self._answered_ns:
            return None
        try:
            command = self._controller.answer(stamp_ns, values)
        except CurationError as err:
            self.problem = f"{episode.name}: {err}"
            return None
        self._answered_ns, self.problem = stamp_ns, ""
        return command
