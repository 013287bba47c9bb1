"""Errors of bags, below `curation_ros.core.errors.BagError`."""

from __future__ import annotations

from pathlib import Path

from curation_ros.core.errors import BagError


class TornFileError(BagError):
    """The file begins as MCAP, but ends or is damaged before its end; `reason` says where."""

    def __init__(self, path: Path, reason: str, finding: str = "malformed") -> None:
        super().__init__(
            f"{path} is truncated or damaged: {reason}; `curation recover` saves what it "
            "still holds; what an interrupted recording has left, the next recorder does",
            finding=finding,
        )
        self.path = path
        self.reason = reason

    def __reduce__(self) -> tuple[type[TornFileError], tuple[Path, str, str]]:
        # Workers send it to their parent: without this it would be made of its message.
        return type(self), (self.path, self.reason, self.finding)
