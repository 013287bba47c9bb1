"""YAML as the metadata of rosbag2 needs it, through libyaml where PyYAML has it: far faster."""

from __future__ import annotations

from typing import Any

import yaml

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def load_yaml(text: str | bytes) -> Any:
    """Plain data of a YAML text.

    Raises:
        ValueError: if it is not YAML.
    """
    try:
        return yaml.load(text, Loader=_LOADER)  # a safe loader, either way
    except yaml.YAMLError as err:
        raise ValueError(f"not YAML: {str(err).splitlines()[0]}") from err


def dump_yaml(data: Any) -> str:
    """YAML text of plain data, keys in their order.

    Lines are never folded: that is legal, but not every reader of rosbag2 metadata unfolds them.
    """
    text = yaml.dump(data, Dumper=_DUMPER, sort_keys=False, width=2**30, allow_unicode=True)
    return str(text)
