from __future__ import annotations

import json
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from curation_ros.core.errors import CurationError
from curation_ros.nodes import processes
from curation_ros.nodes.processes import Domain, Nodes
from curation_ros.nodes.programs import NODE_MODULES

PATIENCE_S = 20.0
#: Stands in for a node. It writes down how it was started, and ends as its parameters say.
_STAND_IN = """
import json, os, signal, sys, time
raw = dict(a.split(":=", 1) for a in sys.argv[1:] if ":=" in a)
with open(os.environ["TOLD"] + "/" + raw["name"].strip("'"), "w") as out:
    json.dump({"pid": os.getpid(), "args": sys.argv[1:], "sid": os.getsid(0),
               "domain": os.environ["ROS_DOMAIN_ID"],
               "range": os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"]}, out)
ends = raw.get("ends", "'asked'").strip("'")
if ends == "stubborn":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
if ends.isdigit():
    print("last words", flush=True)
    sys.exit(int(ends))
open(os.environ["TOLD"] + "/ready-" + raw["name"].strip("'"), "w").close()
try:
    while True:
        time.sleep(60)
except KeyboardInterrupt:
    with open(os.environ["TOLD"] + "/order", "a") as out:
        out.write(raw["name"].strip("'") + "\\n")
"""


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder where stand-ins for nodes write down how they were started."""
    (tmp_path / "stand_in.py").write_text(_STAND_IN)
    monkeypatch.setitem(NODE_MODULES, "stand_in", "stand_in")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setenv("TOLD", str(tmp_path))
    return tmp_path


@pytest.fixture
def domain() -> Iterator[Domain]:
    found = Domain()
    yield found
    found.close()


def _await(path: Path) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not path.exists():
        assert time.monotonic() < deadline_s, f"{path} has not appeared"
        time.sleep(0.01)


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


# --- domains ------------------------------------------------------------------------------------


def test_domains_that_are_held_at_once_differ() -> None:
    held = [Domain() for _ in range(12)]
    assert len({d.id for d in held}) == len(held)
    assert all(1 <= d.id <= 101 for d in held)
    assert held[0].environment == {
        "ROS_DOMAIN_ID": str(held[0].id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    for domain in held:
        domain.close()


def _domain_id() -> int:
    return Domain().id  # taken until the process ends


def test_domain_of_another_process_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    held = Domain()
    monkeypatch.setattr(processes, "_DOMAINS", [held.id])
    with multiprocessing.get_context("fork").Pool(1) as pool, pytest.raises(CurationError) as said:
        pool.apply(_domain_id)
    assert f"no free ROS domain id among {held.id}" in str(said.value)
    held.close()
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.apply(_domain_id) == held.id


def test_domain_on_which_somebody_listens_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    held = Domain()
    held.close()
    monkeypatch.setattr(processes, "_DOMAINS", [held.id])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 7400 + 250 * held.id + 10))
        with pytest.raises(CurationError, match="no free ROS domain id"):
            Domain()
    Domain().close()


# --- nodes --------------------------------------------------------------------------------------


def test_node_gets_its_parameters_and_its_domain(told: Path, domain: Domain) -> None:
    parameters = {
        "name": "rich",
        "folder": Path("/data/a 'b' c"),
        "flag": True,
        "number": 3,
        "ratio": 0.5,
        "several": ["x", "y: z"],
        "empty": "",
    }
    with Nodes(domain, told / "logs") as nodes:
        nodes.start("stand_in", {"name": "plain"}, key="one")
        nodes.start("stand_in", parameters, key="two")
        for name in ("ready-plain", "ready-rich"):
            _await(told / name)
    found = json.loads((told / "rich").read_text())
    assert found["domain"] == str(domain.id)
    assert found["range"] == "LOCALHOST"
    flag, *pairs = found["args"]
    assert flag == "--ros-args"
    values = dict(p.split(":=", 1) for p in pairs if p != "-p")
    read: dict[str, Any] = {k: yaml.safe_load(v) for k, v in values.items()}
    assert read == {**parameters, "folder": "/data/a 'b' c"}


def test_nodes_are_stopped_in_reverse_order_and_none_is_left(told: Path, domain: Domain) -> None:
    with Nodes(domain, told / "logs") as nodes:
        for name in ("first", "second"):
            nodes.start("stand_in", {"name": name}, key=name)
            _await(told / f"ready-{name}")
            assert nodes.ended(name) is None
        nodes.check()
    assert (told / "order").read_text().split() == ["second", "first"]
    for name in ("first", "second"):
        assert not _is_running(json.loads((told / name).read_text())["pid"])


def test_nodes_run_in_sessions_of_their_own(told: Path, domain: Domain) -> None:
    with Nodes(domain, told / "logs") as nodes:
        nodes.start("stand_in", {"name": "one"})
        _await(told / "ready-one")
        found = json.loads((told / "one").read_text())
    assert found["sid"] == found["pid"] != os.getsid(0)


def test_stubborn_node_is_made_to_end(
    told: Path, domain: Domain, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "_PATIENCE_S", 0.2)
    with Nodes(domain, told / "logs") as nodes:
        nodes.start("stand_in", {"name": "one", "ends": "stubborn"})
        _await(told / "ready-one")
    assert not _is_running(json.loads((told / "one").read_text())["pid"])


def test_node_that_fails_is_reported_with_the_last_line_of_its_log(
    told: Path, domain: Domain
) -> None:
    with Nodes(domain, told / "logs") as nodes:
        nodes.start("stand_in", {"name": "one", "ends": "7"})
        with pytest.raises(CurationError, match="stand_in ended with code 7: last words"):
            nodes.wait("stand_in", PATIENCE_S)
        with pytest.raises(CurationError, match=str(told / "logs" / "stand_in.log")):
            nodes.check()


def test_node_that_ends_by_itself_is_waited_for(told: Path, domain: Domain) -> None:
    with Nodes(domain, told / "logs") as nodes:
        nodes.start("stand_in", {"name": "one", "ends": "0"})
        nodes.wait("stand_in", PATIENCE_S)
        assert nodes.ended("stand_in") == 0


def test_node_that_does_not_end_in_time_is_named(told: Path, domain: Domain) -> None:
    with Nodes(domain, told / "logs") as nodes:
        nodes.start("stand_in", {"name": "one"}, key="sleeper")
        with pytest.raises(CurationError, match=r"sleeper has not ended within 0\.1 s"):
            nodes.wait("sleeper", 0.1)


_PARENT = """
import sys, time
from pathlib import Path
from curation_ros.nodes.processes import Domain, Nodes
from curation_ros.nodes.programs import NODE_MODULES
NODE_MODULES["stand_in"] = "stand_in"
with Nodes(Domain(), Path(sys.argv[1]) / "logs") as nodes:
    nodes.start("stand_in", {"name": "orphan"})
    time.sleep(60)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="prctl is Linux's")
def test_nodes_die_with_a_parent_that_was_killed(told: Path) -> None:
    parent = subprocess.Popen([sys.executable, "-c", _PARENT, str(told)])
    try:
        _await(told / "ready-orphan")
    finally:
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    pid = json.loads((told / "orphan").read_text())["pid"]
    deadline_s = time.monotonic() + PATIENCE_S
    while _is_running(pid):
        assert time.monotonic() < deadline_s, "the node lives on"
        time.sleep(0.01)
