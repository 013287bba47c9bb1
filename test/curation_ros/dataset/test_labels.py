from __future__ import annotations

from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.labels import read_labels


def test_labels_are_read_from_the_field_that_is_named(dataset: Dataset) -> None:
    for episode, truth in {
        "a": {"outcome": "succeeded", "defect": "none"},
        "b": {"outcome": "succeeded", "defect": "early_release"},
        "c": {"outcome": "failed"},
        "d": {"outcome": "aborted", "defect": "none"},
        "e": {"steps": 3},
    }.items():
        dataset.append_truth({"episode": episode, **truth})
    assert read_labels(dataset, "success") == {"a": True, "b": True, "c": False}
    assert read_labels(dataset, "defect") == {"a": True, "b": False, "d": True}
