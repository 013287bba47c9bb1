"""The curator without ROS: samples and episode events in, logged decisions out."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from curation_ros.batch.copies import with_copy
from curation_ros.batch.score import decide_dataset
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import Decision, in_force, own_decisions, untrustworthy
from curation_ros.core.decision.fitted_rule import FittedRule
from curation_ros.core.episode.builder import EpisodeBuilder
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding
from curation_ros.core.episode.gate import DRAIN_S, Closed, EpisodeGate
from curation_ros.core.episode.status import EpisodeEvent, owner_findings
from curation_ros.core.episode.stream import Decoder, Sample
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import CurationError, EpisodeError
from curation_ros.core.evidence.alerts import AlertWatch
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.decision_log import log_decision, log_override
from curation_ros.dataset.episodes import read_episode

#: A running episode is checked for alerts this often, by its own clock.
ALERT_PERIOD_S = 0.1
#: Number of episodes that are kept in memory until their bags close.
_REMEMBERED = 8


@dataclass
class _OpenEpisode:
    """An episode with an open gate; `checked_ns` is the stamp of its last check for alerts."""

    builder: EpisodeBuilder
    event: EpisodeEvent
    watch: AlertWatch
    checked_ns: int = 0


@dataclass(frozen=True)
class Decided:
    """A decision, and how long it took.

    Attributes:
        decision: as logged.
        latency_s: from the closing of the gate to the decision on disk; None for the decision on
            a bag.
    """

    decision: Decision
    latency_s: float | None = None


@dataclass(frozen=True)
class Alert:
    """What has gone wrong with a running episode.

    Attributes:
        episode, name: identity of the episode.
        finding: what, where and when; its span counts from the start of the episode.
        seen_ns: stamp of the newest sample that it took to detect it.
    """

    episode: str
    name: str
    finding: Finding
    seen_ns: int


class LiveCurator:
    """Builds episodes from live samples, and decides on them when their gates close.

    Decisions are logged before they are returned. A person outranks the curator: after a person
    has decided, a later revision changes the scores but not the verdict.
    """

    def __init__(
        self,
        dataset: Dataset,
        topic_map: TopicMap,
        decoder: Decoder,
        curation: Curation,
        *,
        drain_timeout_s: float = DRAIN_S,
    ) -> None:
        """Start without an episode.

        Args:
            dataset: where decisions are logged, and where the recorder's bags appear.
            topic_map: how episodes are built.
            decoder: turns CDR bytes into columns.
            curation: fitted on the reference.
            drain_timeout_s: how long to wait for late samples after the end of an episode.
        """
        self.dataset = dataset
        self.topic_map = topic_map
        self.curation = curation
        self.gate = EpisodeGate(
            topic_map.topics, max_gap_s=topic_map.max_gap_s, drain_timeout_s=drain_timeout_s
        )
        self._decoder = decoder
        self._scores = _known_scores(dataset, curation) if curation.rule_needs_dataset else {}
        self._open: dict[str, _OpenEpisode] = {}
        self._ended: dict[str, Episode] = {}  # as built live, until their bags are compared
        self._read: deque[str] = deque(
            maxlen=_REMEMBERED
        )  # ids of episodes with a bag that was read
        self._unread: set[str] = set()  # ids of bags that closed before their gates
        self._alerts: list[Alert] = []

    def event(self, event: EpisodeEvent, now_s: float) -> list[Decided]:
        """Take an event of the episode's owner."""
        known = self.gate.open_ids
        early = self.gate.event(event, now_s)
        if event.event == "started" and event.id in self.gate.open_ids and event.id not in known:
            builder = EpisodeBuilder(
                self.topic_map,
                self._decoder,
                episode_id=event.id,
                name=event.name,
                start_ns=event.start_ns,
            )
            watch = AlertWatch(self.topic_map, usual=self.curation.scorers.baseline.usual_)
            self._open[event.id] = _OpenEpisode(builder, event, watch)
            for sample in early:
                builder.push(sample)
        return self.tick(now_s)

    def sample(self, sample: Sample, now_s: float) -> list[Decided]:
        """Take a sample."""
        episode_id = self.gate.push(sample)
        if episode_id is None:
            return self.tick(now_s)
        self._open[episode_id].builder.push(sample)
        self._check(episode_id)
        window = self.gate.window(episode_id)
        return self.tick(now_s) if window is not None and window.ended is not None else []

    def tick(self, now_s: float) -> list[Decided]:
        """Decide on every episode with a gate that has closed."""
        decided = []
        for closed in self.gate.close_ready(now_s):
            decided.append(self._decide_live(closed))
            if closed.event.id in self._unread:
                self._unread.remove(closed.event.id)
                decided.append(self._decide_bag(closed.event.id))
        return [d for d in decided if d is not None]

    def take_alerts(self) -> list[Alert]:
        """Alerts since the last call, oldest first."""
        alerts, self._alerts = self._alerts, []
        return alerts

    def _check(self, episode_id: str) -> None:
        """Check for an alert, once per period in which all topics have moved on."""
        running = self._open[episode_id]
        now_ns = running.builder.settled_ns
        due_ns = running.checked_ns + int(ALERT_PERIOD_S * NS_PER_S)
        if running.watch.has_alerted or now_ns < due_ns:
            return
        running.checked_ns = now_ns
        finding = running.watch.take(running.builder.settled())
        if finding is not None:
            self._alerts.append(Alert(episode_id, running.event.name, finding, now_ns))

    @property
    def running(self) -> str:
        """Id of the running episode, empty if there is none."""
        return self.gate.open_ids[-1] if self.gate.open_ids else ""

    def counts(self) -> dict[str, int]:
        """Topic -> samples of the running episode so far."""
        window = self.gate.window(self.running)
        counts = window.counts() if window is not None else {}
        return {topic: counts.get(topic, 0) for topic in self.topic_map.topics}

    def _decide_live(self, closed: Closed) -> Decided | None:
        """The decision on the received samples; None if there is nothing to decide on.

        Of an episode that ended before this curator joined, only the latched event of its owner
        arrives. A bag that was read already takes precedence over live samples.
        """
        began = time.perf_counter()
        running = self._open.pop(closed.event.id)
        is_live = closed.event.source == "live"
        if is_live and (closed.event.id in self._read or not any(closed.counts.values())):
            return None
        end_ns = closed.event.end_ns
        if end_ns is None:
            end_ns = running.builder.partial().end_ns
        event = replace(closed.event, end_ns=end_ns)
        episode = running.builder.finish(end_ns, event.counts, owner_findings(event))
        self._ended[episode.id] = episode
        while len(self._ended) > _REMEMBERED:
            del self._ended[next(iter(self._ended))]
        logged = log_decision(self.dataset, self._decision_on(episode))
        return Decided(logged.in_force, time.perf_counter() - began)

    def _decision_on(self, episode: Episode) -> Decision:
        """The decision for now: a rule over the dataset uses the scores so far."""
        examination = self.curation.examine(episode)
        original = self.dataset.with_content(examination.content, other_than=episode.id)
        if original is not None and examination.steps:
            examination = with_copy(examination, original)
        rule: FittedRule | None = None
        if self.curation.rule_needs_dataset:
            if examination.is_trusted:
                scorer = self.curation.settings.rule_scorer
                self._scores[episode.id] = examination.scores.get(scorer)
            else:  # its bag may show a fault that the live samples did not
                self._scores.pop(episode.id, None)
            rule = self.curation.rule_over(self._scores, final=False, tie=self.dataset.tie(0))
        return self.curation.decide(examination, rule)

    def bag_closed(self, episode_id: str) -> list[Decided]:
        """Compare a closed bag with the episode as built live; if they differ, the bag wins.

        If the gate of the episode is about to close, `tick` compares them afterwards. If no end
        was announced, the recorder was stopped, and the bag is read now.
        """
        window = self.gate.window(episode_id)
        if window is not None and window.ended is not None:
            self._unread.add(episode_id)
            return []
        decided = self._decide_bag(episode_id)
        return [] if decided is None else [decided]

    def _decide_bag(self, episode_id: str) -> Decided | None:
        """The decision on a bag; None if the one before stands."""
        live = self._ended.pop(episode_id, None)
        known = self.dataset.decisions(episode_id)
        try:
            episode = read_episode(self.dataset.bag_path(episode_id), self.topic_map)
        except CurationError as err:
            if known:
                self._amend(known[-1], {"bag": f"not seen: {err}"})
            return None
        self._read.append(episode_id)
        found = "alone"
        if live is not None:
            same = live.digest == episode.digest and live.findings == episode.findings
            found = "equal" if same else "differs"
        if known and found == "equal":
            self._amend(known[-1], {"bag": found})
            return None
        own = own_decisions(known).get(episode_id)
        if found == "alone" and own is not None and self._stands(own, episode):
            return Decided(in_force(known)[episode_id])
        decision = self._decision_on(episode)
        evidence = {**decision.evidence, "bag": found}
        return Decided(log_decision(self.dataset, replace(decision, evidence=evidence)).in_force)

    def _stands(self, own: Decision, episode: Episode) -> bool:
        """Whether the curator's own decision on a bag need not be made again.

        A restarted curator receives the latched status of the last bag once more. Its decision
        must neither lose the comparison with the live samples nor turn from final to provisional.
        """
        if own.evidence.get("content") != episode.content_digest:
            return False
        if self.curation.rule_needs_dataset:
            return bool(own.evidence.get("scoring") == self.curation.scorers.scoring_hash)
        return own.state_hash == self.curation.rule.state_hash

    def finish(self) -> list[Decision]:
        """Decide on the whole dataset, finally, if the rule depends on all of it.

        Returns:
            The decisions in force that are new; none if each was final already.

        Raises:
            CurationError: while an episode is running, because its samples would be lost.
        """
        if not self.curation.rule_needs_dataset:
            return []
        if self.running:
            raise EpisodeError("an episode is running: decide on the whole dataset after it")
        self.curation, decided = decide_dataset(self.dataset, self.curation, self.topic_map)
        # Scorers may have learned from the dataset anew, and then their earlier scores are void.
        self._scores = _known_scores(self.dataset, self.curation)
        return decided

    def override(self, prefix: str, verdict: str, reason: str, by: str) -> Decision:
        """Log a person's decision.

        Args:
            prefix: id, beginning of an id, or short name.
            verdict: keep, discard or review; for salvage, see `log_override`.
            reason: in the person's words; may be empty.
            by: name of the person.

        Raises:
            EpisodeError: if the episode is not known or the verdict is none of the three.
        """
        state_hash = self.curation.rule.state_hash
        return log_override(self.dataset, prefix, verdict, reason, by, state_hash=state_hash)

    def _amend(self, decision: Decision, evidence: Mapping[str, Any]) -> None:
        merged = {**decision.evidence, **evidence}
        if merged != decision.evidence:
            self.dataset.append_decision(replace(decision, evidence=merged), amend=True)


def _known_scores(dataset: Dataset, curation: Curation) -> dict[str, float | None]:
    """Deciding scores that the scorers of this curation have logged before."""
    found = {}
    for episode_id in dataset.decided_ids():
        last = own_decisions(dataset.decisions(episode_id)).get(episode_id)
        if (
            last is not None
            and last.evidence.get("scoring") == curation.scorers.scoring_hash
            and not untrustworthy(last.findings)
        ):
            found[episode_id] = last.scores.get(curation.settings.rule_scorer)
    return found
