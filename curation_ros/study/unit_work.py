"""What the workers of a study do: train policies and roll them out, one row per unit."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from curation_ros.configuration import topic_map_or_default
from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import ConfigError, CurationError, PolicyError
from curation_ros.core.types import JsonObject
from curation_ros.dataset.episodes import read_episode
from curation_ros.study.units import PolicyUnit, RolloutUnit, named_variant, start_name
from policy_node.mlp import MlpPolicy
from policy_node.policy import load_policy
from policy_node.rollouts import Rollout, rollout
from policy_node.settings import TrainingSettings
from sim_node.tasks import process_environment, task_named


def policy_folder(study: Path, policy_id: str) -> Path:
    """Folder of a policy of a study."""
    return study / "policies" / policy_id


def roll_policy(
    policy: Path, start: str, max_steps: int, simulated_task: str, topic_map: str
) -> Rollout:
    """One rollout, in the environment of this process.

    Args:
        policy: folder of the policy.
        start: its name.
        max_steps: most commands.
        simulated_task: key of `sim_node.tasks.TASKS`.
        topic_map: YAML file of the topic map; empty: the default one.

    Raises:
        ConfigError, PolicyError, SimError: as `policy_node.rollouts.rollout` does.
    """
    task = task_named(simulated_task)
    env = process_environment(task.name)
    robot = topic_map_or_default(topic_map)
    return rollout(env, task, task.start(start), load_policy(policy), robot, max_steps)


def roll_units(
    study: Path,
    units: Sequence[RolloutUnit],
    max_steps: int,
    gives_up: bool,
    simulated_task: str,
    topic_map: str,
) -> list[JsonObject]:
    """Roll out policies of a study.

    Args:
        study: its folder.
        units: what to do.
        max_steps: most commands per rollout.
        gives_up: whether lost rollouts are ended early.
        simulated_task: key of `sim_node.tasks.TASKS`.
        topic_map: YAML file of the topic map; empty: the default one.

    Returns:
        A row per unit; the status of one that failed is `failed`, with the reason.
    """
    rows = []
    robot = topic_map_or_default(topic_map)
    for unit in units:
        steps = 0
        try:
            policy = load_policy(policy_folder(study, unit.policy))
            task = task_named(simulated_task)
            start = task.start(start_name(unit.start, task.name))
            env = process_environment(task.name)
            try:
                made = rollout(env, task, start, policy, robot, max_steps, gives_up=gives_up)
            except CurationError:
                steps = env.n_steps
                raise
        except CurationError as err:
            ended = {"success": False, "steps": steps, "stage": "", "ended": ""}
            rows.append(unit.row(**ended, status="failed", reason=str(err)))
        else:
            how = {key: getattr(made, key) for key in ("success", "steps", "stage", "ended")}
            rows.append(unit.row(**how, status="ok", reason=""))
    return rows


def train_units(study: Path, units: Sequence[PolicyUnit]) -> list[JsonObject]:
    """Train policies of one variant and equal settings in one computation, and save them.

    Args:
        study: its folder.
        units: what to train.

    Returns:
        A row per unit; the status of one that failed is `failed`, with the reason.
    """
    # Only here: torch takes a second to load, and rollouts do not need it.
    from policy_node.train_many import FailedTraining, TrainingJob, train_many

    try:
        variant = named_variant(units[0].variant)
        settings = TrainingSettings(steps=units[0].steps, start_jitter_m=units[0].start_jitter_m)
    except (ConfigError, PolicyError) as err:  # all of them share it
        return [unit.row(status="failed", reason=str(err)) for unit in units]
    rows: dict[str, JsonObject] = {}
    jobs = []
    episodes: dict[Path, Episode] = {}
    for unit in units:
        if (row := _adopted(study, unit)) is not None:
            rows[unit.key] = row
            continue
        try:
            for bag, _ in unit.bags:
                if bag not in episodes:
                    episodes[bag] = read_episode(bag)
        except CurationError as err:
            rows[unit.key] = unit.row(status="failed", reason=str(err))
            continue
        chosen = [(episodes[bag], span) for bag, span in unit.bags]
        jobs.append(TrainingJob(unit.key, chosen, variant, unit.seed, unit.selection))
    by_key = {unit.key: unit for unit in units}
    for job, made in zip(jobs, train_many(jobs, settings), strict=True):
        unit = by_key[job.key]
        if isinstance(made, FailedTraining):
            rows[job.key] = unit.row(status="failed", reason=made.reason)
            continue
        try:
            made.policy.save(policy_folder(study, job.key))
        except PolicyError as err:
            failed = unit.row(status="failed", reason=str(err))
            rows[job.key] = _adopted(study, unit) or failed
        else:
            figures = {"loss": made.loss, "seconds": made.seconds}
            rows[job.key] = unit.row(**figures, status="ok", reason="")
    return [rows[unit.key] for unit in units]


def _adopted(study: Path, unit: PolicyUnit) -> JsonObject | None:
    """JsonObject of a policy that was saved, but not logged before its run was killed."""
    with suppress(PolicyError):
        card = MlpPolicy.load(policy_folder(study, unit.key)).card
        trained_on = sorted((str(e["id"]), tuple(e["span"] or ())) for e in card.episodes)
        wanted = sorted((bag.name, span or ()) for bag, span in unit.bags)
        found = (card.variant, card.seed, card.settings.steps, card.settings.start_jitter_m)
        asked = (unit.variant, unit.seed, unit.steps, unit.start_jitter_m)
        if trained_on == wanted and found == asked:
            figures = {"loss": card.curve[-1][1], "seconds": card.seconds}
            return unit.row(**figures, status="ok", reason="")
    return None
