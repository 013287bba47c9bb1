"""An episode: the arrays of one demonstration on its own clock, and what was found in them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from curation_ros.core.episode.arrays import (
    clock_stamps,
    draft_topic_map,
    join_arrays,
    n_rows,
)
from curation_ros.core.episode.findings import Finding
from curation_ros.core.episode.identity import foreign_episode_id
from curation_ros.core.episode.joining import Window
from curation_ros.core.episode.stream import Stamps
from curation_ros.core.episode.topic_map import AT_START, TopicMap
from curation_ros.core.errors import EpisodeError
from curation_ros.core.types import NS_PER_S, Floats


@dataclass(frozen=True, eq=False)
class Episode:
    """One demonstration; row k of every field belongs to `stamps_ns[k]`.

    Labels (success, injected defect) have no place here, on purpose.

    Attributes:
        id: UUID, as minted when the episode started.
        name: short name for people.
        start_ns, end_ns: window of the episode, inclusive.
        stamps_ns: (T,) int64, strictly increasing stamps of the clock topic.
        fields: name -> (T, D) float64; a phase is the index of its name in the map, -1 unknown.
        topic_map: the meaning of the fields.
        findings: faults of the recording, in a stable order.
        sampled_hz: rate of the recording if the steps are a selection that no longer shows it
            (length control); None if the stamps show it.
    """

    id: str
    name: str
    start_ns: int
    end_ns: int
    stamps_ns: Stamps
    fields: Mapping[str, Floats]
    topic_map: TopicMap
    findings: tuple[Finding, ...] = ()
    sampled_hz: float | None = None

    @classmethod
    def from_arrays(
        cls,
        fields: Mapping[str, npt.ArrayLike],
        meaning: Mapping[str, str] | TopicMap,
        *,
        stamps_ns: npt.ArrayLike | None = None,
        rate_hz: float | None = None,
        phases: Sequence[str] = (),
        gripper: Mapping[str, object] | None = None,
        name: str = "",
        episode_id: str = "",
        window: Window | None = None,
        findings: Sequence[Finding] = (),
    ) -> Episode:
        """Make an episode of arrays that never were in a bag; faults are found as in a bag.

        Args:
            fields: name -> (T, D) or (T,) numbers. A phase has (T,) labels, or their indices.
            meaning: role of each field, such as `effector` or `action`, from which a topic map is
                drafted (`draft_topic_map`); or the topic map, which has exactly these fields.
            stamps_ns: (T,) integers, nanoseconds. Exclusive with `rate_hz`.
            rate_hz: steps per second, for arrays without stamps.
            phases: names of the phases in their order, for a drafted map.
            gripper: what the numbers of the gripper mean, for a drafted map.
            name: short name for people.
            episode_id: identity; by default derived from the content.
            window: first and last stamp of the episode; by default those of the arrays.
            findings: faults that the arrays do not show.

        Raises:
            ConfigError: if the roles do not make a topic map.
            EpisodeError: if the arrays do not fit the map or the stamps.

        Example:
            >>> hand = np.linspace([0.0, 0.0, 1.0], [0.3, 0.1, 1.2], 40)
            >>> fields = {"hand": hand, "velocity": np.gradient(hand, axis=0)}
            >>> roles = {"hand": "effector", "velocity": "action"}
            >>> Episode.from_arrays(fields, roles, rate_hz=20.0, name="by-hand")
            Episode(by-hand, T=40, hand 3, velocity 3)
        """
        if not isinstance(meaning, TopicMap):
            meaning = draft_topic_map(fields, meaning, phases=phases, gripper=gripper)
        stamps = clock_stamps(n_rows(fields), stamps_ns, rate_hz, window)
        if window is None:
            window = (int(stamps.min()), int(stamps.max())) if len(stamps) else (0, 0)
        joined = join_arrays(fields, meaning, stamps, window, findings)
        episode = cls(
            episode_id,
            name,
            *window,
            stamps_ns=joined.stamps_ns,
            fields=joined.fields,
            topic_map=meaning,
            findings=joined.findings,
        )
        derived_id = foreign_episode_id(episode.content_digest, window[0])
        return episode if episode_id else replace(episode, id=derived_id)

    def __getstate__(self) -> dict[str, Any]:
        # Cached values are computed again where they are needed, and do not travel to workers.
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def __len__(self) -> int:
        """Number of steps T."""
        return len(self.stamps_ns)

    def __repr__(self) -> str:
        shapes = ", ".join(f"{k} {v.shape[1]}" for k, v in self.fields.items())
        return f"Episode({self.name or self.id[:8]}, T={len(self)}, {shapes})"

    def field(self, name: str) -> Floats:
        """A (T, D) field by name.

        Raises:
            EpisodeError: if the episode has no such field.
        """
        try:
            return self.fields[name]
        except KeyError:
            raise EpisodeError(
                f"episode {self.id}: no field {name!r}; it has {', '.join(self.fields) or 'none'}"
            ) from None

    @cached_property
    def rate_hz(self) -> float:
        """Rate of the recording, else median rate of the clock; NaN with fewer than two steps."""
        if self.sampled_hz is not None:
            return self.sampled_hz
        if len(self) < 2:
            return float("nan")
        return NS_PER_S / float(np.median(np.diff(self.stamps_ns)))

    @property
    def phase(self) -> Floats | None:
        """(T,) index of the phase, -1 unknown; None if the map has no phase."""
        specs = self.topic_map.with_role("phase")
        return self.fields[specs[0].name][:, 0] if specs else None

    @property
    def phase_labels(self) -> tuple[str, ...]:
        """Names of the phases in their order; empty if the map has no phase."""
        specs = self.topic_map.with_role("phase")
        return specs[0].labels if specs else ()

    def columns(self, names: tuple[str, ...]) -> Floats:
        """Fields side by side, as `state` and `action` of the topic map name them.

        Args:
            names: field names; `name@start` repeats the first row, a phase becomes a one-hot.

        Returns:
            (T, D) float64.

        Raises:
            EpisodeError: if `names` is empty, a field is missing, or the episode has no step.
        """
        if not names or not len(self):
            raise EpisodeError(f"episode {self.id}: no columns {names} over {len(self)} steps")
        parts = []
        for name in names:
            values = self.field(name.removesuffix(AT_START))
            labels = self.topic_map.fields[name.removesuffix(AT_START)].labels
            if labels:
                values = (values == np.arange(len(labels))).astype(np.float64)
            if name.endswith(AT_START):
                values = np.broadcast_to(values[:1], values.shape)
            parts.append(values)
        return np.concatenate(parts, axis=1)

    @cached_property
    def state(self) -> Floats:
        """(T, S) state, as the topic map declares it; read-only, because scorers share it."""
        return _read_only(self.columns(self.topic_map.state))

    @cached_property
    def action(self) -> Floats:
        """(T, A) action, as the topic map declares it; read-only, because scorers share it."""
        return _read_only(self.columns(self.topic_map.action))

    @cached_property
    def derived(self) -> dict[Callable[[Episode], Any], Any]:
        """Measurements kept with the episode, by function; see `evidence.once`."""
        return {}

    def steps(self, stop: int, start: int = 0) -> Episode:
        """The same episode with steps [start, stop) only; id, name and findings stay."""
        return replace(
            self,
            stamps_ns=self.stamps_ns[start:stop],
            fields={k: v[start:stop] for k, v in self.fields.items()},
        )

    def span(self, first: int, last: int) -> tuple[int, int]:
        """Nanoseconds from the start stamp of steps `first` and `last` (inclusive)."""
        return (
            int(self.stamps_ns[first]) - self.start_ns,
            int(self.stamps_ns[last]) - self.start_ns,
        )

    def within(self, span: tuple[int, int]) -> Episode:
        """The steps whose stamps lie in a span (nanoseconds from start_ns, inclusive)."""
        low, high = np.searchsorted(
            self.stamps_ns, [self.start_ns + span[0], self.start_ns + span[1] + 1]
        )
        return self.steps(int(high), int(low))

    @property
    def digest(self) -> str:
        """SHA-256 over id, window and decoded values: equal exactly when the arrays are.

        Never of CDR bytes: their padding is uninitialised memory.
        """
        return self._hashed(f"{self.id}:{self.start_ns}:{self.end_ns}", self.stamps_ns)

    @property
    def content_digest(self) -> str:
        """SHA-256 over decoded values and stamps from the first one, without identity or window.

        Equal for two copies of one recording under any names and start times. All episodes without
        a step have the same one.
        """
        return self._hashed("", self.stamps_ns - self.stamps_ns[:1])

    def _hashed(self, identity: str, stamps_ns: Stamps) -> str:
        h = hashlib.sha256(identity.encode())
        h.update(stamps_ns.astype("<i8").tobytes())
        for name in sorted(self.fields):
            h.update(f"{name}{self.fields[name].shape}".encode())
            h.update(self.fields[name].astype("<f8").tobytes())
        return h.hexdigest()


def _read_only(values: Floats) -> Floats:
    values.setflags(write=False)
    return values
