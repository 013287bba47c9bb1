"""The package as it is installed: what pip lays out, and that its descriptions agree."""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import yaml

import curation_ros
from curation_ros.configuration import share_file
from curation_ros.core.episode import messages
from curation_ros.nodes.processes import Domain
from curation_ros.nodes.programs import NODE_MODULES

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("curation_ros", "sim_node", "policy_node")
PROGRAMS = {*NODE_MODULES, "curation"}
# Too large for the machine that records, or at odds with what it has already.
HEAVY = re.compile(r"^(ros-|rclpy|torch|mujoco|robosuite|libero|numba)", re.IGNORECASE)


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """The prefix of a virtual environment where pip has installed a copy of this tree."""
    uv = _uv()
    tree = _copy(tmp_path_factory.mktemp("trees") / "tree")
    prefix = tmp_path_factory.mktemp("installed") / "prefix"
    _check(uv, "venv", "--quiet", "--python", sys.executable, str(prefix))
    _install(uv, str(prefix / "bin" / "python"), "--no-deps", str(tree))
    return prefix


def _uv() -> str:
    uv = shutil.which("uv", path=os.pathsep.join([str(Path(sys.executable).parent), *_path()]))
    if uv is None:
        pytest.skip("uv is not installed")
    return uv


def _copy(tree: Path) -> Path:
    """A copy of what is installed of this tree."""
    tree.mkdir()
    for name in ("setup.py", "pyproject.toml", "package.xml", "LICENSE"):
        shutil.copy(ROOT / name, tree)
    for name in (*PACKAGES, "config", "launch", "resource"):
        shutil.copytree(
            ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info")
        )
    return tree


def _install(uv: str, python: str, *what: str) -> None:
    try:
        _check(uv, "pip", "install", "--quiet", "--python", python, *what)
    except subprocess.CalledProcessError as err:
        if re.search(r"dns error|error sending request|Failed to fetch", err.stderr):
            pytest.skip("offline, and setuptools is not in the cache of uv")
        pytest.fail(err.stderr)


def _path() -> list[str]:
    return os.environ.get("PATH", "").split(os.pathsep)


def _check(*command: str, **settings) -> str:
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    return subprocess.run(
        command, check=True, capture_output=True, text=True, timeout=120, env=clean, **settings
    ).stdout


def _package_xml() -> ET.Element:
    return ET.parse(ROOT / "package.xml").getroot()


def _setup(*arguments: str) -> str:
    """What setup.py says, without installing anything."""
    return _check(sys.executable, "-W", "ignore", "setup.py", "--quiet", *arguments, cwd=ROOT)


# --- an installation ------------------------------------------------------------------------


def test_pip_lays_out_what_ros2_run_and_launch_look_up(installed):
    assert (installed / "share/ament_index/resource_index/packages/curation_ros").is_file()
    share = installed / "share/curation_ros"
    expected = {
        "package.xml",
        *(f"config/{p.name}" for p in (ROOT / "config").glob("*.yaml")),
        *(f"launch/{p.name}" for p in (ROOT / "launch").glob("*.launch.py")),
    }
    assert {p.relative_to(share).as_posix() for p in share.rglob("*") if p.is_file()} == expected
    lib = installed / "lib/curation_ros"
    assert {p.name for p in lib.iterdir()} == PROGRAMS
    for name in PROGRAMS:
        assert os.access(lib / name, os.X_OK), name
        assert os.access(installed / "bin" / name, os.X_OK), name


def test_pip_installs_every_package_and_no_test(installed):
    (site,) = installed.glob("lib/python3.*/site-packages")
    top = {p.name for p in site.iterdir() if p.is_dir() and not p.name.endswith(".dist-info")}
    assert top == set(PACKAGES)
    for package in PACKAGES:
        sources = {p.relative_to(ROOT) for p in (ROOT / package).rglob("*.py")}
        assert sources == {p.relative_to(site) for p in (site / package).rglob("*.py")}
    assert (site / "curation_ros/py.typed").is_file()


def test_share_file_is_found_in_an_installation(installed):
    # The requirements come from this environment, the package from that prefix.
    (site,) = installed.glob("lib/python3.*/site-packages")
    code = (
        f"import sys; sys.path.insert(0, {str(site)!r})\n"
        "from curation_ros.configuration import share_file\n"
        "sys.stdout.write(str(share_file('config/topics.yaml')))"
    )
    found = _check(sys.executable, "-c", code, cwd=installed)
    assert Path(found) == installed / "share/curation_ros/config/topics.yaml"


@pytest.mark.parametrize("folder", ["bin", "lib/curation_ros"])
def test_executable_without_ros_says_what_to_install(installed, folder):
    env = {**os.environ, "PYTHONPATH": _without_ros(installed)}
    env.pop("AMENT_PREFIX_PATH", None)
    done = subprocess.run(
        [installed / folder / "recorder"], env=env, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2
    assert done.stderr.startswith("error: recorder needs ")
    assert done.stderr.count("\n") == 1
    assert "[ros]" in done.stderr


def test_symlink_install_runs_on_the_active_python(tmp_path):
    """What `colcon build --symlink-install` does, with the setuptools of Ubuntu 24.04."""
    uv = _uv()
    python = str(tmp_path / "venv/bin/python")
    _check(uv, "venv", "--quiet", "--python", sys.executable, str(tmp_path / "venv"))
    _install(uv, python, "setuptools==68.1.2")
    tree = _copy(tmp_path / "tree")
    prefix = tmp_path / "prefix"
    (site := prefix / "lib").mkdir(parents=True)
    command = ["-W", "ignore", "setup.py", "--quiet", "develop", "--no-deps"]
    command += ["--install-dir", str(site), "--script-dir", str(prefix / "bin")]
    subprocess.run(
        [python, *command], cwd=tree, check=True, env={**os.environ, "PYTHONPATH": str(site)}
    )
    assert {p.name for p in (prefix / "bin").iterdir()} == PROGRAMS
    for name in PROGRAMS:
        program = prefix / "bin" / name
        assert program.read_text().startswith("#!/usr/bin/env python3\n"), name
        assert os.access(program, os.X_OK)


def _without_ros(prefix: Path) -> str:
    """A folder of links to what the core needs of this environment."""
    links = prefix / "requirements"
    links.mkdir(exist_ok=True)
    for name in ("numpy", "numpy.libs", "yaml", "typing_extensions.py"):
        for place in sys.path:
            if (found := Path(place) / name).exists() and not (links / name).exists():
                (links / name).symlink_to(found)
    return str(links)


# --- descriptions that agree ----------------------------------------------------------------


def test_version_is_the_same_everywhere():
    version = curation_ros.__version__
    assert _setup("--version").strip() == version
    assert _package_xml().findtext("version") == version
    citation = ROOT / "CITATION.cff"
    assert re.findall(r"^version: (.+)$", citation.read_text(), re.MULTILINE) == [version]
    changelog = ROOT / "CHANGELOG.md"
    if changelog.is_file():
        newest = re.search(r"^## \[(.+?)\]", changelog.read_text(), re.MULTILINE)
        assert newest is not None
        assert newest[1] in (version, "Unreleased")


def test_package_xml_is_that_of_an_ament_python_package():
    root = _package_xml()
    assert root.findtext("name") == "curation_ros"
    assert root.findtext("license") == "Apache-2.0"
    assert root.findtext("export/build_type") == "ament_python"
    # colcon takes the package for plain Python, with a warning only, if this does not parse.
    email = root.find("maintainer").attrib["email"]
    assert re.fullmatch(r"[\w.+-]+@[\w-]+(\.[\w-]+)*\.[a-z]{2,}", email)


def test_package_xml_declares_the_ros_packages_that_are_used():
    imported = {
        module
        for folder in (*PACKAGES, "launch")
        for path in (ROOT / folder).rglob("*.py")
        for module in _imports(path)
        if re.fullmatch(r"rclpy|launch(_ros)?|.*_(msgs|srvs|interfaces)", module)
    }
    # Types of messages that are made from plain data are imported by name.
    made = [name for name in vars(messages).values() if re.match(r"\w+/msg/\w+$", str(name))]
    imported |= {name.partition("/")[0] for name in made}
    declared = {
        element.text
        for element in _package_xml().iter("exec_depend")
        if not element.text.startswith("python3-")
    }
    assert imported == declared


def _imports(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    return {name.partition(".")[0] for name in names}


def test_base_requirements_are_light():
    requirements = importlib.metadata.requires("curation_ros")
    base = [r for r in requirements if "extra ==" not in r]
    extras = {e for r in requirements for e in re.findall(r"extra == ['\"](\w+)", r)}
    assert base
    assert [r for r in base if HEAVY.match(r)] == []
    assert extras == {"ros", "sim", "policy", "report", "ray", "dask", "parquet", "test"}
    # Where apt has installed ROS, no other extra brings a second rclpy.
    ros = [r for r in requirements if re.match(r"ros-|rclpy", r)]
    assert ros
    assert all(re.search(r"extra == ['\"]ros['\"]", r) for r in ros)


def test_entry_points_are_the_nodes_and_can_be_imported(installed):
    (site,) = installed.glob("lib/python3.*/site-packages")
    (ours,) = importlib.metadata.distributions(name="curation_ros", path=[str(site)])
    points = {p.name: p for p in ours.entry_points if p.group == "console_scripts"}
    assert set(points) == PROGRAMS
    assert all(callable(point.load()) for point in points.values())


def test_hooks_run_tools_of_the_extra_test():
    """Nothing is downloaded from elsewhere."""
    (repository,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert repository["repo"] == "local"
    programs = {hook["entry"].split()[0] for hook in repository["hooks"]}
    assert {"ruff", "mypy", "lint-imports"} < {Path(program).name for program in programs}
    for program in programs:
        assert Path(program).parent == Path(".venv/bin")
        assert (Path(sys.executable).parent / Path(program).name).exists(), program


@pytest.mark.parametrize("module", NODE_MODULES.values())
def test_node_module_has_a_main(module):
    path = ROOT / f"{module.replace('.', '/')}.py"
    functions = {n.name for n in ast.parse(path.read_text()).body if hasattr(n, "name")}
    assert "main" in functions


@pytest.mark.parametrize("name", ["config/topics.yaml", "config/curation.yaml"])
def test_share_file_of_the_source_tree(name):
    assert share_file(name) == ROOT / name


# --- ROS's own tools ------------------------------------------------------------------------


@pytest.mark.ros2cli
@pytest.mark.skipif(
    importlib.util.find_spec("ros2run") is None, reason="ros2run is not installed (no ROS 2)"
)
def test_ros2_run_starts_and_stops_the_recorder(tmp_path):
    domain = Domain()
    env = {
        "AMENT_PREFIX_PATH": sys.prefix,
        **os.environ,
        **domain.environment,
        "PYTHONUNBUFFERED": "1",
    }
    ros2 = Path(sys.executable).parent / "ros2"
    command = [str(ros2) if ros2.is_file() else "ros2", "run", "curation_ros", "recorder"]
    command += ["--ros-args", "-p", f"dataset:={tmp_path / 'data'}"]
    node = subprocess.Popen(
        command, env=env, stderr=subprocess.STDOUT, stdout=subprocess.PIPE, start_new_session=True
    )
    try:
        said = b""
        while b"discovery range" not in said:
            line = node.stdout.readline()
            assert line, said.decode()
            said += line
        os.killpg(node.pid, 2)  # as Ctrl-C does: everybody in the terminal
        node.communicate(timeout=20)
        assert node.returncode == 0
        assert (tmp_path / "data").is_dir()
    finally:
        if node.poll() is None:
            os.killpg(node.pid, 9)
        domain.close()
