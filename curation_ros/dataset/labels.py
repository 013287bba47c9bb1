"""Labels of episodes in the truth of a dataset: for evaluation only."""

from __future__ import annotations

from curation_ros.dataset.dataset import Dataset

#: Kind of label -> where it comes from and which value means good. An episode that was given up
#: has neither succeeded nor failed, so it has no label `success`.
LABELS: dict[str, str] = {
    "success": "outcome: the simulator's check or a person's button; good is 'succeeded'",
    "defect": "injected defect; good is 'none'",
}


def read_labels(dataset: Dataset, kind: str) -> dict[str, bool]:
    """Read the labels of a dataset.

    Args:
        dataset: its truth is read.
        kind: one of LABELS.

    Returns:
        Episode id -> whether the episode is good, for episodes with such a label.
    """
    labels: dict[str, bool] = {}
    for episode_id, truth in dataset.truth().items():
        if kind == "success":
            if truth.get("outcome") in ("succeeded", "failed"):
                labels[episode_id] = truth["outcome"] == "succeeded"
        elif isinstance(truth.get("defect"), str) and truth["defect"]:
            labels[episode_id] = truth["defect"] == "none"
    return labels
