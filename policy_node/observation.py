"""What a policy observes: columns of an episode's fields, alike for episodes and single steps."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import PolicyError
from curation_ros.core.types import Floats, Span
from policy_node.observation_terms import (
    LENGTHS,
    ObservedField,
    Operand,
    Term,
    make_term,
    observed_field,
    parse_operands,
)

_COLUMN = re.compile(r"(?P<term>.+)\[[0-9]+\]|(?P<phase>[^=]+)=(?P<label>.+)")


@dataclass(frozen=True)
class ObservationSpec:
    """Which columns an observation has; equal specs give equal bits in training and when driving.

    Make one with `observation_spec`, which checks the terms against a topic map.

    Attributes:
        terms: in order; each is a field (`joint_position`), the first value of a field
            (`cup_pose@start`), or a difference of these (`cup_pose@start - tool_pose`).
        observed: the fields of the terms, each once, in the order of the terms.

    Raises:
        PolicyError: if there is no term, or a term and its fields do not fit together.
    """

    terms: tuple[str, ...]
    observed: tuple[ObservedField, ...]

    def __post_init__(self) -> None:
        if not self.terms:
            raise PolicyError("an observation needs at least one term, found none")
        wanted = _names(self.terms)
        if wanted != list(self.fields):
            raise PolicyError(
                f"the terms name {', '.join(wanted)}, the observed fields are "
                f"{', '.join(self.fields) or 'none'}"
            )
        _ = self._layout  # checks each term

    @cached_property
    def _by_name(self) -> dict[str, ObservedField]:
        return {field.name: field for field in self.observed}

    @cached_property
    def _layout(self) -> tuple[tuple[Term, slice], ...]:
        """Each term, and the columns that it fills."""
        terms = [make_term(text, self._by_name) for text in self.terms]
        ends = itertools.accumulate((len(term.columns) for term in terms), initial=0)
        return tuple(zip(terms, itertools.starmap(slice, itertools.pairwise(ends)), strict=True))

    @cached_property
    def _labels(self) -> dict[str, npt.NDArray[np.int_]]:
        """Indices of the phases of each field that is one."""
        return {f.name: np.arange(len(f.labels)) for f in self.observed if f.labels}

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Name of every column, such as `eef_position[0]` or `phase=LIFT`."""
        return tuple(name for term, _ in self._layout for name in term.columns)

    @property
    def width(self) -> int:
        """Number of columns D."""
        return len(self.columns)

    @cached_property
    def fields(self) -> tuple[str, ...]:
        """Names of the observed fields, each once."""
        return tuple(field.name for field in self.observed)

    @cached_property
    def start_fields(self) -> tuple[str, ...]:
        """Those of `fields` whose first value of the episode is needed."""
        return tuple(dict.fromkeys(o.name for o in self._operands if o.is_at_start))

    @cached_property
    def step_fields(self) -> tuple[str, ...]:
        """Those of `fields` whose value in every step is needed."""
        return tuple(dict.fromkeys(o.name for o in self._operands if not o.is_at_start))

    @property
    def _operands(self) -> Iterable[Operand]:
        return (operand for term, _ in self._layout for operand in term.operands)

    @cached_property
    def is_one_hot(self) -> npt.NDArray[np.bool_]:
        """(D,) bool: columns of a one-hot, which are not standardised."""
        mask = np.zeros(self.width, dtype=bool)
        for term, place in self._layout:
            mask[place] = term.is_one_hot
        return mask

    @cached_property
    def per_si(self) -> Floats:
        """(D,) how many of a column's unit are 1 m or 1 rad; 1 for any other unit."""
        factors = np.ones(self.width)
        for term, place in self._layout:
            factors[place] = term.field.per_si
        return factors

    @cached_property
    def start_effect(self) -> Floats:
        """(S, D) change of each column per metre by which a length at the start is moved.

        S counts the values of all `start_fields` that are lengths, in their order. Other values
        at the start, such as angles, have no row.
        """
        rows: dict[str, int] = {}
        n_rows = 0
        for name in self.start_fields:
            if self._by_name[name].unit in LENGTHS:
                rows[name] = n_rows
                n_rows += self._by_name[name].width
        effect = np.zeros((n_rows, self.width))
        for term, place in self._layout:
            for k, operand in enumerate(term.operands):
                if operand.is_at_start and operand.name in rows:
                    field, row = self._by_name[operand.name], rows[operand.name]
                    per_m = LENGTHS[field.unit] * (-1.0 if k else 1.0)
                    effect[row : row + field.width, place] = per_m * np.eye(field.width)
        return effect

    def check(self, topic_map: TopicMap, where: str) -> None:
        """Refuse a topic map that cannot give these observations.

        Args:
            topic_map: of an episode or of a robot.
            where: whose requirement it is, for the message.

        Raises:
            PolicyError: if a field is missing or has another width, unit or other phases.
        """
        for field in self.observed:
            field.check(topic_map, where)

    def from_episode(self, episode: Episode, span: Span | None = None) -> Floats:
        """Observations of the steps of an episode.

        Args:
            episode: the whole episode: its first step gives the values at the start, whatever
                the span.
            span: nanoseconds from the start stamp, inclusive, as `Episode.within` takes it;
                None: all steps.

        Returns:
            (T, D) float64 in the units of the fields, and one-hots; T steps lie in the span.

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
            values: (d,) values of each of `step_fields`, a phase as its index; other entries are
                ignored.
            start: (d,) values of each of `start_fields` in the first step of the episode.

        Returns:
            (D,) float64.

        Raises:
            PolicyError: if a field is missing, has a wrong width, is not finite or no phase.
        """
        now = {k: self._row(k, values, "observation")[None] for k in self.step_fields}
        first = {k: self._row(k, start, "first observation") for k in self.start_fields}
        row: Floats = self._assemble(now, first, 1, "step")[0]
        return row

    def _row(self, name: str, values: Mapping[str, npt.ArrayLike], where: str) -> Floats:
        if name not in values:
            raise PolicyError(f"{where}: no field {name!r}; it has {', '.join(values) or 'none'}")
        row: Floats = np.asarray(values[name], dtype=np.float64)
        width = self._by_name[name].width
        if row.shape != (width,):
            raise PolicyError(
                f"{where}: field {name!r} has shape {row.shape}, expected ({width},)"
            )
        return row

    def _assemble(
        self, values: Mapping[str, Floats], start: Mapping[str, Floats], n_steps: int, where: str
    ) -> Floats:
        out = np.empty((n_steps, self.width))
        for term, place in self._layout:
            first, *others = term.operands
            if term.is_one_hot:
                phase = values[first.name]
                out[:, place] = is_phase = phase == self._labels[first.name]
                if not is_phase.any(axis=1).all():
                    row = int(np.argmin(is_phase.any(axis=1)))
                    raise PolicyError(
                        f"{where}: phase index {phase[row, 0]} in row {row}, "
                        f"expected 0 to {len(term.field.labels) - 1}"
                    )
                continue
            result = (start if first.is_at_start else values)[first.name]
            for other in others:
                result = result - (start if other.is_at_start else values)[other.name]
            out[:, place] = result
        if not np.isfinite(out).all():
            row, column = np.argwhere(~np.isfinite(out))[0]
            raise PolicyError(
                f"{where}: {self.columns[column]} is {out[row, column]} in row {row}, "
                "expected a finite number"
            )
        return out

    def to_json(self) -> dict[str, Any]:
        """Plain data that `observation_from_json` reads back to an equal spec."""
        return {"terms": list(self.terms), "fields": [asdict(field) for field in self.observed]}


def observation_spec(terms: Sequence[str], topic_map: TopicMap, where: str) -> ObservationSpec:
    """Make a spec of terms, with widths, units and phases from a topic map.

    Args:
        terms: see `ObservationSpec`.
        topic_map: of the episodes to train on.
        where: source of the terms, for messages.

    Raises:
        PolicyError: if a term names no field, names a command, or a difference has operands of
            different widths or units.
    """
    observed = [observed_field(topic_map, name, where) for name in _names(terms)]
    try:
        return ObservationSpec(tuple(terms), tuple(observed))
    except PolicyError as err:
        raise PolicyError(f"{where}: {err}") from err


def observation_from_json(raw: object, where: str) -> ObservationSpec:
    """Check plain data and make a spec of it.

    Raises:
        PolicyError: naming the source, what was found and what was expected.
    """
    expected = "expected terms and fields with name, width, unit and labels"
    try:
        if not isinstance(raw, Mapping):
            raise TypeError
        observed = tuple(
            ObservedField(
                str(field["name"]),
                int(field["width"]),
                str(field["unit"]),
                tuple(map(str, field["labels"])),
            )
            for field in raw["fields"]
        )
        terms = tuple(map(str, raw["terms"]))
    except (KeyError, TypeError, ValueError) as err:
        raise PolicyError(f"{where}: 'observation' is {raw!r:.60}, {expected}") from err
    try:
        return ObservationSpec(terms, observed)
    except PolicyError as err:
        raise PolicyError(f"{where}: {err}") from err


def observation_from_columns(columns: Sequence[str], unit: str, where: str) -> ObservationSpec:
    """Make a spec of the names of its columns, as cards of format 1 have them.

    Args:
        columns: as `ObservationSpec.columns` gives them.
        unit: of all fields that are no phase.
        where: source of the columns, for messages.

    Raises:
        PolicyError: if the names are none of a spec.
    """
    counts: dict[str, int] = {}
    labels: dict[str, list[str]] = {}
    for column in columns:
        found = _COLUMN.fullmatch(column)
        if found is None:
            raise PolicyError(f"{where}: column {column!r}, expected a name such as tool_pose[0]")
        if found["phase"]:
            labels.setdefault(found["phase"], []).append(found["label"])
        term = found["phase"] or found["term"].removeprefix("(").removesuffix(")")
        counts[term] = counts.get(term, 0) + 1
    observed: dict[str, ObservedField] = {}
    for term, width in counts.items():
        for operand in parse_operands(term):
            phases = tuple(labels.get(operand.name, ()))
            field = ObservedField(
                operand.name, 1 if phases else width, "" if phases else unit, phases
            )
            observed.setdefault(operand.name, field)
    try:
        spec = ObservationSpec(tuple(counts), tuple(observed.values()))
    except PolicyError as err:
        raise PolicyError(f"{where}: {err}") from err
    if spec.columns != tuple(columns):
        pairs = zip(columns, spec.columns, strict=False)
        odd = next(((a, b) for a, b in pairs if a != b), (len(columns), spec.width))
        raise PolicyError(f"{where}: columns: found {odd[0]!r}, expected {odd[1]!r}")
    return spec


def _names(terms: Iterable[str]) -> list[str]:
    """Fields that terms name, each once, in their order."""
    return list(dict.fromkeys(o.name for text in terms for o in parse_operands(text)))
