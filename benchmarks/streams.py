"""Publishes ten topics at 200 Hz in a process of its own, for the recorder's benchmarks.

It prints two JSON lines: the episode after the first message, and the number of messages per topic
at the end.
"""

from __future__ import annotations

import argparse
import json
import os
import time

import rclpy
import rclpy.serialization
from robot import Robot, stamped
from sensor_msgs.msg import JointState

from curation_ros.core.episode.identity import new_episode_id
from curation_ros.core.episode.status import EpisodeEvent
from curation_ros.core.types import NS_PER_S

N_TOPICS = 10
RATE_HZ = 200
TYPE = "sensor_msgs/msg/JointState"


def topic_map() -> dict[str, object]:
    """A topic map of the ten topics, as plain data."""
    return {
        "fields": {
            f"arm_{k}": {
                "topic": f"arm_{k}/joint_states",
                "type": TYPE,
                "role": "clock" if k == 0 else "observation",
                "values": ["position.j0", "position.j6"],
            }
            for k in range(N_TOPICS)
        }
    }


def main() -> int:
    """Publish for a while under one episode."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument(
        "--no-end", action="store_true", help="do not publish the end of the episode"
    )
    args = parser.parse_args()
    message = JointState(name=[f"j{i}" for i in range(7)])
    message.position = message.velocity = message.effort = [0.1 * i for i in range(7)]
    template = rclpy.serialization.serialize_message(message)
    topics = {f"arm_{k}/joint_states": TYPE for k in range(N_TOPICS)}
    with Robot(dict(os.environ), topics) as robot:
        robot.wait_for_subscribers(1)
        episode, start_ns = new_episode_id(), time.time_ns()
        robot.tell(EpisodeEvent(episode, "load-0001", "started", start_ns))
        began_s = time.monotonic()
        ticks = round(args.seconds * RATE_HZ)
        stamp_ns, late_s = start_ns, 0.0
        for k in range(ticks):
            wait_s = began_s + k / RATE_HZ - time.monotonic()
            late_s = max(late_s, -wait_s)
            time.sleep(max(0.0, wait_s))
            stamp_ns = start_ns + k * NS_PER_S // RATE_HZ
            data = stamped(template, stamp_ns)
            for output in robot.outputs.values():
                output.publish(data)
            if k == 0:
                print(json.dumps({"episode": episode, "start_ns": start_ns}), flush=True)
        counts = dict.fromkeys(topics, ticks)
        if not args.no_end:
            robot.tell(EpisodeEvent(episode, "load-0001", "ended", start_ns, stamp_ns, counts))
            robot.until(lambda: robot.recorder.get(episode) == "closed", "the bag")
        row = {"episode": episode, "sent": ticks, "end_ns": stamp_ns, "late_s": late_s}
        print(json.dumps(row), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
