"""Rules of a protocol as named checks: each rule is a sentence, and its breach says how."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Generic, TypeVar

from curation_ros.core.errors import CurationError

Case = TypeVar("Case")


class Rules(dict[str, Callable[[Case], None]], Generic[Case]):
    """Sentence -> its check, which raises an AssertionError; in the order of definition."""

    def rule(self, sentence: str) -> Callable[[Callable[[Case], None]], Callable[[Case], None]]:
        """Decorator that adds a check under its sentence."""

        def add(check: Callable[[Case], None]) -> Callable[[Case], None]:
            self[sentence] = check
            return check

        return add

    def check(self, case: Case, name: str, only: Collection[str] = ()) -> None:
        """Check a case against the rules.

        Args:
            case: what the checks take.
            name: of what is checked, for the errors.
            only: sentences of the rules to check; by default all.

        Raises:
            AssertionError: naming what is checked, the rule it breaks, and how.
            KeyError: if there is no such rule.
        """
        for sentence in only or self:
            check = self[sentence]
            try:
                check(case)
            except Exception as err:
                is_breach = isinstance(err, AssertionError)
                found = str(err) if is_breach else f"{type(err).__name__}: {err}"
                raise AssertionError(f"{name} breaks a rule: {sentence}: {found}") from err


def expect(condition: object, found: str) -> None:
    """An assertion that Python's optimised mode keeps.

    Args:
        condition: expected to be true.
        found: what was found instead, or the rule that is broken.

    Raises:
        AssertionError: with `found`.
    """
    if not condition:
        raise AssertionError(found)


def refuses(attempt: Callable[[], object], kind: type[CurationError], rule: str) -> None:
    """An assertion that bad input is refused with an error of the right kind.

    Args:
        attempt: gives the bad input.
        kind: of the error that is expected.
        rule: the sentence that demands it.

    Raises:
        AssertionError: with the rule, and with what was raised instead.
    """
    try:
        attempt()
    except kind:
        return
    except Exception as err:
        raise AssertionError(f"{rule} ({type(err).__name__}: {err})") from err
    raise AssertionError(rule)
