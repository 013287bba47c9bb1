from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from episodes import make_episode
from streams import record

from curation_ros.dataset.dataset import Dataset

ROOT = Path(__file__).resolve().parents[2]
_BLOCK = """
import sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in BLOCKED:
            raise ModuleNotFoundError(f"{name} is blocked", name=name)
sys.meta_path.insert(0, Blocker())
BLOCKED = set(sys.argv[1].split(","))
"""
_IMPORT_ALL = """
import importlib, pkgutil, curation_ros.core as core
for found in pkgutil.walk_packages(core.__path__, "curation_ros.core."):
    importlib.import_module(found.name)
    print(found.name)
assert not BLOCKED & {name.partition(".")[0] for name in sys.modules}
"""
_COMMANDS = """
import contextlib, io, json
from curation_ros.cli.main import main
for arguments in json.loads(sys.argv[2]):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(arguments)
    print(json.dumps([code, out.getvalue(), err.getvalue()]))
"""
ROBOTICS = "rclpy,rosidl_runtime_py,mujoco,robosuite,libero,torch,numba,cv2"


def _run(code: str, blocked: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", _BLOCK + code, blocked, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
    )


def test_core_imports_without_ros_simulator_torch_and_bags() -> None:
    done = _run(_IMPORT_ALL, f"{ROBOTICS},mcap,rosbags,rich,safetensors,curation_ros.bags")
    assert done.returncode == 0, done.stderr
    paths = [
        p.relative_to(ROOT).with_suffix("") for p in (ROOT / "curation_ros/core").rglob("*.py")
    ]
    modules = {".".join(p.parts).removesuffix(".__init__") for p in paths}
    assert set(done.stdout.split()) == modules - {"curation_ros.core"}


def test_commands_need_nothing_that_they_do_not_use(dataset: Dataset, tmp_path: Path) -> None:
    record(dataset, make_episode(name="pick-1"))
    (tmp_path / "c.yaml").write_text("scorers: [gripper_timing, smoothness]\n")
    path = str(dataset.path)
    selection = str(dataset.path / "selections" / "mine.json")
    done = _run(
        _COMMANDS,
        ROBOTICS,
        json.dumps(
            [
                ["score", path, "--config", str(tmp_path / "c.yaml"), "--write", "--json"],
                ["select", path, "--rule", "all", "--name", "mine", "--json"],
                ["index", path, "--rebuild", "--json"],
                ["train", "--selection", selection],
                ["record", "start"],
            ]
        ),
    )
    assert (done.returncode, done.stderr) == (0, "")
    score, select, index, train, recorder = map(json.loads, done.stdout.splitlines())
    for code, _, err in (score, select, index):
        assert (code, err) == (0, "")
    row = json.loads(score[1])
    assert (row["name"], row["length"], row["findings"]) == ("pick-1", 240, [])
    assert row["scores"]["gripper_timing"] == 237 / 240
    for (code, out, err), name, extra in ((train, "torch", "policy"), (recorder, "rclpy", "ros")):
        assert (code, out, len(err.splitlines())) == (2, "", 1)
        assert f" needs {name}: " in err
        assert f"pip install '.[{extra}]'" in err
