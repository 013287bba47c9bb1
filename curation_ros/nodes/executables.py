"""Entry points of the nodes' programs. A program that lacks a module says how to install it."""

from __future__ import annotations

import importlib
import os
import signal
import sys
from collections.abc import Callable
from functools import partial

from curation_ros.extras import how_to_install
from curation_ros.nodes.programs import NODE_MODULES

_WRONG_SETUP = 2


def __getattr__(name: str) -> Callable[[], int]:
    """The entry point of a node: setup.py makes one for each node of the table."""
    if name in NODE_MODULES:
        return partial(_run, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _run(node: str) -> int:
    # Imports take seconds. A node that is stopped meanwhile has nothing to tidy up.
    signal.signal(signal.SIGINT, lambda *_: os._exit(0))
    try:
        module = importlib.import_module(NODE_MODULES[node])
    except ModuleNotFoundError as err:
        missing = str(err.name).partition(".")[0]
        return _complain(f"{node} needs {missing}: {how_to_install(missing)}")
    except ImportError as err:  # the module is installed but does not load
        return _complain(f"{node}: {str(err).partition(chr(10))[0]}")
    return int(module.main())


def _complain(problem: str) -> int:
    print(f"error: {problem}", file=sys.stderr)  # noqa: T201  no node yet whose logger could be used
    return _WRONG_SETUP
