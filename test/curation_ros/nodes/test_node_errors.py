"""A node that cannot work says so in one line, and ends with code 2."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
import yaml
from episodes import topic_map
from graph import Graph

from curation_ros.processes import NODE_MODULES, node_arguments

pytestmark = pytest.mark.ros


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
#: Name -> (node, parameters, what the line says); {} is the folder of the files.
CASES = {
    "reference_missing": ("curator", {"reference": ["{}/nowhere"]}, "nowhere: no such path"),
    "reference_empty": ("curator", {"reference": ["{}/empty"]}, "empty has no bag in it"),
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
    "nothing_to_replay": ("replay", {}, "parameter 'bags' is empty"),
    "replay_missing": ("replay", {"bags": ["{}/nowhere"]}, "nowhere: no such path"),
    "nobody_to_replay_to": (
        "replay",
        {"bags": ["{}/a.mcap"], "wait_s": 0.5},
        "no curator listens",
    ),
    "no_policy": ("policy_node", {}, "parameter 'policy' is empty"),
    "policy_missing": ("policy_node", {"policy": "{}/nowhere"}, "nowhere"),
}
# Importing takes longer than anything else here: each case runs in a fork of one process that has
# imported the nodes, with arguments, main() and exit code of its own.
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
        arguments = node_arguments({"dataset": folder / "dataset", **given})
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
    # The first line is rcl's own.
    assert [line[:22] for line in done.stderr.splitlines()[1:]] == ["error: ROS arguments: "]
