"""Policy node: answers each complete observation with a command of the same stamp."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from sensor_msgs.msg import JointState

from curation_ros.bags.cdr import CdrDecoder
from curation_ros.configuration import topic_map_or_default
from curation_ros.core.episode.status import EpisodeEvent, event_from_status
from curation_ros.core.episode.stream import Sample
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.core.types import Floats
from curation_ros.nodes.health import Health
from curation_ros.nodes.messages import joints_to_ros, single_from_ros, twist_to_ros
from curation_ros.nodes.parameters import Parameter, declare
from curation_ros.nodes.qos import LATCHED, MAPPED
from curation_ros.nodes.spinning import WorkingNode, run
from curation_ros.nodes.subscriptions import MappedSubscriptions
from policy_node.controller import PolicyController
from policy_node.observation import PHASE
from policy_node.policy import Policy

PARAMETERS = (
    Parameter("policy", "", "folder of the policy: weights and card"),
    Parameter("topic_map", "", "YAML file of the topic map; empty: the LIBERO robot of sim_node"),
)


class PolicyNode(WorkingNode):
    """Collects the fields that the policy sees; when all have one stamp, it answers."""

    def __init__(self) -> None:
        super().__init__("policy_node")
        p = declare(self, PARAMETERS)
        if not p["policy"]:
            raise ConfigError("policy_node: parameter 'policy' is empty: name a policy's folder")
        policy = Policy.load(Path(p["policy"]).expanduser())
        whole_map = topic_map_or_default(p["topic_map"])
        policy.check(whole_map)
        self._map = whole_map.only(policy.spec.fields)
        self._controller = PolicyController(policy)
        self._decoder = CdrDecoder()
        self._episode: EpisodeEvent | None = None
        self._waiting: dict[int, dict[str, Floats]] = {}
        self._answered: tuple[int, Floats, float] | None = None
        self._problem = ""
        self._twist = self.create_publisher(TwistStamped, "command/twist", MAPPED)
        self._gripper = self.create_publisher(JointState, "command/gripper", MAPPED)
        self.create_subscription(DiagnosticArray, "episode", self._on_episode, LATCHED)
        self._mapped = MappedSubscriptions(self, self._map, self._on_sample)
        self._health = Health(self)
        self.get_logger().info(
            f"policy {policy.id} ({policy.card.selection_name or 'no selection'}, "
            f"{len(policy.card.episodes)} episodes)"
        )

    def work(self) -> bool:
        """Report."""
        now_s = time.monotonic()
        if self._health.due(now_s):
            problems = [self._problem] if self._problem else []
            problems += self._mapped.check(running=self._episode is not None)
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
        if event.event == "started":
            self._episode, self._answered, self._problem = event, None, ""
            self._controller.reset()
            for stamp_ns in [s for s in self._waiting if s < event.start_ns]:
                del self._waiting[stamp_ns]
            self._answer_complete()
        elif self._episode is not None and event.id == self._episode.id:
            self._episode = None
            self._waiting.clear()

    def _on_sample(self, sample: Sample) -> None:
        values = self._waiting.setdefault(sample.stamp_ns, {})
        if len(self._waiting) > 100:  # nobody owns an episode; old observations are of no use
            del self._waiting[min(self._waiting)]
        try:
            for spec in self._map.fields.values():
                if spec.topic == sample.topic:
                    columns = self._decoder.decode(spec.type, spec.values, [sample.data])
                    if spec.labels:
                        text = str(columns[0][0])
                        index = spec.labels.index(text) if text in spec.labels else -1
                        values[PHASE] = np.array([index], dtype=np.float64)
                    else:
                        values[spec.name] = np.array([float(c[0]) for c in columns])
        except CurationError as err:
            self._complain(str(err))
        self._answer_complete()

    def _answer_complete(self) -> None:
        """Answer observations that have all their fields, oldest first."""
        if self._episode is None:
            return
        for stamp_ns in sorted(self._waiting):
            values = self._waiting[stamp_ns]
            if len(values) < len(self._map.fields) or stamp_ns < self._episode.start_ns:
                continue
            del self._waiting[stamp_ns]
            self._answer(stamp_ns, values, self._episode)

    def _answer(self, stamp_ns: int, values: dict[str, Floats], episode: EpisodeEvent) -> None:
        if self._answered is None and stamp_ns != episode.start_ns:
            self._complain(f"{episode.name}: its first observation was not seen: not driving it")
            return
        if self._answered is None or stamp_ns > self._answered[0]:
            try:
                self._answered = (
                    stamp_ns,
                    *self._controller.act(values, int(values[PHASE][0])),
                )
            except CurationError as err:
                self._complain(f"{episode.name}: {err}")
                return
        # An observation that comes again is answered with the same command again.
        answered_ns, xyz, gripper = self._answered
        if stamp_ns == answered_ns:
            self._twist.publish(twist_to_ros(xyz, stamp_ns))
            self._gripper.publish(joints_to_ros(["gripper"], [gripper], [0.0], [0.0], stamp_ns))

    def _complain(self, problem: str) -> None:
        if problem != self._problem:
            self._problem = problem
            self.get_logger().error(problem)


def main() -> int:
    """Entry point of `ros2 run curation_ros policy_node`."""
    return run(PolicyNode, PARAMETERS)


if __name__ == "__main__":
    raise SystemExit(main())
