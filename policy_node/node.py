"""Policy node: answers each complete observation with a command of the same stamp."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray

from curation_ros.bags.cdr import CdrDecoder
from curation_ros.configuration import topic_map_or_default
from curation_ros.core.episode.status import event_from_status
from curation_ros.core.episode.stream import Sample
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.nodes.health import Health
from curation_ros.nodes.messages import message_type, single_from_ros, to_ros
from curation_ros.nodes.parameters import Parameter, declare
from curation_ros.nodes.qos import LATCHED, MAPPED
from curation_ros.nodes.spinning import WorkingNode, run
from curation_ros.nodes.subscriptions import MappedSubscriptions
from policy_node.command_messages import CommandMessages
from policy_node.joining import JOINERS
from policy_node.live import Answer, LivePolicy
from policy_node.policy import load_policy

PARAMETERS = (
    Parameter("policy", "", "folder of the policy: weights and card"),
    Parameter("topic_map", "", "YAML file of the topic map; empty: the LIBERO robot of sim_node"),
    Parameter(
        "stamps",
        "equal",
        "an observation has samples of one stamp, or the latest of each topic",
        choices=tuple(JOINERS),
    ),
)


class PolicyNode(WorkingNode):
    """Turns messages into samples and events, and answers into messages."""

    def __init__(self) -> None:
        super().__init__("policy_node")
        p = declare(self, PARAMETERS)
        if not p["policy"]:
            raise ConfigError("policy_node: parameter 'policy' is empty: name a policy's folder")
        policy = load_policy(Path(p["policy"]).expanduser())
        topic_map = topic_map_or_default(p["topic_map"])
        self._live = LivePolicy(policy, topic_map, CdrDecoder(), JOINERS[p["stamps"]])
        self._messages = CommandMessages(topic_map, policy.commanded)
        # Not `_publishers`: rclpy has a list of this name.
        self._outputs = {
            topic: self.create_publisher(message_type(kind, topic), topic, MAPPED)
            for topic, kind in self._messages.topics.items()
        }
        self._logged = ""
        self.create_subscription(DiagnosticArray, "episode", self._on_episode, LATCHED)
        self._mapped = MappedSubscriptions(self, self._live.topic_map, self._on_sample)
        self._health = Health(self)
        card = policy.card
        self.get_logger().info(
            f"policy {card.id} ({card.kind}, {card.selection_name or 'no selection'}, "
            f"{len(card.episodes)} episodes)"
        )

    def work(self) -> bool:
        """Report."""
        now_s = time.monotonic()
        if self._health.due(now_s):
            problems = [self._live.problem] if self._live.problem else []
            problems += self._mapped.check(running=self._live.is_driving)
            self._health.publish(now_s, problems, self._mapped.publishers_found())
        return False

    def close(self) -> None:
        """Nothing is open."""

    def _on_episode(self, message: DiagnosticArray) -> None:
        try:
            event = event_from_status(single_from_ros(message))
        except CurationError as err:
            self.get_logger().error(f"topic episode: {err}")
            return
        self._publish(self._live.event(event))

    def _on_sample(self, sample: Sample) -> None:
        self._publish(self._live.sample(sample))

    def _publish(self, answers: Sequence[Answer]) -> None:
        problem = self._live.problem
        for answer in answers:
            try:
                for message in self._messages.messages(answer.command, answer.stamp_ns):
                    ros_message = to_ros(message.type, message.content)
                    self._outputs[message.topic].publish(ros_message)
            except CurationError as err:
                problem = str(err)
        if problem != self._logged:
            self._logged = problem
            if problem:
                self.get_logger().error(problem)


def main() -> int:
    """Entry point of `ros2 run curation_ros policy_node`."""
    return run(PolicyNode, PARAMETERS)


if __name__ == "__main__":
    raise SystemExit(main())
