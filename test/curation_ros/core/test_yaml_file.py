from __future__ import annotations

from pathlib import Path

import pytest

from curation_ros.core.errors import ConfigError
from curation_ros.core.yaml_file import read_yaml


def test_a_file_is_plain_data(tmp_path: Path) -> None:
    path = tmp_path / "some.yaml"
    path.write_text("a: [1, 2.5]\nb: yes\n")
    assert read_yaml(path, "config") == {"a": [1, 2.5], "b": True}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"a: 1\nb: [", r"config .*some\.yaml is not YAML, line 2: "),
        (b"\xff\xfe\x00", r"config .*some\.yaml is not YAML"),
        (b"a: 2020-13-45", r"some\.yaml is not YAML: month must be in 1"),
        (
            b"a: !!python/object:os.system x",
            r"some\.yaml is not YAML, line 1: could not",
        ),
    ],
)
def test_what_is_not_yaml_is_refused_with_file_and_line(
    tmp_path: Path, content: bytes, said: str
) -> None:
    path = tmp_path / "some.yaml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=said) as refused:
        read_yaml(path, "config")
    assert "\n" not in str(refused.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"config .*none\.yaml: No such file"):
        read_yaml(tmp_path / "none.yaml", "config")
