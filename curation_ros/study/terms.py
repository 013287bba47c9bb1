"""The names of training sets: a row of a plan such as `reference+knn@16`, and its terms."""

from __future__ import annotations

import re
from dataclasses import dataclass

from curation_ros.core.errors import ConfigError
from curation_ros.core.scorers import is_scorer, scorer_names


@dataclass(frozen=True)
class Control:
    """A term that no scorer makes.

    Attributes:
        needs: what somebody must have to make it.
        takes_keep: whether `@K` gives the number to keep.
        needs_keep: whether `@K` must be there.
        has_draws: whether it is drawn, so that `#N` can name the draw.
    """

    needs: str
    takes_keep: bool = False
    needs_keep: bool = False
    has_draws: bool = False


CONTROLS: dict[str, Control] = {
    # All of the contaminated demonstrations.
    "everything": Control("nothing"),
    # K drawn at random. #N is the draw; without it each training seed has its own.
    "random": Control("nothing", takes_keep=True, needs_keep=True, has_draws=True),
    # Those that succeeded. With @K also defective ones, up to K.
    "oracle": Control("labels", takes_keep=True),
    # K, defective ones first.
    "worst": Control("labels", takes_keep=True, needs_keep=True),
    # K as the oracle keeps them, by shuffled labels.
    "shuffled": Control("labels", takes_keep=True, needs_keep=True, has_draws=True),
    # What a person calls a success, wrong in %P of 100 presses.
    "button": Control("outcome button"),
    # The trusted demonstrations alone.
    "reference": Control("reference"),
    # K of the dataset `more`.
    "more": Control("more clean demonstrations", takes_keep=True, needs_keep=True),
    # What the curator keeps whole by default, without a reference.
    "decided": Control("object pose"),
    # Good beginnings of what the curator salvages. -M ends them M control steps before the break.
    "salvaged": Control("object pose"),
    # The same episodes, each cut at a random step.
    "random_cut": Control("object pose", has_draws=True),
}
#: Terms made of the curator's decisions; they need what the scorer needs that decided.
DECIDED = ("decided", "salvaged", "random_cut")
_TERM = re.compile(r"([a-z_]+)(?:-([0-9]+))?(?:@([0-9]+))?(?:#([0-9]+))?(?:%([0-9]+))?")


@dataclass(frozen=True)
class Term:
    """A part of a training set.

    Attributes:
        name: a scorer, or one of CONTROLS.
        keep: number to keep, best first; None if the set has a size of its own.
        draw: draw of `random`, `shuffled` and `random_cut`; None if every training seed has a
            draw of its own.
        wrong: of `button`: wrong presses in 100.
        margin: of `salvaged`: control steps from the end of the beginning to the break; None for
            the curator's own margin.
    """

    name: str
    keep: int | None = None
    draw: int | None = None
    wrong: int = 0
    margin: int | None = None

    @property
    def is_drawn(self) -> bool:
        """Whether each training seed has a set of its own."""
        return self.name in CONTROLS and CONTROLS[self.name].has_draws and self.draw is None


def parse_row(text: str) -> tuple[Term, ...]:
    """Parse a training set such as `knn@16`, `random@16#3`, `button%10`, `decided+salvaged-15`.

    Raises:
        ConfigError: naming the term that is wrong.
    """
    return tuple(_parse_term(part, text) for part in text.replace(" ", "").split("+"))


def _parse_term(part: str, text: str) -> Term:
    match = _TERM.fullmatch(part)
    if not match or (match[1] not in CONTROLS and not is_scorer(match[1])):
        known = ", ".join((*CONTROLS, *scorer_names()))
        raise ConfigError(f"training set {text!r}: unknown term {part!r}; known are {known}")
    name = match[1]
    margin, keep, draw, wrong = (None if m is None else int(m) for m in match.groups()[1:])
    # A scorer ranks, so it always keeps a number.
    control = CONTROLS.get(name, Control("", takes_keep=True, needs_keep=True))
    problem = ""
    if control.needs_keep and not keep:
        problem = f"{name} needs a number to keep, as in {name}@16"
    elif keep is not None and not control.takes_keep:
        problem = f"{name} takes no @K"
    elif draw is not None and not control.has_draws:
        problem = f"{name} has no draws"
    elif (wrong is None) == (name == "button"):
        problem = "%P is for button, as in button%10"
    elif margin is not None and name != "salvaged":
        problem = "-M is for salvaged, as in salvaged-15"
    if problem:
        raise ConfigError(f"training set {text!r}: {problem}")
    return Term(name, keep, draw, wrong or 0, margin)
