"""How well lost objects are detected, and what the curator decides then.

    python benchmarks/consequence.py FOLDER [--json] [--jobs N]

reports for each set of published topics: clean demonstrations flagged, losses found, and the
delay, by each detector alone and by the alert that the curator sends during an episode. It then
reports the verdicts of the curator with its default configuration, and where it cuts what it
salvages.

It collects the demonstrations that FOLDER lacks: 260 clean and 260 defective ones (every defect of
the simulator in turn) from generated start states, without ROS. The constants of the detectors
were chosen on seed 101 (20 and 20), and on the paper's data (seeds 11 and 13). The results are for
seeds 107 to 112 (240 and 240), which no constant was chosen on. A demonstration can fail without a
defect, because the bowl may slip. It is counted separately and not as clean. Bounds are Clopper
and Pearson's, of 95 %.
"""

from __future__ import annotations

import argparse
import json
import statistics
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from curation_ros.configuration import topic_map_or_default
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.rules import RULES
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap, topic_map_from_json
from curation_ros.core.evidence.alerts import AlertWatch
from curation_ros.core.evidence.carrying import carrying_of
from curation_ros.core.evidence.fingers import held_by_fingers
from curation_ros.core.evidence.holds import Carrying
from curation_ros.core.scorers import SCORERS, Abstain
from curation_ros.core.statistics.intervals import clopper_pearson
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode
from curation_ros.study.collect import Collection, collect
from sim_node.defects import DEFECTS

CHOSEN_ON, REPORTED = (101,), (107, 108, 109, 110, 111, 112)
_EPISODES = {101: 40}
_OTHERWISE = 80
_MAX_STEPS_DEFECTIVE = 300
_REFERENCES = 10
_NOISE_M, _DELAY_S, _DROPOUT = 0.01, 0.1, 0.3
#: Of episodes; see `kind_of`.
KINDS = ("clean", "defective", "failed")
#: The object has left when it is farther from the effector by this than when it was let go.
_LEFT_M = 0.005


@dataclass(frozen=True)
class Verdict:
    """What a detector found.

    Attributes:
        is_lost: whether the object was lost; None if it cannot be known.
        noticed: step at which the loss was noticed.
    """

    is_lost: bool | None
    noticed: int | None = None


@dataclass
class Tally:
    """Verdicts on many episodes."""

    clean: list[Verdict] = field(default_factory=list)
    defective: list[Verdict] = field(default_factory=list)
    failed: list[Verdict] = field(default_factory=list)
    delays_ms: list[float] = field(default_factory=list)


def collected(
    folder: Path, seeds: tuple[int, ...], jobs: int
) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Bags and truth of the episodes of some seeds; missing ones are collected first."""
    kinds = [name for name in DEFECTS if name != "none"]
    for seed in seeds:
        for k, defect in enumerate(kinds):
            n = _EPISODES.get(seed, _OTHERWISE) // len(kinds)
            collection = Collection(
                episodes=n,
                contamination=0.5,
                defect=defect,
                seed=seed,
                starts=f"generated:{seed}:{k * n}:{(k + 1) * n}",
                max_steps_defective=_MAX_STEPS_DEFECTIVE,
            )
            name = f"seed-{seed}" if k == 0 else f"seed-{seed}-{defect}"
            path = folder / name
            for one in collect(path, collection, jobs=jobs):
                if one.problem or one.truth is None:
                    raise SystemExit(f"{path}: {one.name}: {one.problem}")
                yield Dataset(path).bag_path(str(one.truth["episode"])), one.truth


def with_effort(topic_map: TopicMap) -> TopicMap:
    """The map with a field for the efforts of the fingers, which are in the same messages."""
    raw = topic_map.to_json()
    fingers = raw["fields"]["finger_position"]
    paths = [path.replace("position.", "effort.") for path in fingers["values"]]
    raw["fields"]["finger_effort"] = {**fingers, "values": paths, "unit": "N"}
    return topic_map_from_json(raw)


def without(episode: Episode, *missing: str) -> Episode:
    """The same episode from a graph that does not publish some roles or fields.

    Args:
        episode: as recorded.
        missing: `object`, `phase`, or the name of a field.
    """
    topic_map = episode.topic_map
    gone = {k for k, v in topic_map.fields.items() if v.role in missing or k in missing}
    gripper = topic_map.gripper
    if gripper is not None and gripper.fingers in gone:
        gripper = replace(gripper, fingers="")
    kept = {k: v for k, v in topic_map.fields.items() if k not in gone}
    topic_map = replace(topic_map, fields=kept, state=(), gripper=gripper)
    fields = {k: v for k, v in episode.fields.items() if k not in gone}
    return replace(episode, topic_map=topic_map, fields=fields)


def degraded(episode: Episode, rng: np.random.Generator) -> Episode:
    """The same episode with object poses from a poor tracker.

    They have noise of 10 mm in each axis and a delay of 100 ms. Of 100 poses 30 are missing, and
    the last one is held instead.
    """
    fields = dict(episode.fields)
    steps = np.arange(len(episode))
    late = np.maximum(steps - round(_DELAY_S * episode.rate_hz), 0)
    for spec in episode.topic_map.with_role("object"):
        seen = fields[spec.name][late]
        seen = seen + _NOISE_M * rng.standard_normal(seen.shape)
        there = rng.random(len(steps)) >= _DROPOUT
        there[:1] = True
        fields[spec.name] = seen[np.maximum.accumulate(np.where(there, steps, 0))]
    return replace(episode, fields=fields)


def _of(carrying: Carrying) -> Verdict:
    worst = carrying.worst
    if worst is None or worst.state == "unknown":
        return Verdict(None)
    return Verdict(worst.state in ("broken", "never"), worst.noticed)


def _of_events(episode: Episode) -> Verdict:
    scorer = SCORERS["phase_events"]()
    try:
        look = scorer.look(episode)
    except Abstain:
        return Verdict(None)
    is_lost = look.score < 1.0 - scorer.resolution
    return Verdict(is_lost, look.steps[0] if look.steps is not None else None)


#: Detector and its input -> what it finds in an episode.
DETECTORS: dict[str, Callable[[Episode, np.random.Generator], Verdict]] = {
    "object, exact pose": lambda e, _: _of(carrying_of(e)),
    "object, 10 mm noise, 100 ms delay, 30 % dropout": lambda e, rng: _of(
        carrying_of(degraded(e, rng))
    ),
    "no object: gap of the fingers": lambda e, _: _of(held_by_fingers(e)),
    "no object: effort of the fingers": lambda e, _: _of(
        held_by_fingers(e, effort="finger_effort")
    ),
    "no object: commands within phases": lambda e, _: _of_events(e),
    "object, exact pose, no phases": lambda e, _: _of(carrying_of(without(e, "phase"))),
}


#: Published topics -> the episode as it is then. The last two need a trusted reference.
GRAPHS: dict[str, Callable[[Episode, np.random.Generator], Episode]] = {
    "everything": lambda e, _: e,
    "object with 10 mm noise, 100 ms delay, 30 % dropout": degraded,
    "no object": lambda e, _: without(e, "object"),
    "no object, no fingers": lambda e, _: without(e, "object", "finger_position"),
    "no phases": lambda e, _: without(e, "phase"),
    "no object, no phases": lambda e, _: without(e, "object", "phase"),
}


def _alerted(episode: Episode) -> Verdict:
    alert = AlertWatch(episode.topic_map).take(episode)
    if alert is None:
        return Verdict(False)
    return Verdict(True, int(np.searchsorted(episode.stamps_ns, episode.start_ns + alert.span[1])))


DETECTORS |= {
    f"alert, {name}": lambda e, rng, shown=shown: _alerted(shown(e, rng))
    for name, shown in GRAPHS.items()
}


def left_at(episode: Episode, release_step: int) -> int:
    """First step at which the object had left the effector, by the exact poses."""
    away_m = np.linalg.norm(
        episode.fields["bowl_position"] - episode.fields["eef_position"], axis=1
    )
    held_m = float(np.median(away_m[release_step - 10 : release_step + 1]))
    return release_step + int(np.argmax(away_m[release_step:] > held_m + _LEFT_M))


def kind_of(truth: dict[str, Any]) -> str:
    """Kind of an episode: `defective`, or without a defect `clean` or `failed`."""
    if truth["defect"] != "none":
        return "defective"
    return "clean" if truth["outcome"] == "succeeded" else "failed"


def tallies(folder: Path, seeds: tuple[int, ...], jobs: int) -> dict[str, Tally]:
    """What each detector finds in the episodes of some seeds."""
    topic_map = with_effort(topic_map_or_default(""))
    found = {name: Tally() for name in DETECTORS}
    for path, truth in collected(folder, seeds, jobs):
        episode = read_episode(path, topic_map)
        for name, detector in DETECTORS.items():
            verdict = detector(episode, _rng(truth))
            tally = found[name]
            getattr(tally, kind_of(truth)).append(verdict)
            if kind_of(truth) == "defective" and verdict.is_lost and verdict.noticed is not None:
                step = left_at(episode, int(truth["release_step"]))
                late_ns = episode.stamps_ns[verdict.noticed] - episode.stamps_ns[step]
                tally.delays_ms.append(1000.0 * float(late_ns) / NS_PER_S)
    return found


def row(name: str, tally: Tally, seeds: tuple[int, ...]) -> dict[str, Any]:
    """A line of the report."""
    flagged = sum(v.is_lost is True for v in tally.clean)
    found = sum(v.is_lost is True for v in tally.defective)
    return {
        "input": name,
        "seeds": list(seeds),
        "clean": len(tally.clean),
        "clean_flagged": flagged,
        "clean_flagged_at_most": clopper_pearson(flagged, len(tally.clean))[1],
        "clean_unknown": sum(v.is_lost is None for v in tally.clean),
        "defective": len(tally.defective),
        "found": found,
        "found_at_least": clopper_pearson(found, len(tally.defective))[0],
        "failed": len(tally.failed),
        "failed_found": sum(v.is_lost is True for v in tally.failed),
        "defective_unknown": sum(v.is_lost is None for v in tally.defective),
        "delay_ms_median": statistics.median(tally.delays_ms) if tally.delays_ms else None,
        "delay_ms_worst": max(tally.delays_ms, default=None),
        "within_300_ms": sum(d <= 300.0 for d in tally.delays_ms),
    }


def text(line: dict[str, Any]) -> str:
    """A line for people."""
    out = (
        f"{line['input']}: clean flagged {line['clean_flagged']} of {line['clean']} "
        f"(at most {line['clean_flagged_at_most']:.1%}), unknown {line['clean_unknown']}; "
        f"found {line['found']} of {line['defective']} (at least {line['found_at_least']:.1%}), "
        f"unknown {line['defective_unknown']}"
    )
    if line["failed"]:
        out += f"; failed without a defect {line['failed']}, found {line['failed_found']}"
    if line["delay_ms_median"] is None:
        return out
    return (
        f"{out}; delay {line['delay_ms_median']:.0f} ms median, {line['delay_ms_worst']:.0f} ms "
        f"worst, {line['within_300_ms']} within 300 ms"
    )


def decisions(folder: Path, seeds: tuple[int, ...], jobs: int) -> Iterator[dict[str, Any]]:
    """A line per set of published topics: verdicts of the curator, and where it cuts."""
    trusted = [
        (read_episode(path), _rng(truth))
        for path, truth in collected(folder, CHOSEN_ON, jobs)
        if kind_of(truth) == "clean"
    ][:_REFERENCES]
    given = [(read_episode(p), truth) for p, truth in collected(folder, seeds, jobs)]
    for name, shown in GRAPHS.items():
        settings = CurationSettings(scorers=(*RULES["evidence"].consults, "gripper_timing"))
        curation = Curation.fit(settings, [shown(episode, rng) for episode, rng in trusted])
        verdicts: dict[str, Counter[str]] = {kind: Counter() for kind in KINDS}
        decided_by: Counter[str] = Counter()
        late_steps: list[int] = []
        for episode, truth in given:
            decision = curation.decide(curation.examine(shown(episode, _rng(truth))))
            kind = kind_of(truth)
            verdicts[kind][decision.verdict] += 1
            decided_by[str(decision.evidence.get("decided_by"))] += 1
            if decision.verdict == "salvage" and kind == "defective":
                broke_ns = episode.start_ns + decision.evidence["salvage"]["broke_ns"]
                step = int(np.searchsorted(episode.stamps_ns, broke_ns))
                late_steps.append(step - int(truth["release_step"]))
        yield {
            "graph": name,
            "seeds": list(seeds),
            **{kind: dict(counted) for kind, counted in verdicts.items()},
            "decided_by": dict(decided_by),
            "break_after_release_steps": [min(late_steps), max(late_steps)] if late_steps else [],
        }


def _rng(truth: dict[str, Any]) -> np.random.Generator:
    """Random numbers of an episode, the same for every detector."""
    return np.random.default_rng(zlib.crc32(f"{truth['start']} {truth['name']}".encode()))


def decision_text(line: dict[str, Any]) -> str:
    """A line of the curator's verdicts for people."""
    shown = [
        f"{kind} " + ", ".join(f"{v} {n}" for v, n in sorted(line[kind].items()))
        for kind in KINDS
        if line[kind]
    ]
    broke = line["break_after_release_steps"]
    cut = f"; broke {broke[0]} to {broke[1]} steps after the release" if broke else ""
    return f"{line['graph']}: {'; '.join(shown)}; by {', '.join(line['decided_by'])}{cut}"


def main() -> int:
    """Collect the missing demonstrations, and report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--json", action="store_true", help="print a JSON line per row")
    parser.add_argument("--jobs", type=int, default=2, help="number of simulators")
    args = parser.parse_args()
    for title, seeds in (("chosen on", CHOSEN_ON), ("reported", REPORTED)):
        if not args.json:
            print(f"{title}: seeds {', '.join(map(str, seeds))}", flush=True)
        for name, tally in tallies(args.folder, seeds, args.jobs).items():
            line = row(name, tally, seeds)
            print(json.dumps(line) if args.json else f"  {text(line)}", flush=True)
    if not args.json:
        print(f"verdicts of the curator, with {_REFERENCES} references: the same", flush=True)
    for line in decisions(args.folder, REPORTED, args.jobs):
        print(json.dumps(line) if args.json else f"  {decision_text(line)}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
