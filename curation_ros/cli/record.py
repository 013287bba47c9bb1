"""`curation record`: calls the services of a recorder, for machines without `ros2`."""

from __future__ import annotations

import argparse
import json

from curation_ros.cli.output import print_json, say
from curation_ros.core.errors import CurationError

_PATIENCE_S = 5.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    actions = ("start", "stop", "recover", "keep", "discard")
    parser.add_argument(
        "action",
        choices=actions,
        help="start, stop: an episode; keep, discard: the last episode; recover: partial bags",
    )
    parser.add_argument("--recorder", default="recorder", help="name of the recorder node")


def run(args: argparse.Namespace) -> int:
    """Call the service and print its answer."""
    from curation_ros.nodes.recorder_client import call_recorder

    success, message = call_recorder(args.recorder, args.action, _PATIENCE_S)
    if not success:
        raise CurationError(f"{args.recorder}: {message}")
    if args.json:
        print_json(json.loads(message) if message.startswith("{") else {"message": message})
    else:
        say(message)
    return 0
