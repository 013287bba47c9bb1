from __future__ import annotations

import pytest

from curation_ros.core.errors import PolicyError
from policy_node.settings import TrainingSettings


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"steps": 0}, "steps"),
        ({"batch_size": 0}, "batch_size"),
        ({"hidden": (16, 0)}, "hidden"),
        ({"hidden": ()}, "hidden"),
        ({"lr": 0.0}, "lr"),
        ({"lr": float("nan")}, "lr"),
        ({"std_floor": 0.0}, "std_floor"),
        ({"weight_decay": -1.0}, "weight_decay"),
        ({"start_jitter_m": -1.0}, "start_jitter_m"),
    ],
)
def test_setting_out_of_range_is_refused(settings, word):
    with pytest.raises(PolicyError, match=f"training: {word} is"):
        TrainingSettings(**settings)
