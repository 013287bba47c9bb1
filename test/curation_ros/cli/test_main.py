from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from curation_ros import __version__
from curation_ros.cli import main as module
from curation_ros.cli.main import COMMANDS, main
from curation_ros.core.errors import BagError, ConfigError

DONE, USAGE, NOTHING, INTERNAL, INTERRUPTED = 0, 2, 3, 70, 130
Run = Callable[..., Any]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_helps(curation: Run, command: str) -> None:
    told = curation(command, "--help")
    assert (told.code, told.err) == (DONE, "")
    assert f"curation {command}" in told.out
    assert "--json" in told.out


def test_help_lists_every_command_and_exit_code(curation: Run) -> None:
    told = curation("--help")
    assert told.code == DONE
    text = " ".join(told.out.split())
    for name, (_, words) in COMMANDS.items():
        assert f"{name} {words}" in text
    assert "0 done, 1 findings (with --check), 2 usage, 3 nothing could be done" in text


def test_version_is_that_of_the_package(curation: Run) -> None:
    told = curation("--version")
    assert (told.code, told.out) == (DONE, f"curation_ros {__version__}\n")


@pytest.mark.parametrize("arguments", [[], ["nose"], ["--nose"], ["score"], ["train"]])
def test_wrong_usage_is_code_2(curation: Run, arguments: list[str]) -> None:
    told = curation(*arguments)
    assert (told.code, told.out) == (USAGE, "")
    assert "error: " in told.err


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> Callable[[BaseException], int]:
    """Run a command that fails with an error of one kind."""

    def run(error: BaseException) -> int:
        def fail(_: Any) -> int:
            raise error

        stand_in = ModuleType("failing")
        stand_in.run = fail  # type: ignore[attr-defined]
        stand_in.add_arguments = lambda _: None  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "failing", stand_in)
        monkeypatch.setattr(module, "COMMANDS", {"fail": ("failing", "fails")})
        return main(["fail"])

    return run


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (ConfigError("key 'x'"), USAGE, "error: key 'x'"),
        (BagError("bag y"), NOTHING, "error: bag y"),
        (
            ModuleNotFoundError("no torch", name="torch"),
            USAGE,
            "error: fail needs torch: pip install '.[policy]'",
        ),
        (ImportError("NumPy 2 is needed\nby x", name="x"), USAGE, "error: fail: NumPy 2 is"),
        (KeyboardInterrupt(), INTERRUPTED, "error: interrupted"),
        (RuntimeError("why?"), INTERNAL, "error: internal error: RuntimeError: why?"),
    ],
)
def test_error_is_one_line_and_a_code(
    failing: Callable[[BaseException], int],
    capsys: pytest.CaptureFixture[str],
    error: BaseException,
    code: int,
    said: str,
) -> None:
    assert failing(error) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(said)
    assert len(err.splitlines()) == 1


def test_internal_error_can_be_traced(
    failing: Callable[[BaseException], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CURATION_TRACEBACK", "1")
    with pytest.raises(RuntimeError, match="why"):
        failing(RuntimeError("why?"))


def test_executable_exits_with_the_code(tmp_path: Path) -> None:
    executable = Path(sys.executable).parent / "curation"
    done = subprocess.run(
        [str(executable), "index", str(tmp_path / "none")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (NOTHING, "")
    assert done.stderr == f"error: dataset {tmp_path / 'none'}: no folder 'episodes' in it\n"
