"""How much faster an episode is examined than before a scorer was asked once.

The old tree is that of commit OLD, taken out of this repository into a temporary folder. A process
of the old tree and one of this tree take turns on one core, with one thread. Each examines
`bags/sample` with `config/curation.yaml` and reports its median CPU time per examination. The
episode is read anew for each examination, outside the timed part: what is computed once per
episode must be paid each time. CPU time and pairs make the ratio robust against other work on the
machine; the milliseconds are those of the machine as it was.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from one_core import environment
from rows import row

if TYPE_CHECKING:
    # At run time a worker imports these from its own tree, which may be the old one.
    from curation_ros.core.episode.episode import Episode

COMMAND = "python benchmarks/run.py examine"
#: The last commit that asked each scorer four questions.
OLD = "d434e8b"
TARGET = 1.8
N_PAIRS = 9
_N_WARM_UP, _N_TIMED = 5, 60
#: Episodes of a reference: enough for every scorer and rule.
_N_REFERENCES = 6
_ROOT = Path(__file__).resolve().parents[1]
_SAMPLE = Path("bags") / "sample"
_CONFIG = Path("config") / "curation.yaml"

Examine = Callable[["Episode"], Any]


# --- in the process of one tree -----------------------------------------------------------------


def old_examine(tree: Path, reference: list[Episode]) -> Examine:
    """The examination as commit OLD has it."""
    configuration = importlib.import_module("curation_ros.configuration")
    curation = configuration.read_curation(tree / _CONFIG, {}).fit(reference)
    examine: Examine = curation.examine
    return examine


def new_examine(tree: Path, reference: list[Episode]) -> Examine:
    """The examination as it is now."""
    from curation_ros.configuration import read_settings
    from curation_ros.core.decision.curation import Curation

    return Curation.fit(read_settings(tree / _CONFIG, {}), reference).examine


def references(sample: Episode, n: int) -> list[Episode]:
    """Slightly different copies of the sample, the same in both trees."""
    rng = np.random.default_rng(0)
    made = []
    for k in range(n):
        twist = sample.fields["twist"] + 0.01 * rng.standard_normal(sample.fields["twist"].shape)
        made.append(replace(sample, id=f"{k}", fields={**sample.fields, "twist": twist}))
    return made


def measure(tree: Path, *, is_old: bool, n_references: int) -> dict[str, Any]:
    """Median CPU time per examination in this process, and what was found.

    Raises:
        SystemExit: if Python imports another tree than the one to be measured.
    """
    package = importlib.import_module("curation_ros")
    if tree not in Path(str(package.__file__)).resolve().parents:
        raise SystemExit(f"expected curation_ros of {tree}, found {package.__file__}")
    home = "curation_ros.bags.reader" if is_old else "curation_ros.dataset.episodes"
    read_episode = importlib.import_module(home).read_episode
    reference = references(read_episode(tree / _SAMPLE), n_references)
    examine = (old_examine if is_old else new_examine)(tree, reference)
    seconds = []
    for k in range(_N_WARM_UP + _N_TIMED):
        episode = read_episode(tree / _SAMPLE)
        began_s = time.process_time()
        found = examine(episode)
        if k >= _N_WARM_UP:
            seconds.append(time.process_time() - began_s)
    return {
        "ms": 1e3 * statistics.median(seconds),
        "found": {
            "scores": found.scores,
            "abstained": found.abstained,
            "findings": [[f.id, f.message, list(f.span)] for f in found.findings],
            "evidence": found.evidence,
        },
    }


# --- in the process that compares ---------------------------------------------------------------


def take_out(commit: str, folder: Path) -> None:
    """Write the files of a commit that are needed into a folder.

    Raises:
        SystemExit: saying what is needed, if the commit is not there.
    """
    wanted = ["curation_ros", str(_CONFIG.parent), str(_SAMPLE)]
    archive = subprocess.run(
        ["git", "-C", str(_ROOT), "archive", commit, *wanted], capture_output=True, check=False
    )
    if archive.returncode:
        raise SystemExit(
            f"{COMMAND} needs git and commit {commit} in {_ROOT}; "
            f"in a shallow clone: git fetch --unshallow. git said: {archive.stderr.decode()}"
        )
    subprocess.run(["tar", "-x", "-C", str(folder)], input=archive.stdout, check=True)


def measured(tree: Path, *, is_old: bool, n_references: int) -> dict[str, Any]:
    """What `measure` returns in a process of a tree, with one thread on one core."""
    arguments = ["--tree", str(tree), "--references", str(n_references)]
    done = subprocess.run(
        [sys.executable, __file__, *arguments, *(["--old"] if is_old else [])],
        env={**environment(), "PYTHONPATH": str(tree)},
        cwd=tree,
        check=True,
        stdout=subprocess.PIPE,
    )
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def compared(old_tree: Path, n_references: int) -> list[dict[str, Any]]:
    """The rows of old and new, measured in pairs.

    Raises:
        SystemExit: if the two find different things.
    """
    pairs = []
    for k in range(N_PAIRS):
        pair = {}
        for is_old in (True, False) if k % 2 else (False, True):
            tree = old_tree if is_old else _ROOT
            pair[is_old] = measured(tree, is_old=is_old, n_references=n_references)
        if pair[True]["found"] != pair[False]["found"]:
            raise SystemExit(f"{OLD} and this tree examine {_SAMPLE} differently")
        pairs.append(pair)
    ratio = statistics.median(pair[True]["ms"] / pair[False]["ms"] for pair in pairs)
    what = f"examine {_SAMPLE}, {n_references or 'no'} references, CPU"
    before = f"{what}, at {OLD}"
    return [
        row(before, statistics.median(pair[True]["ms"] for pair in pairs), "ms", COMMAND),
        row(
            what,
            statistics.median(pair[False]["ms"] for pair in pairs),
            "ms",
            COMMAND,
            against=before,
            ratio=ratio,
            target=f"ratio >= {TARGET:g}",
            holds=ratio >= TARGET,
        ),
    ]


def run() -> list[dict[str, Any]]:
    """Measure; a row per figure."""
    with tempfile.TemporaryDirectory() as folder:
        old_tree = Path(folder).resolve()
        take_out(OLD, old_tree)
        return [*compared(old_tree, 0), *compared(old_tree, _N_REFERENCES)]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Measure one tree; started by run().")
    parser.add_argument("--tree", type=Path)
    parser.add_argument("--old", action="store_true")
    parser.add_argument("--references", type=int, default=0)
    args = parser.parse_args()
    if args.tree is None:
        for result in run():
            print(json.dumps(result))
    else:
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
        print(json.dumps(measure(args.tree, is_old=args.old, n_references=args.references)))
