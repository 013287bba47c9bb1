"""Scorers of other packages, each installed in a folder of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from episodes import make_episode, make_reference
from other_packages import install
from streams import record

from curation_ros.core.decision.fitted_rule import fit_rule
from curation_ros.core.decision.fitted_scorers import fit_scorers
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import ConfigError, EpisodeError
from curation_ros.core.scorers import (
    SCORERS,
    Look,
    Scorer,
    all_scorers,
    find_scorer,
    is_scorer,
    registry,
    scorer_names,
)
from curation_ros.dataset.dataset import Dataset
from curation_ros.version import __version__

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[4]

PAUSES = '''
from curation_ros.core.scorers import Look, Scorer


class Pauses(Scorer):
    """Share of the steps in which the arm moves."""

    needs = "nothing"
    resolution = 0.02
    version = 3

    def __init__(self, *, slow: float = 0.1) -> None:
        self.slow = slow

    def look(self, episode):
        return Look(float((abs(episode.field("twist")).max(axis=1) > self.slow).mean()))
'''


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Install a package that offers scorers, name -> object, for this process."""

    def done(offered: dict[str, str], code: str = PAUSES, package: str = "arm-scorers") -> Path:
        folder = install(tmp_path / package, package, {"curation_ros.scorers": offered}, code)
        monkeypatch.syspath_prepend(str(folder))
        registry._foreign.cache_clear()
        return folder

    yield done
    registry._foreign.cache_clear()
    for module in ("arm_scorers", "leg_scorers"):
        sys.modules.pop(module, None)


def test_without_other_packages_there_are_ours() -> None:
    assert scorer_names() == tuple(SCORERS)
    assert all_scorers() == SCORERS
    assert {offer.package for offer in registry.offers()} == {f"curation_ros {__version__}"}


def test_scorer_of_another_package_is_found(installed: Any) -> None:
    installed({"pauses": "arm_scorers:Pauses"})
    kind = find_scorer("pauses")
    assert (kind.__name__, kind.version) == ("Pauses", 3)
    assert is_scorer("pauses")
    assert scorer_names() == (*SCORERS, "pauses")
    assert all_scorers() == {**SCORERS, "pauses": kind}
    assert registry.offers()[-1].package == "arm-scorers 0.3"
    assert "pauses" not in registry.DEFAULT_SCORERS


def test_unknown_name_is_refused_with_all_names(installed: Any) -> None:
    installed({"pauses": "arm_scorers:Pauses"})
    assert not is_scorer("smoothnes")
    with pytest.raises(ConfigError, match=r"no scorer 'smoothnes'; there are smooth.*, pauses$"):
        find_scorer("smoothnes")


@pytest.mark.parametrize(
    ("name", "target", "code", "reason"),
    [
        ("pauses", "arm_scorers:Missing", PAUSES, "AttributeError: .*Missing"),
        ("pauses", "nowhere:Pauses", PAUSES, "ModuleNotFoundError: .*nowhere"),
        ("pauses", "arm_scorers:Pauses", "import nothing_there", "ModuleNotFoundError"),
        ("pauses", "arm_scorers:Pauses", "def f(:", "SyntaxError"),
        ("pauses", "arm_scorers:Pauses", "class Pauses: pass", "is no subclass of Scorer"),
        ("pauses", "arm_scorers:Pauses", "Pauses = 3", "is no subclass of Scorer"),
        ("pauses", "arm_scorers:Pauses", PAUSES.replace("def look", "def see"), "abstract"),
        ("pauses", "arm_scorers:Pauses", PAUSES.replace(" = 0.1", ""), "missing 1 required"),
        ("smoothness", "arm_scorers:Pauses", PAUSES, "curation_ros has a scorer of that name"),
        ("pause, rest", "arm_scorers:Pauses", PAUSES, "its name is no identifier"),
    ],
)
def test_class_that_cannot_be_used_is_refused(
    installed: Any, name: str, target: str, code: str, reason: str
) -> None:
    installed({name: target}, code)
    expected = rf"package arm-scorers 0\.3: scorer '{name}': .*{reason}"
    with pytest.raises(ConfigError, match=expected):
        all_scorers()
    if name in SCORERS:
        assert find_scorer(name) is SCORERS[name]  # another package cannot break it
    else:
        with pytest.raises(ConfigError, match=expected):
            find_scorer(name)
    assert find_scorer("knn") is SCORERS["knn"]


def test_two_packages_with_one_name_are_both_refused(installed: Any) -> None:
    installed({"pauses": "arm_scorers:Pauses"})
    installed({"pauses": "arm_scorers:Pauses"}, package="leg-scorers")
    with pytest.raises(ConfigError, match=r"arm-scorers 0\.3 and leg-scorers 0\.3 offer"):
        find_scorer("pauses")


def test_nothing_of_another_package_is_imported_before_it_is_asked_for(installed: Any) -> None:
    installed({"pauses": "arm_scorers:Pauses"})
    assert is_scorer("pauses")
    assert registry.offers()
    assert "arm_scorers" not in sys.modules


def test_bags_are_scored_by_a_scorer_of_another_package(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """Its name goes through the configuration, and its class to worker processes."""
    folder = install(
        tmp_path / "arm",
        "arm-scorers",
        {"curation_ros.scorers": {"pauses": "arm_scorers:Pauses"}},
        PAUSES,
    )
    config = tmp_path / "curation.yaml"
    config.write_text("scorers: [pauses, length]\nrule: none\nrule_scorer: pauses\n")
    dataset = Dataset(tmp_path / "data", create=True)
    episodes = [make_episode(rng, 100 + 20 * k, name=f"pick-{k}") for k in range(4)]
    for episode in episodes:
        record(dataset, episode)
    command = ["score", "--json", str(dataset.path), "--config", str(config), "--jobs", "2"]
    done = subprocess.run(
        [sys.executable, "-m", "curation_ros.cli.main", *command],
        env={**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    moving = {e.id: float((abs(e.fields["twist"]).max(axis=1) > 0.1).mean()) for e in episodes}
    assert {row["episode"]: row["scores"]["pauses"] for row in rows} == moving
    assert len(set(moving.values())) > 1


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        (PAUSES.replace('field("twist")', 'field("twist")[10**6]'), "IndexError: index 1000000"),
        (PAUSES.replace("Look(float(", "dict(score=float("), "AttributeError: 'dict' object"),
        (
            PAUSES.replace("    def look", "    def fit(self, _):\n        1 / 0\n\n    def look"),
            "ZeroDivisionError: division by zero",
        ),
    ],
)
def test_fault_in_a_scorer_of_another_package_is_its_reason_to_abstain(
    installed: Any, rng: np.random.Generator, code: str, reason: str
) -> None:
    installed({"pauses": "arm_scorers:Pauses"}, code)
    settings = CurationSettings(scorers=("pauses", "length"), rule="none", rule_scorer="length")
    fitted = fit_scorers(settings, make_reference(rng))
    scores, abstained = fitted.score(make_episode(rng))
    assert scores == {"pauses": None, "length": -240.0}
    assert abstained["pauses"].startswith(reason)


FIT_SOME = """    needs = "reference"

    def fit(self, episodes):
        self.n_ = len(episodes) / (len(episodes) == 4)
        return self
"""
LOOK_SOME = """    def look(self, episode):
        return Look(episode.field("twist")[10**6])
"""


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        (PAUSES.replace('    needs = "nothing"\n', FIT_SOME), "ZeroDivisionError: "),
        (PAUSES.partition("    def look")[0] + LOOK_SOME, "IndexError: index 1000000"),
    ],
    ids=["fit without one of the reference", "look"],
)
def test_fault_in_a_scorer_that_decides_ends_with_its_reason(
    installed: Any, rng: np.random.Generator, code: str, reason: str
) -> None:
    installed({"pauses": "arm_scorers:Pauses"}, code)
    settings = CurationSettings(scorers=("pauses",), rule="threshold", rule_scorer="pauses")
    reference = make_reference(rng)[:4]
    with pytest.raises(EpisodeError, match=reason):
        fit_rule(fit_scorers(settings, reference), reference)


def test_fault_in_a_scorer_of_ours_is_raised(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    def look(_: Scorer, episode: Episode) -> Look:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(SCORERS["length"], "look", look)
    settings = CurationSettings(scorers=("length",), rule="none", rule_scorer="length")
    with pytest.raises(ZeroDivisionError, match="a bug"):
        fit_scorers(settings, []).look(make_episode(rng))


def test_scoring_hash_tells_packages_apart_that_use_one_name(installed: Any) -> None:
    settings = {"scorers": ("pauses",), "rule": "none", "rule_scorer": "pauses"}
    hashes = set()
    for package in ("arm-scorers", "leg-scorers"):
        installed({"pauses": f"{package.replace('-', '_')}:Pauses"}, package=package)
        (mine,) = (o for o in registry._foreign() if o.package.startswith(package))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(registry, "_foreign", lambda mine=mine: (mine,))
            hashes.add(fit_scorers(CurationSettings(**settings), []).scoring_hash)
    assert len(hashes) == 2
