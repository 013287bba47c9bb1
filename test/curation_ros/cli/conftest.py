"""A small dataset with everything that a command may meet, made once."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from episodes import make_episode, make_reference
from streams import record, samples_of

from curation_ros.cli.main import main
from curation_ros.dataset.dataset import Dataset

#: Scorers of a kind each that are fitted in no time.
CONFIG = "scorers: [gripper_timing, knn, length]\n"


@dataclass
class Answer:
    """What a command said."""

    code: int
    out: str
    err: str
    rows: list[dict[str, Any]] = field(default_factory=list)


@pytest.fixture
def curation(capsys: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    """Run `curation ...`; with --json every line of stdout must be JSON."""

    def run(*arguments: object) -> Answer:
        capsys.readouterr()
        try:
            code = main([str(a) for a in arguments])
        except SystemExit as err:  # argparse
            code = int(err.code or 0)
        out, err_text = capsys.readouterr()
        rows = [json.loads(line) for line in out.splitlines()] if "--json" in arguments else []
        return Answer(code, out, err_text, rows)

    return run


@pytest.fixture(scope="session")
def _recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    rng = np.random.default_rng(20260608)
    reference = Dataset(folder / "reference", create=True)
    for episode in make_reference(rng, 5):
        record(reference, episode)
    data = Dataset(folder / "data", create=True)
    for k, options in enumerate(({}, {}, {"open_at": 140}, {"open_at": 120})):
        record(data, make_episode(rng, name=f"pick-{k}", **options))
    faulty = make_episode(rng, name="pick-4")
    samples = samples_of(faulty)
    nan = [s for s in samples if s.topic != "phase" or not 100 < s.seq < 120]
    record(data, faulty, samples=nan)
    (folder / "curation.yaml").write_text(CONFIG)
    return folder


@pytest.fixture
def folder(_recorded: Path, tmp_path: Path) -> Path:
    """`data` (two good, two early, one with a gap), `reference` and `curation.yaml`, to spoil."""
    target = tmp_path / "recorded"
    shutil.copytree(_recorded, target)
    return target
