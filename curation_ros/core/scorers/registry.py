"""Which scorers there are: the literal list of ours, and those that other packages offer."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING

from curation_ros.core.errors import ConfigError, CurationError, EpisodeError
from curation_ros.core.scorers.ensemble import Ensemble
from curation_ros.core.scorers.entropy import Entropy
from curation_ros.core.scorers.grip_consistency import GripConsistency
from curation_ros.core.scorers.gripper_timing import GripperTiming
from curation_ros.core.scorers.isolation_forest import IsolationForest, LabelFreeIsolationForest
from curation_ros.core.scorers.knn import LabelFreeNearestNeighbours, NearestNeighbours
from curation_ros.core.scorers.length import Length
from curation_ros.core.scorers.object_coupling import ObjectCoupling
from curation_ros.core.scorers.phase_events import PhaseEvents
from curation_ros.core.scorers.scorer import Scorer
from curation_ros.core.scorers.smoothness import Smoothness
from curation_ros.core.scorers.trajectory_alignment import (
    LabelFreeTrajectoryAlignment,
    TrajectoryAlignment,
)
from curation_ros.version import __version__

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

#: Name -> class of our scorers: those of the paper in its order, the baseline, those of the
#: carried object, the label-free twins.
SCORERS: dict[str, type[Scorer]] = {
    "smoothness": Smoothness,
    "entropy": Entropy,
    "gripper_timing": GripperTiming,
    "isolation_forest": IsolationForest,
    "ensemble": Ensemble,
    "knn": NearestNeighbours,
    "trajectory_alignment": TrajectoryAlignment,
    "length": Length,
    "object_coupling": ObjectCoupling,
    "grip_consistency": GripConsistency,
    "phase_events": PhaseEvents,
    "isolation_forest_label_free": LabelFreeIsolationForest,
    "knn_label_free": LabelFreeNearestNeighbours,
    "trajectory_alignment_label_free": LabelFreeTrajectoryAlignment,
}

#: Scorers that are used if none is named. A twin needs the whole dataset, so it must be named.
DEFAULT_SCORERS = tuple(name for name, scorer in SCORERS.items() if scorer.needs != "dataset")

#: Entry point group in which another package offers scorers: name -> class.
ENTRY_POINTS = "curation_ros.scorers"


@dataclass(frozen=True)
class Offer:
    """A scorer that a package offers. Nothing of another package is imported before `load`.

    Attributes:
        name: of the scorer, as configurations and decisions use it.
        package: name and version of the package.
        entry: of another package; None for ours.
    """

    name: str
    package: str
    entry: EntryPoint | None = field(default=None, repr=False)

    def load(self) -> type[Scorer]:
        """The class.

        Raises:
            ConfigError: naming package, name and reason, if the class cannot be used.
        """
        if self.entry is None:
            return SCORERS[self.name]
        if not self.name.isidentifier():
            raise self._refused("its name is no identifier")
        if self.name in SCORERS:
            raise self._refused("curation_ros has a scorer of that name")
        if any(o is not self and o.name == self.name for o in _foreign()):
            packages = " and ".join(o.package for o in _foreign() if o.name == self.name)
            raise self._refused(f"{packages} offer a scorer of that name")
        try:
            kind = self.entry.load()
        except Exception as err:  # other people's code may raise anything
            raise self._refused(f"{type(err).__name__}: {err}") from err
        if not (isinstance(kind, type) and issubclass(kind, Scorer)):
            raise self._refused(f"{self.entry.value} is no subclass of Scorer")
        try:
            kind()
        except Exception as err:
            raise self._refused(
                f"{self.entry.value}() failed: {type(err).__name__}: {err}"
            ) from err
        return kind

    def _refused(self, reason: str) -> ConfigError:
        return ConfigError(f"package {self.package}: scorer {self.name!r}: {reason}")


@cache
def _foreign() -> tuple[Offer, ...]:
    """Offers of other packages, by name. The packages are searched once per process."""
    # Importing this takes 20 ms, which commands without scorers of others do not wait for.
    from importlib.metadata import entry_points

    offers = []
    for entry in entry_points(group=ENTRY_POINTS):
        package = "unknown" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
        offers.append(Offer(entry.name, package, entry))
    return tuple(sorted(offers, key=lambda offer: (offer.name, offer.package)))


def offers() -> tuple[Offer, ...]:
    """All scorers that are offered: ours in their order, then those of others by name."""
    ours = [Offer(name, f"curation_ros {__version__}") for name in SCORERS]
    return (*ours, *_foreign())


def scorer_names() -> tuple[str, ...]:
    """Names of all scorers that are offered, each once, in the order of `offers`."""
    return tuple(dict.fromkeys(offer.name for offer in offers()))


def is_scorer(name: str) -> bool:
    """Whether a package offers a scorer of that name."""
    return name in SCORERS or any(offer.name == name for offer in _foreign())


def find_scorer(name: str) -> type[Scorer]:
    """The class of a scorer.

    A name of ours is found without a look at other packages, so that none of them can break it.

    Raises:
        ConfigError: if no package offers the name, or the class cannot be used.
    """
    if name in SCORERS:
        return SCORERS[name]
    for offer in _foreign():
        if offer.name == name:
            return offer.load()
    raise ConfigError(f"no scorer {name!r}; there are {', '.join(scorer_names())}")


@contextmanager
def contained(name: str) -> Iterator[None]:
    """Turn what a scorer of another package raises into an EpisodeError.

    A fault of such a scorer must not stop the others: it abstains, with the fault as the reason.
    In a scorer of ours an unexpected exception is a bug and is raised as it is.

    Args:
        name: of the scorer that runs in this context.

    Raises:
        EpisodeError: with type and message of the exception.
    """
    try:
        yield
    except CurationError:
        raise
    except Exception as err:
        if name in SCORERS:
            raise
        raise EpisodeError(f"{type(err).__name__}: {err}") from err


def all_scorers() -> dict[str, type[Scorer]]:
    """Name -> class of every scorer, ours and those of other packages.

    Raises:
        ConfigError: if a class of another package cannot be used.
    """
    return {offer.name: offer.load() for offer in offers()}
