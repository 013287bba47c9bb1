"""`curation scorers`: which scorers there are, from which package, with which parameters."""

from __future__ import annotations

import argparse
import math
from typing import Any

from curation_ros.cli.output import print_json, say, warn
from curation_ros.core.errors import ConfigError
from curation_ros.core.scorers.registry import DEFAULT_SCORERS, Offer, offers
from curation_ros.core.scorers.scorer import Scorer

#: An offered class that cannot be used is a wrong configuration.
_REFUSED = 2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command: none."""


def run(args: argparse.Namespace) -> int:
    """List every scorer; warn about classes that cannot be used."""
    code = 0
    for offer in offers():
        try:
            row = described(offer, offer.load()())
        except ConfigError as err:
            warn(err)
            code = _REFUSED
            continue
        if args.json:
            print_json(row)
        else:
            say(
                f"{row['scorer']}: {row['summary']}\n"
                f"  needs {row['needs']}, version {row['version']}, package {row['package']}"
            )
            defaults = [f"{k}={p['default']}" for k, p in row["parameters"].items()]
            say(f"  {', '.join(defaults) or 'no parameters'}")
    if not args.json:
        say(f"Used if none is named: {', '.join(DEFAULT_SCORERS)}")
    return code


def described(offer: Offer, scorer: Scorer) -> dict[str, Any]:
    """A scorer as plain JSON.

    Args:
        offer: of the scorer.
        scorer: with its default parameters.
    """
    return {
        "scorer": offer.name,
        "package": offer.package,
        "needs": scorer.needs,
        "version": scorer.version,
        "is_default": offer.name in DEFAULT_SCORERS,
        "is_length_controlled": scorer.length_controlled,
        "resolution": scorer.resolution,
        "parameters": {
            name: {"default": _plain(value), "choices": list(scorer.choices.get(name, ()))}
            for name, value in scorer.params().items()
        },
        "summary": (type(scorer).__doc__ or "").strip().partition("\n")[0],
    }


def _plain(value: object) -> object:
    """A default as JSON has it, else its text."""
    is_finite = not isinstance(value, float) or math.isfinite(value)
    is_plain = value is None or (isinstance(value, (bool, int, float, str)) and is_finite)
    return value if is_plain else str(value)
