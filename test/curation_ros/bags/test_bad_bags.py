from __future__ import annotations

import json
import os
import pickle
import resource
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from bad_bags import BAD, HUGE_BYTES, Bench, make_bad
from decided import decide_on
from episodes import make_reference
from streams import record

from curation_ros.bags.errors import TornFileError
from curation_ros.bags.yaml_text import load_yaml
from curation_ros.cli.main import main
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.findings import FINDINGS
from curation_ros.core.errors import BagError, ConfigError, CurationError, EpisodeError
from curation_ros.core.evidence.baseline import Baseline
from curation_ros.core.evidence.checks import check_episode
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import find_episodes, read_episode

#: Of everything that reads one bad bag; a chunk of the largest size is not among them.
MOST_MEMORY_BYTES = 150 << 20
#: Of Python and all libraries, which map far more than they use, and that on top.
MOST_ADDRESS_SPACE_BYTES = 6 << 30
SCORERS = ("gripper_timing", "length")
_REFERENCE = make_reference(np.random.default_rng(20260608), 6)
_BASELINE = Baseline().fit(_REFERENCE)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return Bench(tmp_path_factory.mktemp("bench"))


@pytest.fixture(scope="module")
def curation() -> Curation:
    return Curation.fit(CurationSettings(scorers=SCORERS), _REFERENCE)


def _skip_if_impossible(name: str, path: Path) -> None:
    if name == "not-allowed" and os.access(path, os.R_OK):
        pytest.skip("this user may read everything, whatever its permissions are")


def _findings(path: Path, curation: Curation, known: set[str]) -> set[str]:
    """Ids of what is wrong with a bag, as `curation score` comes to them."""
    error = None
    try:
        [bag] = find_episodes([path])
        episode = read_episode(bag)
    except CurationError as err:
        error = err
    if error is not None:
        assert str(error).isprintable()
        return {error.finding}
    found = {f.id for f in decide_on(curation, episode).findings}
    found |= {f.id for f in check_episode(episode, _BASELINE)}
    return found | ({"duplicate"} if episode.content_digest in known else set())


def test_there_are_a_hundred_and_more() -> None:
    assert len(BAD) >= 100
    assert {finding for _, finding in BAD.values()} <= set(FINDINGS)


@pytest.mark.parametrize("name", BAD)
def test_bad_bag_is_named(name: str, bench: Bench, curation: Curation, tmp_path: Path) -> None:
    path = make_bad(name, bench, tmp_path)
    _skip_if_impossible(name, path)
    tracemalloc.start()
    try:
        found = _findings(path, curation, {bench.episode.content_digest})
        _, most_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert BAD[name][1] in found
    assert most_bytes < MOST_MEMORY_BYTES


def test_sound_bag_has_no_finding(bench: Bench, curation: Curation, tmp_path: Path) -> None:
    assert _findings(bench.bag(tmp_path / "sound"), curation, set()) == set()


def test_sound_files_of_the_bench_are_sound(bench: Bench, tmp_path: Path) -> None:
    for content in (bench.plain, bench.packed):
        file = tmp_path / "a.mcap"
        file.write_bytes(content)
        assert len(read_episode(file)) == 100


# --- the whole command --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def heap(bench: Bench, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Path]]:
    """All bad ones in one folder, and where each is."""
    folder = tmp_path_factory.mktemp("heap")
    return folder, {name: make_bad(name, bench, folder) for name in BAD}


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    dataset = Dataset(tmp_path_factory.mktemp("reference"), create=True)
    for episode in _REFERENCE:
        record(dataset, episode)
    return dataset.path


@pytest.fixture
def score(
    capsysbinary: pytest.CaptureFixture[bytes], reference: Path, tmp_path: Path
) -> Iterator[Callable[..., tuple[int, dict[str, dict[str, object]], str]]]:
    """Run `curation score --json`; the rows by path."""
    config = tmp_path / "curation.yaml"
    config.write_text(f"scorers: [{', '.join(SCORERS)}]\n")

    def run(*arguments: object) -> tuple[int, dict[str, dict[str, object]], str]:
        options = ["--json", "--config", config, "--reference", reference]
        code = main([str(a) for a in ("score", *arguments, *options)])
        out, err = capsysbinary.readouterr()
        rows = [json.loads(line) for line in out.splitlines()]
        return code, {row["path"]: row for row in rows}, err.decode(errors="replace")

    return run


def test_bad_bags_are_named_and_the_others_scored(
    score: Callable[..., tuple[int, dict[str, dict[str, object]], str]],
    heap: tuple[Path, dict[str, Path]],
    bench: Bench,
    tmp_path: Path,
) -> None:
    folder, paths = heap
    sound = bench.bag(tmp_path / "sound")
    # What no scan of a folder takes for a bag, a person may still name.
    scanned = {p.resolve() for p in find_episodes([folder])}
    named = [p for p in paths.values() if p.is_symlink() or p.resolve() not in scanned]
    code, rows, err = score(sound, folder, *named)
    assert code == 0
    assert "Traceback" not in err
    found = {path: _ids(row) for path, row in rows.items()}
    assert found.pop(str(sound)) == set()  # it came before its copy
    missed = {
        name: found.get(str(path))
        for name, path in paths.items()
        if BAD[name][1] not in found.get(str(path), set()) and name != "not-allowed"
    }
    assert missed == {}
    good = rows[str(sound)]
    assert good["scores"]["gripper_timing"] is not None  # type: ignore[index]
    assert score(sound, folder, *named, "--check")[0] == 1


def _ids(row: dict[str, object]) -> set[str]:
    if "error" in row:
        return {str(row["finding"])}
    return {f["id"] for f in row["findings"]}  # type: ignore[attr-defined]


def test_nothing_but_bad_files_is_exit_code_3(
    score: Callable[..., tuple[int, dict[str, dict[str, object]], str]],
    heap: tuple[Path, dict[str, Path]],
) -> None:
    _, paths = heap
    torn = [p for name, p in paths.items() if BAD[name][1] in ("truncated", "empty-file")]
    code, rows, _ = score(*torn)
    assert code == 3
    assert len(rows) == len(torn) > 10
    assert all("error" in row for row in rows.values())


_LIMITED = """
import resource, sys
limit = int(sys.argv[1])
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
from pathlib import Path
from curation_ros.dataset.episodes import find_episodes, read_episode
from curation_ros.core.errors import CurationError
for name in sys.argv[2:]:
    try:
        read_episode(find_episodes([Path(name)])[0])
    except CurationError as err:
        print(err.finding)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def test_huge_files_and_bombs_take_little_memory(bench: Bench, tmp_path: Path) -> None:
    """In a process of its own, where libraries written in C are counted, too."""
    names = [name for name in BAD if name.startswith(("sparse", "bomb", "chunk-of"))]
    paths = [make_bad(name, bench, tmp_path) for name in names]
    assert sum(p.stat().st_size >= HUGE_BYTES for p in paths) == 6

    def run(*arguments: object) -> tuple[list[str], int]:
        command = [sys.executable, "-c", _LIMITED, str(MOST_ADDRESS_SPACE_BYTES)]
        done = subprocess.run(
            [*command, *map(str, arguments)], capture_output=True, text=True, timeout=120
        )
        assert done.returncode == 0, done.stderr
        *found, kilobytes = done.stdout.split()
        return found, int(kilobytes) << 10

    found, most = run(*paths)
    _, least = run()
    assert found == [BAD[name][1] for name in names]
    assert most - least < MOST_MEMORY_BYTES


def test_reading_leaves_no_file_open(bench: Bench, curation: Curation, tmp_path: Path) -> None:
    def n_open() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    if not Path("/proc/self/fd").exists():
        pytest.skip("no /proc to count open files in")
    before = n_open()
    for name in ("only-the-magic", "cut-in-the-summary", "bit-flipped-in-a-chunk", "text-file"):
        _findings(make_bad(name, bench, tmp_path), curation, set())
    assert n_open() == before
    assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] > before


# --- errors -------------------------------------------------------------------------------------


def test_error_is_one_line_that_a_terminal_does_not_obey() -> None:
    error = BagError("topic /a\n\x1b[2J\udcff: ä µ", finding="checksum")
    assert str(error) == "topic /a\\n\\x1b[2J\\udcff: ä µ"
    assert str(error).isprintable()


def test_error_keeps_its_finding_on_the_way_from_a_worker(tmp_path: Path) -> None:
    errors = [
        TornFileError(tmp_path, "it ends at byte 9 without a footer", "truncated"),
        BagError("x: no", finding="checksum"),
        ConfigError("y"),
        EpisodeError("z"),
    ]
    for error in errors:
        again = pickle.loads(pickle.dumps(error))
        assert (type(again), str(again), again.finding) == (type(error), str(error), error.finding)
    assert [e.finding for e in errors] == ["truncated", "checksum", "bad-config", "unusable"]


def test_every_finding_of_an_error_is_in_the_list() -> None:
    for leaf in CurationError.__subclasses__():
        assert leaf.finding == "" or leaf.finding in FINDINGS


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        "{a: " * 50_000,
        "- " * 100_000,
        "? " * 100_000,
        "\n".join(" " * k + "-" for k in range(4000)),
        "a: &a [*a]",
        "a: &a {b: *a}",
        " " * (17 << 20),
    ],
    ids=["flow", "mapping", "block", "key", "indented", "endless", "endless-mapping", "long"],
)
def test_yaml_that_is_a_trap_is_refused(text: str) -> None:
    """Some of these overflow the stack of libyaml, which ends the process."""
    for form in (text, text.encode()):
        with pytest.raises(ValueError, match="not metadata"):
            load_yaml(form)


def test_yaml_with_aliases_and_levels_is_read() -> None:
    assert load_yaml("a: &x [1, 2]\nb: *x\n") == {"a": [1, 2], "b": [1, 2]}
    assert load_yaml("[" * 90 + "]" * 90)
