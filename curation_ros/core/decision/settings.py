"""Settings of a curation: what scores, what decides, and all defaults."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from curation_ros.core.decision.rules import Rule, make_rule
from curation_ros.core.decision.salvage import DEFAULT_MARGIN_S
from curation_ros.core.errors import ConfigError
from curation_ros.core.evidence.length_control import LengthControl
from curation_ros.core.scorers import DEFAULT_SCORERS, Scorer, find_scorer


@dataclass(frozen=True)
class CurationSettings:
    """What a person may configure; the keys of `config/curation.yaml`.

    Everything is checked on construction, so that fitting never meets a name that does not exist.

    Attributes:
        scorers: names of scorers (`curation scorers` lists them); each scores every episode.
        rule: name in RULES, of one that decides.
        rule_scorer: the one of `scorers` that the rule decides by.
        length: mode of the length control.
        length_value: its value, for the modes that take one.
        scorer_params: scorer -> its hyper-parameters, where they are not the defaults.
        rule_params: hyper-parameters of the rule, where they are not the defaults.
        salvage_margin_s: a salvaged beginning ends at least this long before the episode broke,
            seconds from 0; None: nothing is salvaged.

    Raises:
        ConfigError: naming what does not exist, and what does.
    """

    scorers: Sequence[str] = DEFAULT_SCORERS
    rule: str = "evidence"
    rule_scorer: str = "gripper_timing"
    length: str = "shortest-reference"
    length_value: float | None = None
    scorer_params: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    rule_params: Mapping[str, Any] = field(default_factory=dict)
    salvage_margin_s: float | None = DEFAULT_MARGIN_S

    def __post_init__(self) -> None:
        # YAML has lists; and what the caller does with its mappings later changes nothing here.
        object.__setattr__(self, "scorers", tuple(self.scorers))
        params = {name: dict(values) for name, values in self.scorer_params.items()}
        object.__setattr__(self, "scorer_params", params)
        object.__setattr__(self, "rule_params", dict(self.rule_params))
        margin_s = self.salvage_margin_s
        if margin_s is not None and not 0.0 <= margin_s < math.inf:
            raise ConfigError(
                f"salvage_margin_s is {margin_s}, expected seconds from 0, or nothing"
            )
        self._check_names()
        for name in self.scorers:
            self.make_scorer(name)
        self.make_rule()
        self.make_length_control()

    def _check_names(self) -> None:
        if not self.scorers or len(set(self.scorers)) < len(self.scorers):
            raise ConfigError(f"scorers {list(self.scorers)}: expected names, each once")
        for name in (*self.scorers, *self.scorer_params):
            find_scorer(name)
        for name in self.scorer_params:
            if name not in self.scorers:
                raise ConfigError(
                    f"parameters for scorer {name!r}, which is none of {', '.join(self.scorers)}"
                )
        if self.rule_scorer not in self.scorers:
            raise ConfigError(
                f"rule_scorer {self.rule_scorer!r} is none of the scorers "
                f"{', '.join(self.scorers)}"
            )

    def make_scorer(self, name: str) -> Scorer:
        """One of the scorers, not fitted."""
        params = self.scorer_params.get(name, {})
        known = find_scorer(name)().params()
        for key, value in params.items():
            if key not in known:
                known_names = ", ".join(known) or "none"
                raise ConfigError(
                    f"scorer {name!r} has no parameter {key!r}; it has {known_names}"
                )
            if not _fits(value, known[key]):
                raise ConfigError(
                    f"scorer {name!r}: {key} is {value!r}, expected one like {known[key]!r}"
                )
        scorer = find_scorer(name)(**params)
        scorer.check_params()
        return scorer

    def make_rule(self) -> Rule:
        """The rule, not fitted."""
        rule = make_rule(self.rule, self.rule_scorer, self.rule_params)
        if not rule.decides:
            raise ConfigError(f"rule {self.rule!r}: {rule.instead}")
        return rule

    def make_length_control(self) -> LengthControl:
        """The length control, not fitted."""
        return LengthControl(self.length, self.length_value)


def _fits(value: object, default: object) -> bool:
    """Whether a value is of the kind of a default: the text 'False' is no bool."""
    if isinstance(default, bool) or isinstance(value, bool):
        return isinstance(default, bool) and isinstance(value, bool)
    if isinstance(default, float):
        return isinstance(value, (int, float))
    return isinstance(value, type(default))
