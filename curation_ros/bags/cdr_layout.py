"""The layout of CDR messages that look alike: where NumPy reads the values of all of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from curation_ros.bags.cdr_walk import SIZES, Leaf, Walk
from curation_ros.bags.definitions import TEXTS

_TEXT_CODES = frozenset(TEXTS.values())


class Run(NamedTuple):
    """Numbers that lie side by side, for columns that stand side by side."""

    code: str
    at: int
    column: int
    n_columns: int


class Layout:
    """What one walked message says about all that look alike.

    Blocks of messages are (n, width) bytes, `width` the length rounded up to whole words.
    """

    def __init__(self, walk: Walk, leaves: Sequence[Leaf]) -> None:
        self.order = walk.order
        length = len(walk.data)
        mask = np.zeros(padded_width(length), dtype=np.uint8)
        for start, stop in walk.structure:
            mask[start:stop] = 0xFF
        expected = np.zeros(padded_width(length), dtype=np.uint8)
        expected[:length] = np.frombuffer(walk.data, np.uint8)
        self._mask = mask.view(np.uint64)
        self._expected = expected.view(np.uint64)
        self.runs: list[Run] = []
        self.texts: list[tuple[int, Leaf]] = []
        for column, leaf in enumerate(leaves):
            if leaf.code in _TEXT_CODES:
                self.texts.append((column, leaf))
                continue
            last = self.runs[-1] if self.runs else Run("", -1, -1, 0)
            follows = (leaf.code, leaf.at, column) == (
                last.code,
                last.at + last.n_columns * SIZES.get(last.code, 0),
                last.column + last.n_columns,
            )
            if follows:
                self.runs[-1] = last._replace(n_columns=last.n_columns + 1)
            else:
                self.runs.append(Run(leaf.code, leaf.at, column, 1))

    def differing(self, block: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_] | None:
        """(n,) which messages of a block have another layout; None: none has."""
        wrong = (block.view(np.uint64) ^ self._expected) & self._mask
        if not wrong.any():
            return None
        return np.asarray(wrong.any(axis=1))

    def numbers(self, block: npt.NDArray[np.uint8], run: Run) -> npt.NDArray[np.generic]:
        """(n, n_columns) values of a run, of their own type, in a view of the block."""
        code = "u1" if run.code == "?" else self.order + run.code
        shape, strides = (len(block), run.n_columns), (block.shape[1], SIZES[run.code])
        values: npt.NDArray[np.generic] = np.ndarray(shape, code, block, run.at, strides)
        return values != 0 if run.code == "?" else values

    @staticmethod
    def text(block: npt.NDArray[np.uint8], leaf: Leaf) -> npt.NDArray[np.bytes_]:
        """(n,) UTF-8 bytes at a leaf, in a view of the block."""
        if not leaf.length:
            return np.zeros(len(block), dtype="S1")
        strides = (block.shape[1],)
        texts: npt.NDArray[np.bytes_] = np.ndarray(
            (len(block),), f"S{leaf.length}", block, leaf.at, strides
        )
        return texts


def padded_width(length: int) -> int:
    """Length of a message in whole words of 8 bytes."""
    return -(-length // 8) * 8
