"""A scorer that cheats: it finds the bag that is being read, and the labels beside it."""

from __future__ import annotations

import inspect
from pathlib import Path

from curation_ros.batch import examine
from curation_ros.core.episode.episode import Episode
from curation_ros.core.scorers import Look, Scorer
from curation_ros.dataset.dataset import Dataset


class Peeker(Scorer):
    """Scores 1.0 where the truth beside the bag says that the episode succeeded."""

    needs = "nothing"

    def look(self, episode: Episode) -> Look:
        """Read the truth of the dataset that the bag lies in."""
        truth = Dataset(path_being_read().resolve().parents[1]).truth()
        return Look(float(truth.get(episode.id, {}).get("outcome") == "succeeded"))


def path_being_read() -> Path:
    """The recording that one of the callers has just read."""
    frame = inspect.currentframe()
    while frame is not None:
        if frame.f_globals.get("__name__") == examine.__name__ and "path" in frame.f_locals:
            path: Path = frame.f_locals["path"]
            return path
        frame = frame.f_back
    raise AssertionError("no recording is being read")
