"""Rule `gap`: two groups, one group, and what lies between them."""

from __future__ import annotations

import numpy as np
import pytest
from cases import case, kept, verdicts

from curation_ros.core.decision.rules.gap import Gap
from curation_ros.core.errors import ConfigError, EpisodeError


def in_two_groups(n_low: int = 16, n_high: int = 8) -> dict[str, float]:
    rng = np.random.default_rng(3)
    low, high = rng.normal(0.4, 0.02, n_low), rng.normal(0.9, 0.02, n_high)
    return {f"e{k:02d}": float(x) for k, x in enumerate([*low, *high])}


@pytest.mark.parametrize("method", ["mixture", "largest-gap"])
def test_two_groups_are_kept_and_discarded(method: str) -> None:
    scores = in_two_groups()
    rule = Gap(scorer="s", method=method).fit_dataset(scores, resolution=0.01)
    assert kept(rule, scores) == {f"e{k:02d}" for k in range(16, 24)}
    assert set(verdicts(rule, scores).values()) == {"keep", "discard"}
    assert rule.verdict(case(0.9))[1].startswith("s 0.90 is in the upper group, 8 of 24")
    assert 0.45 < (rule.cut or 0) < 0.85
    assert rule.no_basis == ""


def test_score_between_the_groups_is_for_review() -> None:
    rng = np.random.default_rng(0)
    x = [*rng.normal(0.0, 1.0, 40), *rng.normal(7.0, 1.0, 40)]
    rule = Gap(scorer="s").fit_dataset({f"{k}": float(v) for k, v in enumerate(x)})
    low, high = rule.doubt_
    assert low < high
    verdict, reason = rule.verdict(case((low + high) / 2))
    assert (verdict, "between the two groups" in reason) == ("review", True)
    assert rule.verdict(case(high))[0] == "keep"
    assert rule.verdict(case(low))[0] == "discard"


@pytest.mark.parametrize("method", ["mixture", "largest-gap"])
@pytest.mark.parametrize("kind", ["normal", "equal", "few"])
def test_one_group_is_for_review_with_the_reason(method: str, kind: str) -> None:
    rng = np.random.default_rng(1)
    values = {"normal": rng.normal(size=60), "equal": np.ones(60), "few": np.array([0.0] * 8)}
    scores = {f"{k}": float(v) for k, v in enumerate(values[kind])}
    rule = Gap(scorer="s", method=method).fit_dataset(scores, resolution=0.01)
    verdict, reason = rule.verdict(case(scores["0"]))
    assert verdict == "review"
    assert "no two groups" in reason
    assert rule.no_basis == reason


def test_fewer_than_eight_scores_are_refused() -> None:
    with pytest.raises(EpisodeError, match="needs 8 scored episodes; there are 7"):
        Gap(scorer="s").fit_dataset({f"{k}": float(k) for k in range(7)})


def test_unknown_method_is_refused() -> None:
    with pytest.raises(
        ConfigError, match="method is 'otsu', expected one of mixture, largest-gap"
    ):
        Gap(scorer="s", method="otsu").check_params()
