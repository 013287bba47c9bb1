"""What a policy sees: one function of episode fields, for whole episodes and for single steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.phases import PHASES
from curation_ros.core.episode.topic_map import AT_START, TopicMap
from curation_ros.core.errors import PolicyError
from curation_ros.core.types import Floats, Span

Operands = tuple[tuple[str, bool], ...]

PHASE = "phase"
_MINUS = " - "
_UNIT = "m"
#: Number of values of each field that a term may name; all but the phase are in metres.
_WIDTHS = {
    "eef_position": 3,
    "finger_position": 2,
    "bowl_position": 3,
    "plate_position": 3,
    PHASE: 1,
}
_PLACES = ("bowl_position@start", "plate_position@start", PHASE)
_OFFSETS = ("bowl_position@start - eef_position", "plate_position@start - eef_position")

#: Terms of an observation by variant: a field, its first value of the episode (`@start`), or a
#: difference of two of these; the phase becomes a one-hot.
VARIANTS: dict[str, tuple[str, ...]] = {
    # Without fingers on purpose: a policy that sees them learns to copy their state, so that a
    # demonstration that opens early does it little harm, and it forgets to open at the end.
    "relative": ("eef_position", *_PLACES, *_OFFSETS),
    "fingers": ("eef_position", "finger_position", *_PLACES, *_OFFSETS),
}


@dataclass(frozen=True)
class ObservationSpec:
    """Which columns an observation has; equal specs give equal bits in training and in the loop.

    Attributes:
        variant: key of VARIANTS.
        phase_labels: names of the phases in the order of the one-hot.

    Raises:
        PolicyError: if the variant is unknown or there are no phase labels.
    """

    variant: str = "relative"
    phase_labels: tuple[str, ...] = PHASES

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise PolicyError(
                f"observation variant {self.variant!r} is none of {', '.join(VARIANTS)}"
            )
        if not self.phase_labels:
            raise PolicyError("an observation needs phase labels, found none")

    @property
    def terms(self) -> tuple[str, ...]:
        """Terms of the variant, in order."""
        return VARIANTS[self.variant]

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Name of every column: `eef_position[0]`, `phase=LIFT`."""
        names: list[str] = []
        for term in self.terms:
            if term == PHASE:
                names += [f"{PHASE}={label}" for label in self.phase_labels]
            else:
                shown = f"({term})" if _MINUS in term else term
                names += [f"{shown}[{k}]" for k in range(_WIDTHS[_operands(term)[0][0]])]
        return tuple(names)

    @property
    def width(self) -> int:
        """Number of columns D."""
        return len(self.columns)

    @cached_property
    def is_one_hot(self) -> npt.NDArray[np.bool_]:
        """(D,) which columns are part of the one-hot: those are not standardised."""
        return np.array([name.startswith(f"{PHASE}=") for name in self.columns])

    @cached_property
    def fields(self) -> tuple[str, ...]:
        """Fields of the topic map that are needed, each once."""
        names = (name for term in self.terms for name, _ in _operands(term))
        return tuple(dict.fromkeys(names))

    @cached_property
    def start_fields(self) -> tuple[str, ...]:
        """Those of `fields` whose first value of the episode is needed."""
        names = (name for term in self.terms for name, at_start in _operands(term) if at_start)
        return tuple(dict.fromkeys(names))

    @cached_property
    def step_fields(self) -> tuple[str, ...]:
        """Those of `fields` whose value of every step is needed."""
        names = (name for term in self.terms for name, at_start in _operands(term) if not at_start)
        return tuple(dict.fromkeys(names))

    @cached_property
    def start_effect(self) -> Floats:
        """(S, D) change of each column by each value of `start_fields`, in their order."""
        rows = {name: 3 * k for k, name in enumerate(self.start_fields)}
        effect = np.zeros((3 * len(rows), self.width))
        for operands, place in self._layout:
            for sign, (name, at_start) in zip((1.0, -1.0), operands, strict=False):
                if at_start:
                    effect[rows[name] : rows[name] + 3, place] = sign * np.eye(3)
        return effect

    @cached_property
    def _layout(self) -> tuple[tuple[Operands, slice], ...]:
        """Operands of each term, and the columns that it fills."""
        places: list[tuple[Operands, slice]] = []
        first = 0
        for term in self.terms:
            operands = _operands(term)
            width = len(self.phase_labels) if term == PHASE else _WIDTHS[operands[0][0]]
            places.append((operands, slice(first, first + width)))
            first += width
        return tuple(places)

    @cached_property
    def _phase_indices(self) -> npt.NDArray[np.int_]:
        return np.arange(len(self.phase_labels))

    def check(self, topic_map: TopicMap, where: str) -> None:
        """Refuse a topic map that cannot give these observations.

        Args:
            topic_map: of an episode or of a robot.
            where: whose requirement it is, for the message.

        Raises:
            PolicyError: if a field is missing, has another width or unit, or the phases have
                other names or another order.
        """
        for name in self.fields:
            spec = topic_map.fields.get(name)
            if spec is None:
                raise PolicyError(
                    f"{where}: the topic map has no field {name!r}; it has "
                    f"{', '.join(topic_map.fields) or 'none'}"
                )
            if len(spec.values) != _WIDTHS[name]:
                raise PolicyError(
                    f"{where}: field {name!r} of the topic map has {len(spec.values)} values, "
                    f"expected {_WIDTHS[name]}"
                )
            if name == PHASE:
                if spec.labels != self.phase_labels:
                    raise PolicyError(
                        f"{where}: the topic map's phases are {', '.join(spec.labels) or 'none'}, "
                        f"expected {', '.join(self.phase_labels)}"
                    )
            elif spec.unit != _UNIT:
                raise PolicyError(
                    f"{where}: field {name!r} of the topic map is in {spec.unit!r}, "
                    f"expected {_UNIT!r}"
                )

    def from_episode(self, episode: Episode, span: Span | None = None) -> Floats:
        """Observations of the steps of an episode.

        Args:
            episode: the whole episode: its first step gives the values at the start, whatever
                the span.
            span: nanoseconds from the start stamp, inclusive, as `Episode.within` takes it;
                None: all steps.

        Returns:
            (T, D) float64, m and one-hot; T steps lie in the span.

        Raises:
            PolicyError: if a field is missing or other than expected, no step lies in the span,
                or a value in it is not finite or no phase.
        """
        where = f"episode {episode.id}"
        self.check(episode.topic_map, where)
        absent = [name for name in self.fields if name not in episode.fields]
        if absent:
            raise PolicyError(
                f"{where}: no field {absent[0]!r}; expected {', '.join(self.fields)}"
            )
        part = episode if span is None else episode.within(span)
        if not len(part):
            raise PolicyError(f"{where}: none of its {len(episode)} steps lies in span {span}")
        start = {name: episode.fields[name][0] for name in self.start_fields}
        return self._assemble(part.fields, start, len(part), where)

    def from_step(
        self, values: Mapping[str, npt.ArrayLike], start: Mapping[str, npt.ArrayLike]
    ) -> Floats:
        """The observation of one step.

        Args:
            values: (d,) values of each of `step_fields`, the phase as its index; others are
                not looked at.
            start: (d,) values of each of `start_fields` in the first step of the episode.

        Returns:
            (D,) float64, m and one-hot.

        Raises:
            PolicyError: if a field is missing, has a wrong width, is not finite or no phase.
        """
        now = {k: _row(k, values, "observation") for k in self.step_fields}
        first = {k: _row(k, start, "first observation") for k in self.start_fields}
        row: Floats = self._assemble({k: v[None] for k, v in now.items()}, first, 1, "step")[0]
        return row

    def _assemble(
        self, values: Mapping[str, Floats], start: Mapping[str, Floats], n_steps: int, where: str
    ) -> Floats:
        out = np.empty((n_steps, self.width))
        for operands, place in self._layout:
            name, at_start = operands[0]
            if name == PHASE:
                out[:, place] = is_phase = values[PHASE] == self._phase_indices
                if not is_phase.any(axis=1).all():
                    row = int(np.argmin(is_phase.any(axis=1)))
                    raise PolicyError(
                        f"{where}: phase index {values[PHASE][row, 0]} in row {row}, "
                        f"expected 0 to {len(self.phase_labels) - 1}"
                    )
                continue
            term = (start if at_start else values)[name]
            for other, at_start in operands[1:]:
                term = term - (start if at_start else values)[other]
            out[:, place] = term
        if not np.isfinite(out).all():
            row, column = np.argwhere(~np.isfinite(out))[0]
            raise PolicyError(
                f"{where}: {self.columns[column]} is {out[row, column]} in row {row}, "
                "expected a finite number"
            )
        return out


def _operands(term: str) -> Operands:
    """Fields of a term, and whether their values at the start are meant."""
    return tuple((x.removesuffix(AT_START), x.endswith(AT_START)) for x in term.split(_MINUS))


def _row(name: str, values: Mapping[str, npt.ArrayLike], where: str) -> Floats:
    if name not in values:
        raise PolicyError(f"{where}: no field {name!r}; it has {', '.join(values) or 'none'}")
    row: Floats = np.asarray(values[name], dtype=np.float64)
    if row.shape != (_WIDTHS[name],):
        raise PolicyError(
            f"{where}: field {name!r} has shape {row.shape}, expected ({_WIDTHS[name]},)"
        )
    return row
