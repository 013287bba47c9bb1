"""What trusted episodes look like, as plain numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.measurements import MIN_STEPS, Measurements

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode.episode import Episode


class Baseline:
    """What trusted episodes look like. The order of the episodes does not matter.

    Attributes:
        n_: number of episodes.
        rate_hz_: lowest and highest rate.
        duration_s_: shortest duration.
        start_speed_: highest speed of the effector in the first step, in its unit per second.
        idle_s_: longest rest with motion before and after it.
        still_s_: topic -> longest time for which its values repeat.
        first_phase_, last_phase_, open_phase_: lowest index of the phase at the start, of the
            highest phase that was reached, and at the first opening; -1 if there is none.
        held_s_: shortest time from the first closing to the first opening after it; 0 if an
            episode has none.
        starts_open_, closes_, opens_: 1 if all of them start with an open gripper, close it, and
            open it again; else 0.
        usual_: ids of alerts that most of them would raise. For this robot they are no alerts.
    """

    def fit(self, episodes: Iterable[Episode]) -> Self:
        """Learn from trusted episodes. Without any, nothing is compared.

        Raises:
            EpisodeError: if one has fewer than MIN_STEPS steps.
        """
        facts = []
        for episode in episodes:
            if len(episode) < MIN_STEPS:
                raise EpisodeError(
                    f"episode {episode.id}: {len(episode)} steps, a baseline needs {MIN_STEPS}"
                )
            facts.append(Measurements.of(episode))
        self.n_ = len(facts)
        rates = [f.rate_hz for f in facts]
        self.rate_hz_ = (min(rates, default=0.0), max(rates, default=0.0))
        self.duration_s_ = min((f.duration_s for f in facts), default=0.0)
        self.start_speed_ = max((f.start_speed for f in facts), default=0.0)
        self.idle_s_ = max((f.idle[0] for f in facts), default=0.0)
        self.still_s_: dict[str, float] = {}
        for fact in facts:
            for topic, (seconds, _, _) in fact.still.items():
                self.still_s_[topic] = max(self.still_s_.get(topic, 0.0), seconds)
        self.first_phase_ = min((f.first_phase for f in facts), default=-1)
        self.last_phase_ = min((f.last_phase for f in facts), default=-1)
        self.open_phase_ = min((f.open_phase for f in facts), default=-1)
        self.held_s_ = min((f.held_s for f in facts), default=0.0)
        self.starts_open_ = int(bool(facts) and all(not f.starts_closed for f in facts))
        self.closes_ = int(bool(facts) and all(f.closes for f in facts))
        self.opens_ = int(bool(facts) and all(f.opening is not None for f in facts))
        shown = Counter(id_ for f in facts for id_ in {finding.id for finding in f.alerts})
        self.usual_ = tuple(sorted(k for k, n in shown.items() if 2 * n > len(facts)))
        return self

    def fitted(self) -> dict[str, Any]:
        """Learned values by name."""
        return {k: v for k, v in vars(self).items() if k.endswith("_")}
