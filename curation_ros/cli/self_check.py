"""`curation self-check`: flips all labels in a copy and checks that no score changes."""

from __future__ import annotations

import argparse
from pathlib import Path

from curation_ros.batch.self_check import self_check
from curation_ros.cli.arguments import add_config, add_reference
from curation_ros.cli.output import print_json, say
from curation_ros.configuration import read_settings, share_file
from curation_ros.core.episode.topic_map import read_topic_map
from curation_ros.core.scorers import scorer_names
from curation_ros.dataset.dataset import Dataset

_EQUAL, _DIFFERENT = 0, 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("dataset", type=Path)
    add_reference(parser)
    add_config(parser)


def run(args: argparse.Namespace) -> int:
    """Check and print; the exit code is 1 if something depends on labels."""
    config = args.config or share_file("config/curation.yaml")
    settings = read_settings(config, {"scorers": scorer_names()})
    topic_map = read_topic_map(args.topic_map) if args.topic_map else None
    done = self_check(Dataset(args.dataset), settings, args.reference, topic_map)
    for difference in done.differences:
        if args.json:
            print_json(difference.to_json())
        else:
            name = difference.name or difference.episode[:8]
            say(f"{name}: {difference.field}: {difference.original} / {difference.flipped}")
    if args.json:
        print_json(done.to_json())
    else:
        say(
            f"flipped {done.labels} labels and {done.overrides} decisions of people; "
            f"compared {done.scores} scores of {done.episodes} episodes, and their decisions, "
            "reasons and findings"
        )
        if done.unreadable:
            say(f"{done.unreadable} bags could not be read")
        n = len(done.differences)
        say(f"{n} differences: something reads labels" if n else "all are equal to the last bit")
    return _DIFFERENT if done.differences else _EQUAL
