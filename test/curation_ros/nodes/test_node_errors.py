"""A node that cannot work ends with code 2 and one line that says why."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from episodes import topic_map
from graph import Graph

from curation_ros.nodes.processes import node_arguments
from curation_ros.nodes.programs import NODE_MODULES

pytestmark = pytest.mark.ros
ROOT = Path(__file__).resolve().parents[3]


def map_with(**changes):
    raw = topic_map().to_json()
    for key, value in changes.items():
        raw[key] = {**raw[key], **value}
    return yaml.safe_dump(raw)


FRANKA = {
    "eef_position": {
        "topic": "franka",
        "type": "franka_msgs/msg/FrankaRobotState",
        "role": "effector",
        "values": ["o_t_ee.pose.position.x"],
    }
}
FILES = {
    "broken.yaml": "fields: [",
    "contradicts.yaml": map_with(gripper={"opens": 1}),
    "franka.yaml": map_with(fields=FRANKA),
    "unknown_key.yaml": "scorers: [length]\nrule_scorer: length\nthreshhold: 1\n",
    "a_file": "",
}
#: Name -> (node, parameters, part of the line); {} is the folder of the files.
CASES = {
    "reference_missing": ("curator", {"reference": ["{}/nowhere"]}, "nowhere: no such path"),
    "reference_empty": ("curator", {"reference": ["{}/empty"]}, "empty has no episode in it"),
    "scorer_unknown": ("curator", {"scorers": ["magic"]}, "no scorer 'magic'; there are"),
    "rule_unknown": ("curator", {"rule": "magic"}, "no rule 'magic'; there are"),
    "map_no_yaml": ("curator", {"topic_map": "{}/broken.yaml"}, "broken.yaml is not YAML"),
    "map_missing": ("recorder", {"topic_map": "{}/none.yaml"}, "No such file or directory"),
    "map_contradicts": (
        "curator",
        {"topic_map": "{}/contradicts.yaml"},
        "opens +1 contradicts open_value -1.0 and closed_value 1.0",
    ),
    "type_not_installed": (
        "recorder",
        {"topic_map": "{}/franka.yaml"},
        "message type franka_msgs/msg/FrankaRobotState is not installed: install "
        "ros-jazzy-franka-msgs",
    ),
    "config_unknown_key": ("curator", {"config": "{}/unknown_key.yaml"}, "threshhold"),
    "number_out_of_range": (
        "curator",
        {"drain_timeout_s": -1.0},
        "parameter 'drain_timeout_s': expected float in [0.0, 60.0]",
    ),
    "number_for_a_text": ("recorder", {"task": 5}, "parameter 'task': expected str"),
    "text_for_a_switch": ("recorder", {"auto": "maybe"}, "parameter 'auto': expected bool"),
    "dataset_is_a_file": ("recorder", {"dataset": "{}/a_file"}, "a_file"),
    "dataset_empty": ("curator", {"dataset": ""}, "parameter 'dataset' is empty"),
    "nothing_to_replay": ("replay", {}, "parameter 'bags' is empty"),
    "replay_missing": ("replay", {"bags": ["{}/nowhere"]}, "nowhere: no such path"),
    "nobody_to_replay_to": (
        "replay",
        {"bags": ["{}/a.mcap"], "wait_s": 0.5},
        "no curator subscribes to episode",
    ),
    "no_policy": ("policy_node", {}, "parameter 'policy' is empty"),
    "policy_missing": ("policy_node", {"policy": "{}/nowhere"}, "nowhere"),
}
# Importing takes longer than anything else here. So one process imports the nodes, and each case
# runs in a fork of it, with its own arguments, main() and exit code.
LAUNCHER = """
import importlib, json, os, sys
modules = {m: importlib.import_module(m) for m in json.loads(sys.argv[1])}
for name, module, arguments in json.loads(sys.argv[2]):
    if (pid := os.fork()) == 0:
        log = os.open(name + ".log", os.O_WRONLY | os.O_CREAT)
        os.dup2(log, 1)
        os.dup2(log, 2)
        sys.argv = [module, *arguments]
        try:
            code = modules[module].main()
        except BaseException:
            import traceback
            traceback.print_exc()
            code = 1
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    print(json.dumps([name, os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])]), flush=True)
"""


@pytest.fixture(scope="module")
def ended(graph: Graph):
    """Case -> (exit code, output)."""
    folder = graph.folder
    (folder / "empty").mkdir()
    (folder / "a.mcap").write_bytes(b"")
    for name, text in FILES.items():
        (folder / name).write_text(text)
    cases = []
    for name, (node, parameters, _) in CASES.items():
        given = {k: _in(folder, v) for k, v in parameters.items()}
        if node in ("curator", "recorder"):
            given.setdefault("dataset", str(folder / "dataset"))
        arguments = node_arguments(given)
        cases.append((name, NODE_MODULES[node], arguments))
    modules = sorted({module for _, module, _ in cases})
    done = subprocess.run(
        [sys.executable, "-c", LAUNCHER, json.dumps(modules), json.dumps(cases)],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
    )
    codes = dict(json.loads(line) for line in done.stdout.splitlines())
    return {name: (codes[name], (folder / f"{name}.log").read_text()) for name in CASES}


def _in(folder, value):
    if isinstance(value, list):
        return [_in(folder, v) for v in value]
    return value.replace("{}", str(folder)) if isinstance(value, str) else value


@pytest.mark.parametrize("name", CASES)
def test_error_is_one_line_and_code_2(ended, name):
    code, log = ended[name]
    lines = [line for line in log.splitlines() if not line.startswith("[INFO]")]
    assert len(lines) == 1, log
    assert lines[0].startswith("error: ")
    assert CASES[name][2] in lines[0]
    assert code == 2


def test_spoilt_ros_arguments_are_one_line_too():
    arguments = [sys.executable, "-m", NODE_MODULES["recorder"], "--ros-args", "-p", "dataset"]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert [line[:22] for line in done.stderr.splitlines()] == ["error: ROS arguments: "]


def _run(module, *arguments):
    return subprocess.run(
        [sys.executable, "-m", NODE_MODULES[module], *arguments],
        capture_output=True,
        text=True,
        timeout=60,
    )


def test_stray_argument_is_refused():
    done = _run("recorder", "--dataset=there")
    assert done.returncode == 2
    assert done.stderr == (
        "error: unknown argument '--dataset=there': parameters follow --ros-args -p; "
        "--help lists them\n"
    )


@pytest.mark.parametrize("node", ["recorder", "curator", "replay"])
def test_help_lists_every_parameter(node):
    done = _run(node, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    table = importlib.import_module(NODE_MODULES[node]).PARAMETERS
    lines = done.stdout.splitlines()
    assert [line.split()[0] for line in lines[1:]] == [p.name for p in table]
    assert all(p.description in line for p, line in zip(table, lines[1:], strict=True))


def test_misspelt_parameter_is_named(graph):
    graph.start("recorder", dataset=graph.folder / "right", datset=graph.folder / "wrong")
    graph.ready(
        "recorder",
        line="there is no parameter 'datset': it changes nothing; is 'dataset' meant?",
    )
    graph.stop("recorder")
    assert (graph.folder / "right").is_dir()


# --- stopped while it starts ----------------------------------------------------------------

#: A node that gets SIGINT while it is imported, and one that gets it while it is made.
STOPS_ITSELF = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\nsignal.pause()\n"
IMPORTED = """
import sys
from curation_ros.nodes import executables
executables.NODE_MODULES = {"recorder": "module"}
sys.exit(executables.recorder())
"""
MADE = """
import importlib, sys
from curation_ros.nodes.spinning import run
sys.exit(run(lambda: importlib.import_module("module"), ()))
"""


def _starting(code, module, folder):
    (folder / "module.py").write_text(module)
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])},
        capture_output=True,
        text=True,
        timeout=60,
    )


@pytest.mark.parametrize("code", [IMPORTED, MADE])
def test_node_stopped_while_it_starts_ends_at_once_and_quietly(code, tmp_path):
    done = _starting(code, STOPS_ITSELF, tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_rclpy_that_does_not_load_is_named(tmp_path):
    done = _starting(IMPORTED, "from json import dumbs\n", tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("error: recorder: cannot import name 'dumbs'")
    assert done.stderr.count("\n") == 1
