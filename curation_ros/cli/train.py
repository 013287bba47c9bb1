"""`curation train`: a behaviour-cloning policy from a selection."""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING

from rich.progress import Progress

from curation_ros.cli.output import print_json, progress_console, say, warn
from curation_ros.configuration import share_file
from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import ConfigError
from curation_ros.core.types import Span
from curation_ros.dataset.manifests import read_manifest, read_selected
from policy_node.settings import DEFAULTS, TrainingSettings
from policy_node.variants import (
    DRAFT,
    TrainingConfig,
    Variant,
    choose_variant,
    read_training_config,
)

if TYPE_CHECKING:
    from policy_node.train import TrainedPolicy

#: Share of clipped values of a field above which a warning is due. The variants of LIBERO clip a
#: sixth on purpose.
_MUCH_CLIPPED = 0.2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("--selection", type=Path, required=True, help="manifest to train on")
    parser.add_argument("--seed", type=int, default=0, help="of weights and batches")
    parser.add_argument(
        "--config",
        type=Path,
        help="variants and settings; default config/training.yaml, which explains the keys",
    )
    parser.add_argument(
        "--variant",
        help="what to observe and to command: a name in the config, or 'draft' for the fields of "
        "the topic map by their roles; default: the first in the config that fits, else the draft",
    )
    parser.add_argument(
        "--observation",
        default="",
        help="observe these terms instead of the variant's, such as tool_pose,cup_pose@start",
    )
    parser.add_argument(
        "--action",
        default="",
        help="command these fields instead of the variant's, such as twist=0.2,gripper; the "
        "number is the scale, without one it is taken from the demonstrations",
    )
    parser.add_argument("--steps", type=int, help=f"gradient steps; default {DEFAULTS.steps}")
    parser.add_argument(
        "--start-jitter-m",
        type=float,
        help="noise on lengths held from the start while training, m; default "
        f"{DEFAULTS.start_jitter_m:g}; 0.004 makes few demonstrations go further",
    )
    parser.add_argument(
        "--draft",
        action="store_true",
        help="print the variant as a config, by default the draft, and train nothing",
    )
    parser.add_argument(
        "--report", type=Path, help="file for progress: the number of steps, line by line"
    )
    parser.add_argument("--out", type=Path, help="folder of the policy; default: in the dataset")
    own = ("steps", "start_jitter_m")
    others = (f for f in fields(TrainingSettings) if f.name not in own)
    parser.epilog = "Defaults of the settings in the config: " + ", ".join(
        f"{f.name} {list(f.default) if isinstance(f.default, tuple) else f.default}"
        for f in others
    )


def run(args: argparse.Namespace) -> int:
    """Train and save."""
    manifest, dataset = read_manifest(args.selection)
    if not manifest.entries:
        raise ConfigError(f"selection {args.selection}: it keeps no episode: nothing to train on")
    config = read_training_config(args.config or share_file("config/training.yaml"))
    settings = _settings(args, config)
    episodes = read_selected(manifest, dataset)
    variant = choose_variant(
        config,
        episodes[0][0].topic_map,
        name=args.variant or (DRAFT if args.draft else ""),
        observation=args.observation,
        action=args.action,
    )
    if args.draft:
        if args.json:
            print_json(variant.to_json())
        else:
            print(variant.to_yaml(), end="")
        return 0
    digest = hashlib.sha256(args.selection.read_bytes()).hexdigest()
    trained = _train(args, episodes, variant, settings, (manifest.name, digest))
    card = trained.policy.card
    folder = trained.policy.save(args.out or dataset.policy_path(card.id))
    for name, share in card.clipped.items():
        if share > _MUCH_CLIPPED:
            warn(
                f"{share:.1%} of the commands of {name} were beyond the scale and clipped: the "
                "policy is slower than the demonstrations; set a larger scale"
            )
    if args.json:
        print_json(
            {
                "policy": str(folder),
                "loss": trained.loss,
                "steps": settings.steps,
                "seconds": trained.seconds,
                "variant": card.variant,
                "clipped": dict(card.clipped),
            }
        )
    else:
        shares = (f"{name} {share:.1%}" for name, share in card.clipped.items())
        clipped = ", ".join(shares) or "none"
        say(
            f"policy {folder}: loss {trained.loss:.4f} after {settings.steps} steps "
            f"on {len(episodes)} episodes, {trained.seconds:.1f} s"
        )
        say(f"variant {card.variant}, clipped commands: {clipped}")
    return 0


def _settings(args: argparse.Namespace, config: TrainingConfig) -> TrainingSettings:
    """Settings of the config, with those of the command line."""
    given = {"steps": args.steps, "start_jitter_m": args.start_jitter_m}
    return replace(config.settings, **{k: v for k, v in given.items() if v is not None})


def _train(
    args: argparse.Namespace,
    episodes: Sequence[tuple[Episode, Span | None]],
    variant: Variant,
    settings: TrainingSettings,
    selection: tuple[str, str],
) -> TrainedPolicy:
    # Only now: torch takes seconds to load, and errors in a selection show without it.
    from policy_node.train import train

    with (
        _report(args.report) as report,
        Progress(console=progress_console, transient=True, disable=args.json) as bar,
    ):
        task = bar.add_task(f"training on {len(episodes)} episodes", total=settings.steps)

        def show(step: int, _loss: float) -> None:
            bar.update(task, completed=step)
            if report is not None:
                report.write(f"{step}\n")

        return train(
            episodes,
            variant,
            seed=args.seed,
            settings=settings,
            selection=selection,
            progress=show,
        )


@contextmanager
def _report(path: Path | None) -> Iterator[IO[str] | None]:
    """The file that gets the steps, or nothing."""
    if path is None:
        yield None
        return
    try:
        report = path.open("w", buffering=1)
    except OSError as err:
        raise ConfigError(f"report {path}: {err.strerror}") from err
    with report:
        yield report
