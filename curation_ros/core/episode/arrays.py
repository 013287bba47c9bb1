"""Arrays that never were in a bag: checked, and joined as samples of a bag are."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from curation_ros.core.episode.findings import Finding
from curation_ros.core.episode.joining import (
    Joined,
    TopicSamples,
    Window,
    join_topics,
    label_indices,
    ordered_samples,
)
from curation_ros.core.episode.stream import Stamps
from curation_ros.core.episode.topic_map import FieldSpec, TopicMap, topic_map_from_json
from curation_ros.core.errors import ConfigError, EpisodeError
from curation_ros.core.types import NS_PER_S, Floats

# The message type that a field of a drafted map would have on a graph.
_ARRAY_TYPE = "std_msgs/msg/Float64MultiArray"
_LABEL_TYPE = "std_msgs/msg/String"


def draft_topic_map(
    fields: Mapping[str, npt.ArrayLike],
    roles: Mapping[str, str],
    *,
    phases: Sequence[str] = (),
    gripper: Mapping[str, object] | None = None,
) -> TopicMap:
    """Draft a topic map for arrays that have no topics.

    Each field gets a topic of its own name. State and action are those that scorers expect: the
    state has the effector, the observations, the phase and the first pose of each object, and the
    action has the actions and the gripper command.

    Args:
        fields: name -> (T, D) or (T,) array; only D counts.
        roles: name -> one of ROLES, for every field.
        phases: names of the phases in their order, for a field with the role `phase`.
        gripper: `opens`, `kind`, `open_value`, `closed_value` and `fingers` as in a topic map, for
            a field with the role `gripper`; None: what its numbers mean is not known.

    Returns:
        The map. Its clock is the first field with the role clock, else effector, else any.

    Raises:
        ConfigError: naming a field without a role, a role without a field, or what is wrong.

    Example:
        >>> import numpy as np
        >>> fields = {"hand": np.zeros((9, 3)), "velocity": np.zeros((9, 3))}
        >>> topic_map = draft_topic_map(fields, {"hand": "effector", "velocity": "action"})
        >>> topic_map.clock, topic_map.state, topic_map.action
        ('hand', ('hand',), ('velocity',))
    """
    for name in fields:
        if name not in roles:
            raise ConfigError(f"roles: none for the field {name!r}; roles has {_list(roles)}")
    for name in roles:
        if name not in fields:
            raise ConfigError(f"roles: {name!r} is no field; there are {_list(fields)}")
    by_role: dict[str, list[str]] = {}
    for name, role in roles.items():
        by_role.setdefault(role, []).append(name)
    clocks = [*by_role.get("clock", ()), *by_role.get("effector", ()), *fields]
    raw: dict[str, object] = {
        "fields": {name: _drafted(name, fields[name], roles[name], phases) for name in fields},
        "clock": clocks[0] if clocks else None,
        "state": [
            *(n for n, role in roles.items() if role in ("effector", "observation", "phase")),
            *(f"{n}@start" for n in by_role.get("object", ())),
        ],
        "action": [n for n, role in roles.items() if role in ("action", "gripper")],
    }
    if gripper is not None:
        commands = by_role.get("gripper", [])
        if len(commands) != 1:
            raise ConfigError(f"gripper: {len(commands)} fields have the role gripper, expected 1")
        raw["gripper"] = {"field": commands[0], **gripper}
    return topic_map_from_json(raw, "drafted topic map")


def _drafted(
    name: str, values: npt.ArrayLike, role: str, phases: Sequence[str]
) -> dict[str, object]:
    if role == "phase":
        if not phases:
            raise ConfigError(f"field {name!r} is a phase: give the names of the phases")
        return {
            "topic": name,
            "type": _LABEL_TYPE,
            "role": role,
            "values": ["data"],
            "labels": list(phases),
            "stamp": "source",
        }
    shape = np.shape(values)
    width = shape[1] if len(shape) == 2 else 1
    paths = [f"data.{k}" for k in range(width)]
    return {
        "topic": name,
        "type": _ARRAY_TYPE,
        "role": role,
        "values": paths,
        "stamp": "source",
    }


def clock_stamps(
    n_steps: int, stamps_ns: npt.ArrayLike | None, rate_hz: float | None, window: Window | None
) -> Stamps:
    """(T,) stamps of the steps, as given or by a rate.

    Args:
        n_steps: T.
        stamps_ns: (T,) integers; exclusive with `rate_hz`.
        rate_hz: steps per second. The first step is at the beginning of the window, else at 0.
        window: first and last stamp of the episode, or None.

    Raises:
        EpisodeError: if both or none are given, or one makes no sense.
    """
    if (stamps_ns is None) == (rate_hz is None):
        raise EpisodeError("arrays: expected either stamps_ns or rate_hz")
    if window is not None and not 0 <= window[0] <= window[1]:
        raise EpisodeError(f"arrays: window is {window}, expected two stamps in their order")
    if rate_hz is not None:
        if not 0 < rate_hz < math.inf:
            raise EpisodeError(f"arrays: rate_hz is {rate_hz}, expected a positive number")
        offsets: Stamps = np.rint(np.arange(n_steps) * (NS_PER_S / rate_hz)).astype(np.int64)
        return offsets if window is None else offsets + window[0]
    given = np.asarray(stamps_ns)
    if given.shape != (n_steps,) or given.dtype.kind not in "iu":
        raise EpisodeError(
            f"arrays: stamps_ns has shape {given.shape} and type {given.dtype}, expected "
            f"({n_steps},) integers (nanoseconds)"
        )
    if n_steps and not 0 <= int(given.min()) <= int(given.max()) < 1 << 63:
        raise EpisodeError(
            f"arrays: stamps_ns are from {given.min()} to {given.max()}, expected 0 to 2**63 - 1"
        )
    return given.astype(np.int64)


def n_rows(fields: Mapping[str, npt.ArrayLike]) -> int:
    """Number of rows T that all arrays have.

    Raises:
        EpisodeError: if they differ, or there is no array.
    """
    lengths: dict[str, int] = {}
    for name, values in fields.items():
        try:
            lengths[name] = len(np.asarray(values))
        except (TypeError, ValueError) as err:
            raise EpisodeError(f"arrays: field {name!r} is no array of rows: {err}") from err
    if len(set(lengths.values())) != 1:
        text = ", ".join(f"{name} {n}" for name, n in lengths.items()) or "no field"
        raise EpisodeError(f"arrays: expected fields with the same number of rows, found {text}")
    return next(iter(lengths.values()))


def join_arrays(
    fields: Mapping[str, npt.ArrayLike],
    topic_map: TopicMap,
    stamps_ns: Stamps,
    window: Window,
    findings: Sequence[Finding] = (),
) -> Joined:
    """Join arrays on their common clock, with the findings that samples of them would have.

    Args:
        fields: name -> (T, D) or (T,) numbers; a phase has (T,) labels, or their indices in the
            map with -1 for unknown.
        topic_map: it has exactly these fields.
        stamps_ns: (T,) stamps of the rows.
        window: first and last stamp; rows outside are left out.
        findings: what the caller knows in addition.

    Raises:
        EpisodeError: naming a field that is missing, unknown, or of a wrong shape or type.
    """
    for name in fields:
        if name not in topic_map.fields:
            raise EpisodeError(
                f"arrays: field {name!r} is not in the topic map; it has {_list(topic_map.fields)}"
            )
    for name in topic_map.fields:
        if name not in fields:
            raise EpisodeError(f"arrays: no field {name!r}; there are {_list(fields)}")
    topics = {}
    for topic in topic_map.topics:
        specs = [spec for spec in topic_map.fields.values() if spec.topic == topic]
        topics[topic] = _samples_of(specs, fields, stamps_ns, window)
    return join_topics(topic_map, topics, window, findings=findings)


def _samples_of(
    specs: Sequence[FieldSpec],
    fields: Mapping[str, npt.ArrayLike],
    stamps_ns: Stamps,
    window: Window,
) -> TopicSamples:
    """The fields of one topic side by side, as if each row had been a message."""
    unknown: dict[str, int] = {}
    by_path: dict[str, Floats] = {}
    for spec in specs:
        values = _values_of(spec, fields[spec.name], stamps_ns, unknown)
        for path, column in zip(spec.values, values.T, strict=True):
            if not np.array_equal(by_path.setdefault(path, column), column, equal_nan=True):
                raise EpisodeError(
                    f"arrays: field {spec.name!r} has other values at {path!r} of topic "
                    f"{spec.topic!r} than another field"
                )
    return ordered_samples(
        {path: k for k, path in enumerate(by_path)},
        stamps_ns,
        np.arange(len(stamps_ns)),
        np.column_stack([*by_path.values()]),
        window,
        unknown=unknown,
    )


def _values_of(
    spec: FieldSpec, given: npt.ArrayLike, stamps_ns: Stamps, unknown: dict[str, int]
) -> Floats:
    """(T, D) numbers of a field; labels that are not in the map are noted in `unknown`."""
    array = np.asarray(given)
    if array.ndim == 1:
        array = array[:, None]
    if array.shape != (len(stamps_ns), len(spec.values)):
        raise EpisodeError(
            f"arrays: field {spec.name!r} has shape {array.shape}, expected "
            f"({len(stamps_ns)}, {len(spec.values)})"
        )
    if spec.labels and array.dtype.kind == "U":
        return label_indices(array[:, 0], spec.labels, stamps_ns, unknown)[:, None]
    if array.dtype.kind not in "fiub":
        raise EpisodeError(f"arrays: field {spec.name!r} has {array.dtype}, expected numbers")
    values = np.array(array, dtype=np.float64)
    if spec.labels and not np.isin(values, np.arange(-1, len(spec.labels))).all():
        raise EpisodeError(
            f"arrays: phase {spec.name!r} has other values than -1 to {len(spec.labels) - 1}"
        )
    return values


def _list(names: Mapping[str, object]) -> str:
    return ", ".join(names) or "none"
