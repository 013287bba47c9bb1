"""`curation score`: bags to scores and decisions, the same ones as live."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

from rich.progress import track
from rich.table import Table
from rich.text import Text

from curation_ros.batch.examine import EpisodesOf, Examined, Examiner, judge_bags
from curation_ros.cli.arguments import add_config, add_reference, add_rule, add_workers
from curation_ros.cli.output import VERDICT_STYLE, console, print_json, progress_console, warn
from curation_ros.configuration import read_reference, read_settings, share_file
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import CURATOR, VERDICTS, Decision, in_force
from curation_ros.core.decision.examination import Examination
from curation_ros.core.decision.rules import given_params
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.decision.ties import TieKey
from curation_ros.core.episode.topic_map import read_topic_map
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import find_episodes
from curation_ros.dataset.layout import home_of, is_dataset
from curation_ros.live.curator import log_decision

_DONE, _FINDINGS, _NOTHING = 0, 1, 3
_FIXED_WIDTH, _SCORE_WIDTH = 64, 12
_FEW = 5
_LATE_S = 0.1
_Judged: TypeAlias = "tuple[Examined, Decision | None]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument(
        "paths", nargs="+", type=Path, metavar="PATH", help="datasets, bags, .mcap"
    )
    add_reference(parser)
    parser.add_argument(
        "--scorers",
        help="comma separated, in addition to the one that decides; see `curation scorers`",
    )
    add_rule(parser, default="that of the config")
    parser.add_argument("--rule-scorer", help="the scorer that decides; default: of the config")
    add_config(parser)
    parser.add_argument(
        "--write", action="store_true", help="log the decisions in the dataset (one PATH)"
    )
    parser.add_argument(
        "--check", action="store_true", help="exit with 1 where there are findings"
    )
    add_workers(parser)
    parser.add_argument(
        "--fresh", action="store_true", help="score again what has been scored already"
    )


def run(args: argparse.Namespace) -> int:
    """Score everything that can be read; say what could not."""
    settings = _settings(args)
    topic_map = read_topic_map(args.topic_map) if args.topic_map else None
    dataset = _dataset(args) if args.write else None
    reference = read_reference(args.reference, topic_map) if args.reference else []
    curation = Curation.fit(settings, reference)
    rows: list[dict[str, Any]] = []
    n_bad, n_twice = 0, 0
    n_known: Counter[bool] = Counter()
    changes: Counter[tuple[str, str]] = Counter()
    overruled: list[str] = []
    verdicts: Counter[str] = Counter()
    flawed = False
    bags, missing = _find(args.paths)
    for path, problem in missing:
        n_bad += 1
        _report(args, path, problem)
    if curation.scorers.needs_dataset:
        curation = curation.fit_dataset(EpisodesOf(bags, topic_map))
    examiner = Examiner(
        curation.scorers, topic_map, jobs=args.jobs, backend=args.backend, fresh=args.fresh
    )

    def bar(results: Iterable[Examined]) -> Iterator[Examined]:
        shown = track(
            results,
            "scoring",
            total=len(bags),
            console=progress_console,
            transient=True,
            disable=len(bags) < _FEW or not progress_console.is_terminal,
        )
        # A rule over the dataset goes over all bags twice; what is known counts the first time.
        for one in shown:
            n_known.update([one.is_known])
            yield one

    judged = judge_bags(examiner, curation, bags, tie=_tie(dataset), progress=bar)
    for one, decision in _resumable(judged):
        if decision is None or not isinstance(one.result, Examination):
            n_bad += 1
            _report(args, one.path, one.result)
            continue
        if dataset is not None:
            before = in_force(dataset.decisions(decision.episode)).get(decision.episode)
            decision = _logged(dataset, one.path, decision)
            if before is not None and before.verdict != decision.verdict:
                changes[before.verdict, decision.verdict] += 1
        elif person := _overruled_by(one.path, decision):
            overruled.append(f"{decision.name or decision.episode[:8]} ({person})")
        verdicts[decision.verdict] += 1
        n_twice += decision.episode in curation.scorers.reference_ids
        flawed = flawed or bool(decision.findings)
        row = decision_row(one.path, one.result, decision)
        if args.json:
            print_json(row)
        else:
            kept = _kept(decision, one.result)
            rows.append({**row, "kept": kept, "decided_by": _decided_by(decision)})
    if rows:
        for line in curation.describe().splitlines():
            # What a scorer is set to stands in the configuration; that it is silent, nowhere else.
            if not line.startswith("scorer ") or "; abstains: " in line:
                progress_console.print(line, style="dim", markup=False)
        console.print(_table(rows, curation))
    n_read = sum(verdicts.values())
    if n_twice:
        warn(
            f"{n_twice} of the {n_read} episodes are in the reference: what they are compared "
            "with is partly themselves"
        )
    if examiner.problem:
        warn(f"results could not be kept for the next time: {examiner.problem}")
    if len(bags) >= _FEW and (progress_console.is_terminal or not args.json):
        found = ", ".join(f"{verdicts[v]} {v}" for v in VERDICTS if verdicts[v])
        text = f"scored {n_read}, of which {n_known[True]} were known; {n_bad} could not be read"
        progress_console.print(f"{found}; {text}" if found else text, style="dim")
    if changes:
        listed = ", ".join(f"{n} from {old} to {new}" for (old, new), n in changes.most_common())
        warn(f"decisions that were there are replaced: {listed}")
    if overruled:
        rest = f" and {len(overruled) - _FEW} more" if len(overruled) > _FEW else ""
        warn(f"a person decided otherwise, and that counts: {', '.join(overruled[:_FEW])}{rest}")
    if not n_read:
        return _NOTHING
    return _FINDINGS if args.check and (flawed or n_bad) else _DONE


def _resumable(judged: Iterator[_Judged]) -> Iterator[_Judged]:
    """The same; who stops it is told that nothing is lost."""
    try:
        yield from judged
    except KeyboardInterrupt:
        warn("what has been scored is kept: the same command goes on from there")
        raise


def _logged(dataset: Dataset, path: Path, decision: Decision) -> Decision:
    """Log a decision; a person's stays in force, beside the scores and findings of now."""
    if path.name != decision.episode:
        warn(
            f"{path}: not logged: its folder is not named after its episode; "
            f"rename it to {decision.episode}"
        )
        return decision
    return replace(
        log_decision(dataset, decision), scores=decision.scores, findings=decision.findings
    )


def _overruled_by(path: Path, decision: Decision) -> str:
    """What a person has decided in the dataset of a bag, where that is another verdict."""
    folder, _ = home_of(path)
    if not is_dataset(folder) or path.name != decision.episode:
        return ""
    with suppress(CurationError):
        logged = Dataset(folder).decisions(decision.episode)
        held = in_force(logged).get(decision.episode)
        if held is not None and held.by != CURATOR and held.verdict != decision.verdict:
            return f"{held.verdict}, by {held.by}"
    return ""


def _settings(args: argparse.Namespace) -> CurationSettings:
    config = args.config or share_file("config/curation.yaml")
    names = [n.strip() for n in args.scorers.split(",")] if args.scorers else None
    settings: dict[str, Any] = {
        "scorers": names,
        "rule": args.rule,
        "rule_scorer": args.rule_scorer,
    }
    if args.rule:
        settings["rule_params"] = given_params(args.rule, args.value, args.method)
    elif args.value is not None or args.method:
        raise ConfigError("--value and --method belong to a --rule: name one")
    return read_settings(config, settings)


def _find(paths: list[Path]) -> tuple[list[Path], list[tuple[Path, CurationError]]]:
    """Bags that are meant, each once, and paths that lead to none."""
    bags: dict[Path, Path] = {}
    missing = []
    for path in paths:
        try:
            for bag in find_episodes([path]):
                bags.setdefault(bag.resolve(), bag)
        except CurationError as err:
            missing.append((path, err))
    return list(bags.values()), missing


def _report(args: argparse.Namespace, path: Path, problem: object) -> None:
    if args.json:
        finding = getattr(problem, "finding", "")
        print_json({"path": str(path), "error": str(problem), "finding": finding})
    else:
        warn(problem)


def _dataset(args: argparse.Namespace) -> Dataset:
    if len(args.paths) != 1:
        raise ConfigError(f"--write takes one dataset, found {len(args.paths)} paths")
    return Dataset(args.paths[0])


def _tie(dataset: Dataset | None) -> TieKey | None:
    return dataset.tie(0) if dataset is not None else None


def decision_row(path: Path, seen: Examination, decision: Decision) -> dict[str, Any]:
    """The JSON of one scored episode."""
    return {
        "episode": decision.episode,
        "name": decision.name,
        "path": str(path),
        "length": seen.steps,
        "scores": dict(decision.scores),
        "decision": decision.verdict,
        "reason": decision.reason,
        "span": list(decision.span),
        "findings": [f.to_json() for f in decision.findings],
    }


def _kept(decision: Decision, seen: Examination) -> str:
    """For people: which part is kept of what is salvaged; empty for other verdicts."""
    if decision.verdict != "salvage":
        return ""
    first_s, last_s = (ns / NS_PER_S for ns in decision.span)
    # The first step is a little after the start: that is the beginning.
    begins = f"from {first_s:.2f} s\n" if first_s >= _LATE_S else ""
    whole_s = max(seen.span[1], decision.span[1]) / NS_PER_S
    return f"\n{begins}until {last_s:.2f} s\nof {whole_s:.2f} s"


def _decided_by(decision: Decision) -> str:
    """For people: the scorer whose score decided, and its score; or the person."""
    scorer = decision.evidence.get("decided_by", "")
    if decision.by != CURATOR or not scorer:
        return "-" if decision.by == CURATOR else decision.by
    return f"{scorer.replace('_', ' ')}\n{_number(decision.scores.get(scorer))}"


def _table(rows: list[dict[str, Any]], curation: Curation) -> Table:
    """All scores where the terminal is wide enough, else the one that decided."""
    scorers = list(curation.scorers.scorers)
    is_wide = console.width >= _FIXED_WIDTH + _SCORE_WIDTH * len(scorers)
    if not is_wide:
        scorers = []
        progress_console.print("a wider terminal, or --json, shows all scores", style="dim")
    table = Table(box=None, pad_edge=False)
    table.add_column("episode", no_wrap=True)
    table.add_column("decision", no_wrap=True)
    for heading in ("steps", *(s.replace("_", " ") for s in scorers)):
        table.add_column(heading, justify="right")
    if not is_wide:
        table.add_column("decided by", no_wrap=True)
    table.add_column("reason", ratio=1)
    for row in rows:
        cells = [Text(row["name"] or row["episode"][:8])]
        cells += [Text(row["decision"] + row["kept"], VERDICT_STYLE[row["decision"]])]
        cells += [Text(str(row["length"])), *(Text(_number(row["scores"][s])) for s in scorers)]
        if not is_wide:
            cells += [Text(row["decided_by"])]
        table.add_row(*cells, Text(row["reason"]))
    return table


def _number(score: float | None) -> str:
    return "-" if score is None else f"{score:.3g}"
