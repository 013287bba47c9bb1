"""Files that configure a run: the topic map, the settings of a curation, the reference."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from curation_ros.core.decision.rules import RULES, Rule, given_params
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap, read_topic_map
from curation_ros.core.errors import ConfigError
from curation_ros.core.yaml_file import read_yaml
from curation_ros.dataset.episodes import find_episodes, read_episode

_WHAT = "curation config"
_SOURCE = Path(__file__).resolve().parents[1]
#: What YAML must hold for each field of CurationSettings.
_KINDS: dict[str, tuple[type | tuple[type, ...], str]] = {
    "scorers": (list, "a list"),
    "rule": (str, "a name"),
    "rule_scorer": (str, "a name"),
    "length": (str, "a name"),
    "length_value": ((int, float, type(None)), "a number"),
    "scorer_params": (dict, "a mapping"),
    "rule_params": (dict, "a mapping"),
    "salvage_margin_s": ((int, float, type(None)), "a number of seconds, or null"),
}


def share_file(relative: str) -> Path:
    """A file of this package's share folder: of the source tree, or of an installation.

    Raises:
        ConfigError: if it is in neither.
    """
    # Both pip and colcon install into <prefix>/lib/python3.x/site-packages. The prefix need not be
    # sys.prefix: a colcon workspace lies over an environment.
    share = Path("share") / "curation_ros" / relative
    for candidate in (_SOURCE / relative, *(folder / share for folder in _SOURCE.parents)):
        if candidate.is_file():
            return candidate
    raise ConfigError(f"{relative}: neither in {_SOURCE} nor in {share} of a folder above it")


def topic_map_or_default(path: str) -> TopicMap:
    """The topic map of a file, or that of the LIBERO robot for an empty path.

    Raises:
        ConfigError: if the file cannot be read, or is not a topic map.
    """
    return read_topic_map(Path(path) if path else share_file("config/topics.yaml"))


def read_settings(config: Path | None, overrides: Mapping[str, Any]) -> CurationSettings:
    """Settings from a YAML file, and what a caller sets in addition.

    Args:
        config: `config/curation.yaml` or one like it; None takes the defaults.
        overrides: fields of CurationSettings that win over the file; empty values do not. Scorers
            that decide are added to `scorers` that lack them.

    Raises:
        ConfigError: naming file and key.
    """
    where = f"{_WHAT} {config}"
    settings = {} if config is None else _read_file(config, where)
    given = {k: v for k, v in overrides.items() if v not in (None, "", (), [], {})}
    if given.get("rule", settings.get("rule")) != settings.get("rule"):
        settings.pop("rule_params", None)  # they are of the rule of the file
    settings.update(given)
    if "scorers" in given or "rule_scorer" in given:
        defaults = CurationSettings()
        names = list(settings.get("scorers", defaults.scorers))
        if settings.get("rule") == "none" and "rule_scorer" not in given:
            settings["rule_scorer"] = names[0]  # nothing decides
        rule = RULES.get(settings.get("rule", defaults.rule), Rule)
        needed = [*rule.consults, settings.get("rule_scorer", defaults.rule_scorer)]
        settings["scorers"] = [*names, *(n for n in needed if n not in names)]
    try:
        return CurationSettings(**settings)
    except ConfigError as err:
        raise ConfigError(f"{where}: {err}" if config and not given else str(err)) from err


def settings_of(
    config: Path | None = None,
    *,
    scorers: Iterable[str] = (),
    rule: str = "",
    rule_scorer: str = "",
    value: float | None = None,
    method: str = "",
) -> CurationSettings:
    """Settings from what a person asks for on a command line or in a call.

    Args:
        config: a file like `config/curation.yaml`; None: that one.
        scorers: names, in addition to the scorer that decides; none: those of the file.
        rule: name of the rule; empty: that of the file.
        rule_scorer: the scorer that decides; empty: that of the file.
        value: the threshold, share or number of `rule`.
        method: how the rule `gap` separates groups.

    Raises:
        ConfigError: naming what does not exist or does not fit.
    """
    given: dict[str, Any] = {"scorers": list(scorers), "rule": rule, "rule_scorer": rule_scorer}
    if rule:
        given["rule_params"] = given_params(rule, value, method)
    elif value is not None or method:
        raise ConfigError("a value or a method belongs to a rule: name one")
    return read_settings(config or share_file("config/curation.yaml"), given)


def _read_file(config: Path, where: str) -> dict[str, Any]:
    raw = read_yaml(config, _WHAT)
    if not isinstance(raw, dict):
        raise ConfigError(f"{where}: expected a mapping, found {raw!r:.60}")
    for key, value in raw.items():
        if key not in _KINDS:
            raise ConfigError(f"{where}: unknown key {key!r}; known are {', '.join(_KINDS)}")
        kind, text = _KINDS[key]
        if not isinstance(value, kind) or isinstance(value, bool):
            raise ConfigError(f"{where}: {key!r} is {value!r:.60}, expected {text}")
    for key in ("scorers", "scorer_params"):
        if not all(isinstance(name, str) for name in raw.get(key, ())):
            raise ConfigError(f"{where}: {key!r} is {raw[key]!r:.60}, expected names of scorers")
    for name, params in raw.get("scorer_params", {}).items():
        if not isinstance(params, dict):
            raise ConfigError(
                f"{where}: parameters of {name!r} are {params!r:.60}: expected a mapping"
            )
        if not all(isinstance(key, str) for key in params):
            raise ConfigError(
                f"{where}: parameters of {name!r} are {params!r:.60}: expected names; "
                "quote 'on', which YAML reads as true"
            )
    return raw


def read_reference(paths: Sequence[Path], topic_map: TopicMap | None) -> list[Episode]:
    """Read the reference demonstrations.

    Args:
        paths: datasets or bags.
        topic_map: the one that the scored episodes are built by; None: that of each bag.

    Raises:
        CurationError: if one cannot be read, or there is none.
    """
    episodes = [read_episode(bag, topic_map) for bag in find_episodes(paths)]
    if not episodes:
        raise ConfigError(f"reference {', '.join(map(str, paths))}: no episode in it")
    return episodes
