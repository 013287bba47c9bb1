"""`curation train`: a behaviour-cloning policy from a selection."""

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path

from rich.progress import Progress

from curation_ros.cli.output import print_json, progress_console, say
from curation_ros.core.errors import ConfigError
from curation_ros.dataset.manifests import read_manifest, read_selected


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("--selection", type=Path, required=True, help="manifest to train on")
    parser.add_argument("--seed", type=int, default=0, help="of weights and batches")
    parser.add_argument("--steps", type=int, default=4000, help="gradient steps")
    parser.add_argument(
        "--variant",
        default="relative",
        help="observations: relative (no finger positions) or fingers (as the paper has them)",
    )
    parser.add_argument(
        "--start-jitter-m",
        type=float,
        default=0.0,
        help="noise on the start positions of bowl and plate while training, m; 0 is the paper's "
        "recipe, 0.004 makes few demonstrations go further",
    )
    parser.add_argument("--report", type=Path, help="file that gets a line of steps now and then")
    parser.add_argument("--out", type=Path, help="folder of the policy; default: in the dataset")


def run(args: argparse.Namespace) -> int:
    """Train and save."""
    manifest, dataset = read_manifest(args.selection)
    if not manifest.entries:
        raise ConfigError(f"selection {args.selection}: it keeps no episode: nothing to train on")
    episodes = read_selected(manifest, dataset)
    digest = hashlib.sha256(args.selection.read_bytes()).hexdigest()
    # Only now: torch takes seconds to load, and what is wrong with a selection needs none of it.
    from policy_node.train import train

    try:
        report = args.report.open("w", buffering=1) if args.report else None
    except OSError as err:
        raise ConfigError(f"report {args.report}: {err.strerror}") from err
    with Progress(console=progress_console, transient=True, disable=args.json) as bar:
        task = bar.add_task(f"training on {len(episodes)} episodes", total=args.steps)

        def show(step: int, _loss: float) -> None:
            bar.update(task, completed=step)
            if report is not None:
                report.write(f"{step}\n")

        trained = train(
            episodes,
            seed=args.seed,
            steps=args.steps,
            variant=args.variant,
            start_jitter_m=args.start_jitter_m,
            selection=(manifest.name, digest),
            progress=show,
        )
    policy = trained.policy
    folder = policy.save(args.out or dataset.policy_path(policy.id))
    row = {
        "policy": str(folder),
        "loss": trained.loss,
        "steps": policy.card.steps,
        "seconds": trained.seconds,
    }
    if args.json:
        print_json(row)
    else:
        say(
            f"policy {folder}: loss {trained.loss:.4f} after {policy.card.steps} steps "
            f"on {len(episodes)} episodes, {trained.seconds:.1f} s"
        )
    return 0
