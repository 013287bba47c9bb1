from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from bag_messages import POSE, START_NS, episode_messages, pose, to_cdr, write_bag
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from curation_ros.bags import BagWriter, open_bag, recover_bag
from curation_ros.bags.mcap_file import Message, walk
from curation_ros.core.errors import BagError


def _by_topic(messages: Any) -> dict[str, list[tuple[int, int, int, bytes]]]:
    out: dict[str, list[tuple[int, int, int, bytes]]] = {}
    for topic, *rest in messages:
        out.setdefault(topic, []).append(tuple(rest))
    return out


def _chunk_ends(path: Path) -> list[tuple[int, int]]:
    """(end of the chunk in the file, messages up to there) of each chunk."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    seen, out = 0, []
    for index in summary.chunk_indexes:
        start = index.chunk_start_offset
        inside = walk(path, lambda offset, start=start: offset != start)
        seen += sum(isinstance(r, Message) for r in inside)
        out.append((start + index.chunk_length, seen))
    return out


def test_every_truncation_keeps_a_prefix_with_all_flushed_chunks(tmp_path: Path) -> None:
    writer = write_bag(
        tmp_path / "whole", episode_messages(30), custom_data={"episode": "{}"}, flush_every=25
    )
    whole = writer.path.read_bytes()
    original = _by_topic(open_bag(tmp_path / "whole").messages())
    ends = _chunk_ends(writer.path)
    assert len(ends) == 6
    cuts = {8, 9, 20, len(whole) - 1, len(whole) - 8, *range(50, len(whole), len(whole) // 60)}
    cuts |= {end + k for end, _ in ends for k in (-1, 0, 1)}
    for cut in sorted(cuts):
        torn, target = tmp_path / "torn", tmp_path / f"saved{cut}"
        torn.mkdir()
        (torn / "whole_0.mcap").write_bytes(whole[:cut])
        (torn / "metadata.yaml.tmp").write_text("half")
        if cut < 40:
            with pytest.raises(BagError, match="nothing to recover"):
                recover_bag(torn, target)
            assert not target.exists()
        else:
            report = recover_bag(torn, target)
            saved = _by_topic(open_bag(target).messages())
            for topic, messages in saved.items():
                assert messages == original[topic][: len(messages)]
            flushed = max((n for end, n in ends if end <= cut), default=0)
            assert sum(report.messages.values()) >= flushed
            assert report.messages == {t: x.count for t, x in open_bag(target).topics.items()}
            assert "byte" in report.tail or "magic" in report.tail
        assert (torn / "whole_0.mcap").read_bytes() == whole[:cut]
        shutil.rmtree(torn)


def test_recovered_bag_keeps_everything_and_says_so(tmp_path: Path) -> None:
    custom = {"episode": json.dumps({"id": "x"}), "topics": "{}"}
    writer = BagWriter(tmp_path / "p", "name", custom_data=custom)
    writer.add_topic("/eef_pose", POSE)
    for k in range(20):
        writer.write(
            "/eef_pose", START_NS + k + 5, START_NS + k, 100 + k, to_cdr(pose(k, (1.0, 0.0, 0.0)))
        )
    writer.flush()
    writer.abandon()
    report = recover_bag(tmp_path / "p", tmp_path / "new")
    bag = open_bag(tmp_path / "new")
    assert bag.mcap_paths[0].name == "name_0.mcap"
    assert [m.sequence for m in bag.messages()] == list(range(100, 120))
    assert [m.publish_time_ns for m in bag.messages()] == [START_NS + k for k in range(20)]
    assert bag.custom_data == {
        **custom,
        "recovered": "true",
        "recovered_messages": "20",
        "recovered_tail": report.tail,
    }
    assert dict(report.custom_data) == dict(bag.custom_data)
    assert "without a footer" in report.tail
    assert (tmp_path / "p").is_dir()
    assert not list(tmp_path.rglob("*.recovering"))
    with Reader(tmp_path / "new") as reader:
        assert reader.message_count == 20
        [connection] = reader.connections
        assert connection.msgtype == POSE
        assert connection.digest.startswith("RIHS01_10f3786d")


def test_whole_file_whose_recorder_died_before_the_rename(tmp_path: Path) -> None:
    write_bag(tmp_path / "p", episode_messages(5), custom_data={"a": "1"})
    (tmp_path / "p" / "metadata.yaml").unlink()
    report = recover_bag(tmp_path / "p", tmp_path / "new")
    assert (report.tail, sum(report.messages.values())) == ("complete", 25)


def test_damaged_chunk_ends_the_recovery(tmp_path: Path) -> None:
    writer = write_bag(tmp_path / "p", episode_messages(10), compression="none", flush_every=10)
    raw = bytearray(writer.path.read_bytes())
    (_, before), (end, _) = _chunk_ends(writer.path)[1:3]
    raw[end - 100] ^= 1
    writer.path.write_bytes(raw)
    with pytest.raises(BagError, match="wrong checksum"):
        list(open_bag(tmp_path / "p").messages())
    report = recover_bag(tmp_path / "p", tmp_path / "new")
    assert "checksum" in report.tail
    assert sum(report.messages.values()) == before == 20


def test_zeros_after_a_loss_of_power(tmp_path: Path) -> None:
    writer = write_bag(tmp_path / "p", episode_messages(10), flush_every=10)
    end, before = _chunk_ends(writer.path)[2]
    raw = writer.path.read_bytes()
    writer.path.write_bytes(raw[:end] + bytes(len(raw) - end))
    report = recover_bag(tmp_path / "p", tmp_path / "new")
    assert (sum(report.messages.values()), "zeros" in report.tail) == (before, True)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "0 bytes"),
        (b"hello world, this is no bag", "no MCAP file"),
        (b"\x89MCAP0\r\n", "nothing to recover"),
        (b"\x89MC", "no MCAP file"),
    ],
)
def test_nothing_to_recover_is_said_and_the_original_stays(
    tmp_path: Path, content: bytes, said: str
) -> None:
    (tmp_path / "p").mkdir()
    (tmp_path / "p" / "x_0.mcap").write_bytes(content)
    with pytest.raises(BagError, match=said):
        recover_bag(tmp_path / "p", tmp_path / "new")
    assert (tmp_path / "p" / "x_0.mcap").read_bytes() == content
    assert not (tmp_path / "new").exists()


def test_folder_without_a_file_and_existing_target_are_refused(tmp_path: Path) -> None:
    (tmp_path / "p").mkdir()
    with pytest.raises(BagError, match=r"found 0"):
        recover_bag(tmp_path / "p", tmp_path / "new")
    writer = write_bag(tmp_path / "q", episode_messages(2))
    before = writer.path.read_bytes()
    with pytest.raises(BagError, match="exists already"):
        recover_bag(tmp_path / "q", tmp_path / "q")
    assert writer.path.read_bytes() == before


_CHILD = """
import sys, time
from pathlib import Path
sys.path.insert(0, {tests!r})
from bag_messages import POSE, pose, to_cdr
from curation_ros.bags import BagWriter
writer = BagWriter(Path({folder!r}), "ep", custom_data={{"k": "v"}})
writer.add_topic("/eef_pose", POSE)
last = time.monotonic()
for k in range(10**9):
    writer.write("/eef_pose", k, k, k & 0xffff, to_cdr(pose(k, (1.0, 2.0, 3.0))))
    if time.monotonic() - last > 0.05:
        last = time.monotonic()
        writer.flush()
        print(k, flush=True)
    time.sleep(0.001)
"""


def test_killed_writer_loses_only_what_came_after_its_last_flush(tmp_path: Path) -> None:
    code = _CHILD.format(tests=str(Path(__file__).parent), folder=str(tmp_path / "p"))
    root = Path(__file__).parents[3]
    environment = os.environ | {"PYTHONPATH": str(root)}
    child = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment
    )
    assert child.stdout is not None
    flushed = 0
    deadline = time.monotonic() + 20
    for line in child.stdout:
        flushed = int(line)
        if flushed > 100 or time.monotonic() > deadline:
            break
    child.kill()
    child.wait()
    child.stdout.close()
    report = recover_bag(tmp_path / "p", tmp_path / "new")
    assert report.messages["/eef_pose"] >= flushed + 1 > 100
    assert report.custom_data["k"] == "v"
    stamps = [m.log_time_ns for m in open_bag(tmp_path / "new").messages()]
    assert stamps == list(range(len(stamps)))
