"""One call from an episode to a decision, for tests that look at the decision alone."""

from __future__ import annotations

from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import Decision
from curation_ros.core.episode.episode import Episode


def decide_on(curation: Curation, episode: Episode) -> Decision:
    """Examine an episode and decide on it, without a look at the dataset."""
    return curation.decide(curation.examine(episode))
