"""What a policy observes: columns of an episode's fields, alike for episodes and single steps."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import AT_START, FieldSpec, TopicMap
from curation_ros.core.errors import PolicyError
from curation_ros.core.types import Floats, Span

_MINUS = " - "
_COMMANDS = ("action", "gripper")
#: How many of a unit are 1 m or 1 rad.
_LENGTHS = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
_PER_SI = {**_LENGTHS, "rad": 1.0, "deg": math.degrees(1.0)}
_COLUMN = re.compile(r"(?P<term>.+)\[[0-9]+\]|(?P<phase>[^=]+)=(?P<label>.+)")


@dataclass(frozen=True)
class ObservedField:
    """A field of the topic map as a policy was trained on it.

    Attributes:
        name: of the field.
        width: number of values D.
        unit: of the values.
        labels: names of the phases where the field is a phase, else empty. A phase is one value,
            the index of its name, and becomes a one-hot.
    """

    name: str
    width: int
    unit: str = ""
    labels: tuple[str, ...] = ()


@dataclass(frozen=True)
class Operand:
    """A field in a term: its value in each step, or its first value of the episode."""

    name: str
    is_at_start: bool


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
        named = dict.fromkeys(operand.name for term in self.terms for operand in operands(term))
        if list(named) != [field.name for field in self.observed]:
            found = ", ".join(field.name for field in self.observed) or "none"
            raise PolicyError(
                f"the terms name {', '.join(named)}, the observed fields are {found}"
            )
        for term in self.terms:
            self._check_term(term)

    def _check_term(self, term: str) -> None:
        parts = operands(term)
        first = self._field(parts[0].name)
        if first.width < 1:
            raise PolicyError(f"observation {term!r}: field {first.name!r} has no values")
        if any(self._field(part.name).labels for part in parts):
            if len(parts) > 1 or parts[0].is_at_start or first.width != 1:
                raise PolicyError(
                    f"observation {term!r}: a phase has one value and stands alone, without "
                    f"{AT_START} and differences"
                )
            return
        for part in parts[1:]:
            other = self._field(part.name)
            if (other.width, _unit(other.unit)) != (first.width, _unit(first.unit)):
                raise PolicyError(
                    f"observation {term!r}: {first.name!r} has {first.width} values in "
                    f"{first.unit!r}, {other.name!r} has {other.width} in {other.unit!r}; a "
                    "difference needs equal units and widths"
                )

    @cached_property
    def _by_name(self) -> dict[str, ObservedField]:
        return {field.name: field for field in self.observed}

    def _field(self, name: str) -> ObservedField:
        return self._by_name[name]

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Name of every column, such as `eef_position[0]` or `phase=LIFT`."""
        names: list[str] = []
        for term in self.terms:
            field = self._field(operands(term)[0].name)
            shown = f"({term})" if _MINUS in term else term
            if field.labels:
                names += [f"{term}={label}" for label in field.labels]
            else:
                names += [f"{shown}[{k}]" for k in range(field.width)]
        return tuple(names)

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
        return self._named(at_start=True)

    @cached_property
    def step_fields(self) -> tuple[str, ...]:
        """Those of `fields` whose value in every step is needed."""
        return self._named(at_start=False)

    def _named(self, *, at_start: bool) -> tuple[str, ...]:
        parts = itertools.chain.from_iterable(map(operands, self.terms))
        return tuple(dict.fromkeys(p.name for p in parts if p.is_at_start == at_start))

    @cached_property
    def is_one_hot(self) -> npt.NDArray[np.bool_]:
        """(D,) bool: columns of a one-hot, which are not standardised."""
        mask = np.zeros(self.width, dtype=bool)
        for parts, place in self._layout:
            mask[place] = bool(self._field(parts[0].name).labels)
        return mask

    @cached_property
    def per_si(self) -> Floats:
        """(D,) how many of a column's unit are 1 m or 1 rad; 1 for any other unit."""
        factors = np.ones(self.width)
        for parts, place in self._layout:
            factors[place] = _PER_SI.get(self._field(parts[0].name).unit, 1.0)
        return factors

    @cached_property
    def start_effect(self) -> Floats:
        """(S, D) change of each column per metre by which a length at the start is moved.

        S counts the values of all `start_fields` that are lengths, in their order. Other values
        at the start, such as angles, have no row.
        """
        lengths = [self._field(name) for name in self.start_fields]
        lengths = [field for field in lengths if field.unit in _LENGTHS]
        first_rows = dict(
            zip(
                (field.name for field in lengths),
                itertools.accumulate((field.width for field in lengths), initial=0),
                strict=False,
            )
        )
        effect = np.zeros((sum(field.width for field in lengths), self.width))
        for parts, place in self._layout:
            for k, part in enumerate(parts):
                if part.is_at_start and part.name in first_rows:
                    field, row = self._field(part.name), first_rows[part.name]
                    per_m = _LENGTHS[field.unit] * (-1.0 if k else 1.0)
                    effect[row : row + field.width, place] = per_m * np.eye(field.width)
        return effect

    @cached_property
    def _layout(self) -> tuple[tuple[tuple[Operand, ...], slice], ...]:
        """Operands of each term, and the columns that it fills."""
        places: list[tuple[tuple[Operand, ...], slice]] = []
        first = 0
        for term in self.terms:
            parts = operands(term)
            field = self._field(parts[0].name)
            width = len(field.labels) or field.width
            places.append((parts, slice(first, first + width)))
            first += width
        return tuple(places)

    @cached_property
    def _labels(self) -> dict[str, npt.NDArray[np.int_]]:
        """Indices of the phases of each field that is one."""
        return {f.name: np.arange(len(f.labels)) for f in self.observed if f.labels}

    def check(self, topic_map: TopicMap, where: str) -> None:
        """Refuse a topic map that cannot give these observations.

        Args:
            topic_map: of an episode or of a robot.
            where: whose requirement it is, for the message.

        Raises:
            PolicyError: if a field is missing or has another width, unit or other phases.
        """
        for wanted in self.observed:
            found = _field_of(topic_map, wanted.name, where)
            if found.labels != wanted.labels:
                raise PolicyError(
                    f"{where}: the topic map's phases are {', '.join(found.labels) or 'none'}, "
                    f"expected {', '.join(wanted.labels) or 'none'}"
                )
            if len(found.values) != wanted.width:
                raise PolicyError(
                    f"{where}: field {wanted.name!r} of the topic map has {len(found.values)} "
                    f"values, expected {wanted.width}"
                )
            if not wanted.labels and _unit(found.unit) != _unit(wanted.unit):
                raise PolicyError(
                    f"{where}: field {wanted.name!r} of the topic map is in {found.unit!r}, "
                    f"expected {wanted.unit!r}"
                )

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
        width = self._field(name).width
        if row.shape != (width,):
            raise PolicyError(
                f"{where}: field {name!r} has shape {row.shape}, expected ({width},)"
            )
        return row

    def _assemble(
        self, values: Mapping[str, Floats], start: Mapping[str, Floats], n_steps: int, where: str
    ) -> Floats:
        out = np.empty((n_steps, self.width))
        for parts, place in self._layout:
            first, *others = parts
            if first.name in self._labels:
                phases = self._labels[first.name]
                out[:, place] = is_phase = values[first.name] == phases
                if not is_phase.any(axis=1).all():
                    row = int(np.argmin(is_phase.any(axis=1)))
                    raise PolicyError(
                        f"{where}: phase index {values[first.name][row, 0]} in row {row}, "
                        f"expected 0 to {len(phases) - 1}"
                    )
                continue
            term = (start if first.is_at_start else values)[first.name]
            for other in others:
                term = term - (start if other.is_at_start else values)[other.name]
            out[:, place] = term
        if not np.isfinite(out).all():
            row, column = np.argwhere(~np.isfinite(out))[0]
            raise PolicyError(
                f"{where}: {self.columns[column]} is {out[row, column]} in row {row}, "
                "expected a finite number"
            )
        return out

    def to_json(self) -> dict[str, Any]:
        """Plain data that `observation_from_json` reads back to an equal spec."""
        return {
            "terms": list(self.terms),
            "fields": [
                {"name": f.name, "width": f.width, "unit": f.unit, "labels": list(f.labels)}
                for f in self.observed
            ],
        }


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
    names = dict.fromkeys(operand.name for term in terms for operand in operands(term))
    observed = []
    for name in names:
        spec = _field_of(topic_map, name, where)
        if spec.role in _COMMANDS:
            raise PolicyError(
                f"{where}: field {name!r} has role {spec.role}: a policy gives commands and "
                "cannot observe them"
            )
        observed.append(ObservedField(name, len(spec.values), spec.unit, spec.labels))
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
        for operand in operands(term):
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


def operands(term: str) -> tuple[Operand, ...]:
    """Fields of a term, the first one minus the others."""
    parts = (text.strip() for text in term.split(_MINUS))
    return tuple(Operand(text.removesuffix(AT_START), text.endswith(AT_START)) for text in parts)


def _field_of(topic_map: TopicMap, name: str, where: str) -> FieldSpec:
    spec = topic_map.fields.get(name)
    if spec is None:
        raise PolicyError(
            f"{where}: the topic map has no field {name!r}; it has "
            f"{', '.join(topic_map.fields) or 'none'}"
        )
    return spec


def _unit(unit: str) -> str:
    """Topic maps write no unit as an empty text or as 1."""
    return unit or "1"
