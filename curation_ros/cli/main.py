"""The `curation` command."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence

from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.extras import how_to_install
from curation_ros.version import __version__

#: Subcommand -> (module, one line of help), the only list. A module is imported when its command
#: is used, so `curation score` needs no torch and `curation train` needs no ROS.
COMMANDS = {
    "score": ("curation_ros.cli.score", "score bags and decide on them, without ROS"),
    "audit": ("curation_ros.cli.audit", "how well scores tell good from bad, or only length"),
    "select": ("curation_ros.cli.select", "choose episodes and write a manifest"),
    "export": ("curation_ros.cli.export", "write keep.json, CSV or Parquet"),
    "override": ("curation_ros.cli.override", "a person's decision on an episode"),
    "index": ("curation_ros.cli.index", "list a dataset; rebuild its index from its files"),
    "scorers": ("curation_ros.cli.scorers", "list scorers, ours and those of other packages"),
    "self-check": ("curation_ros.cli.self_check", "prove that no score depends on labels"),
    "recover": ("curation_ros.cli.recover", "save what a damaged bag still holds"),
    "record": ("curation_ros.cli.record", "start and stop episodes of a running recorder"),
    "collect": ("curation_ros.cli.collect", "record simulated demonstrations, without ROS"),
    "train": ("curation_ros.cli.train", "train a policy on a selection"),
    "evaluate": ("curation_ros.cli.evaluate", "count a policy's successes over start states"),
    "benchmark": ("curation_ros.cli.benchmark", "run a study: which selection trains best"),
    "report": ("curation_ros.cli.report", "draw a study's results: HTML, Markdown"),
    "demo": ("curation_ros.cli.demo", "the whole path, from recording to the trained policy"),
}
DONE, FINDINGS, USAGE, NOTHING, INTERNAL = 0, 1, 2, 3, 70
_INTERRUPTED = 130


def parser(command: str = "") -> argparse.ArgumentParser:
    """The command line.

    Args:
        command: the subcommand whose arguments are added; empty: the arguments of all. Importing
            all modules takes a second.
    """
    top = argparse.ArgumentParser(
        prog="curation",
        description="Curate robot demonstrations: score, decide, select, train, evaluate.",
        epilog="Exit codes: 0 done, 1 findings (with --check), 2 usage, 3 nothing could be done, "
        "70 internal error, 130 interrupted.",
    )
    top.add_argument("--version", action="version", version=f"curation_ros {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (module, text) in COMMANDS.items():
        one = commands.add_parser(name, help=text, description=text[0].upper() + text[1:])
        one.add_argument("--json", action="store_true", help="JSON lines on stdout, no tables")
        if command in ("", name):
            importlib.import_module(module).add_arguments(one)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand and return its exit code. Bad input never ends in a traceback."""
    words = list(sys.argv[1:] if argv is None else argv)
    chosen = next((word for word in words if not word.startswith("-")), "-")
    try:
        args = parser(chosen).parse_args(words)
        code: int = importlib.import_module(COMMANDS[args.command][0]).run(args)
    except ConfigError as err:
        return _complain(err, USAGE)
    except CurationError as err:
        return _complain(err, NOTHING)
    except KeyboardInterrupt:
        return _complain("interrupted", _INTERRUPTED)
    except BrokenPipeError:  # the reader of the output is gone, as with `head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except ModuleNotFoundError as err:
        missing = str(err.name)
        return _complain(f"{chosen} needs {missing}: {how_to_install(missing)}", USAGE)
    except ImportError as err:  # the module is installed but does not load
        return _complain(f"{chosen}: {str(err).partition(chr(10))[0]}", USAGE)
    except Exception as err:
        if os.environ.get("CURATION_TRACEBACK"):
            raise
        return _complain(
            f"internal error: {type(err).__name__}: {err} (CURATION_TRACEBACK=1 shows where)",
            INTERNAL,
        )
    return code


def _complain(problem: object, code: int) -> int:
    print(f"error: {problem}", file=sys.stderr)
    return code


if __name__ == "__main__":
    raise SystemExit(main())
