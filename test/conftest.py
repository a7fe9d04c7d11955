"""Fixtures that several test files share."""

from __future__ import annotations

import dataclasses
import fcntl
import gc
import hashlib
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Container, Iterable, Mapping
from enum import Enum
from functools import wraps
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # as `cli.main` does, before numpy is imported
# for all participants of all processes, read once with the first; the demo, which CI runs, has the defaults
os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(Path(__file__).with_name("fastdds.xml")))

if sys.dont_write_bytecode:  # hundreds of processes of tests would all compile everything, which none installed does
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix = str(
        Path(tempfile.gettempdir()) / f"dvl_calib_ros_tests_bytecode_{os.getuid()}"
    )

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from dvl_calib_ros.calibration.estimators import registration_schedule
from dvl_calib_ros.calibration.registration.frame_hypotheses import Readings
from dvl_calib_ros.diagnosis import diagnose
from dvl_calib_ros.discovery import discovery
from dvl_calib_ros.unpaired import both_sides

# A busy machine takes its time over an example. Who waits for the suite sees fewer of them than CI, and both the same
# ones each time, so that what fails is what was changed; who searches for new ones takes --hypothesis-profile=search.
settings.register_profile(
    "patient", deadline=None, max_examples=25, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("brief", settings.get_profile("patient"), max_examples=10)  # versions that differ little
settings.register_profile("ci", settings.get_profile("patient"), max_examples=100)
settings.register_profile("search", settings.get_profile("ci"), max_examples=2000, derandomize=False)
settings.load_profile("patient")
ROOT = Path(__file__).resolve().parents[1]
# What nohup and a shell's & make ignored, the processes that tests end by a signal would ignore as well.
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def searched(examples: int, *unchecked: HealthCheck) -> settings:
    """Settings of a search that takes another number of examples than 100: so many, as the profile scales them."""
    scaled = max(5, round(examples * settings.default.max_examples / 100))
    return settings(max_examples=scaled, suppress_health_check=[HealthCheck.too_slow, *unchecked])


def few(cases: Iterable[Any], waited_for: Container[Any]) -> list[Any]:
    """Cases of one test of which those that are not waited for are slow: they are of the same rule."""
    return [case if case in waited_for else pytest.param(case, marks=pytest.mark.slow) for case in cases]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--one-case", metavar="FOLDER", type=Path, help="of each test below it one case; others are slow")


@pytest.hookimpl(trylast=True)
def pytest_itemcollected(item: pytest.Item) -> None:
    """With --one-case, a further case of a test is slow."""
    folder = item.config.getoption("--one-case")
    if folder is None or not item.path.is_relative_to(folder.resolve()) or item.get_closest_marker("slow"):
        return
    if _FIRST_CASES.setdefault((item.path, item.name.partition("[")[0]), item.name) != item.name:
        item.add_marker(pytest.mark.slow)


_FIRST_CASES: dict[tuple[Path, str], str] = {}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Of a test that is marked `spread(n)`, n of its cases are waited for, evenly spread; the others are slow."""
    cases: dict[tuple[Path, str], list[pytest.Item]] = {}
    for item in items:
        if item.get_closest_marker("spread") and not item.get_closest_marker("slow"):
            cases.setdefault((item.path, item.name.partition("[")[0]), []).append(item)
    for each in cases.values():
        mark = each[0].get_closest_marker("spread")
        assert mark is not None  # by what they were chosen
        waited_for = mark.args[0]
        for number, item in enumerate(each):
            if number and number * waited_for // len(each) == (number - 1) * waited_for // len(each):
                item.add_marker(pytest.mark.slow)


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """What was collected stays to the end: looking through it again and again for garbage takes 4 % of the time.

    Each replay asks whether there is any, for which Python counts all of it: 15 ms of a third of a million objects.
    """
    gc.collect()
    gc.freeze()
    frozen = gc.get_freeze_count()
    gc.get_freeze_count = lambda: frozen


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """What a file has imported stays, too."""
    if nextitem is not None and nextitem.path != item.path:
        gc.collect()
        gc.freeze()


def made_once(path: Path, make: Callable[[Path], Any]) -> Path:
    """A file or folder that several processes of one run of the suite share, made by the first that asks."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(f"{path}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            making = path.with_name(f"{path.name}.making")
            make(making)
            making.rename(path)
    return path


def remembered(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a pure function that answers arguments it has had before, to the last bit, from memory."""
    answers: dict[bytes, Any] = {}

    @wraps(function)
    def remembering(*arguments: Any, **named: Any) -> Any:
        digest = hashlib.sha1()
        _add_to(digest, arguments)
        _add_to(digest, tuple(sorted(named.items())))
        key = digest.digest()
        if key not in answers:
            answers[key] = function(*arguments, **named)
        return answers[key]

    return remembering


def _add_to(digest: Any, value: Any) -> None:
    if isinstance(value, np.ndarray):
        digest.update(f"{value.dtype}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    elif isinstance(value, tuple | list):
        digest.update(f"({len(value)}".encode())
        for each in value:
            _add_to(digest, each)
    elif isinstance(value, Readings):
        _add_to(digest, (value._motion, value._position))
    elif isinstance(value, Mapping):  # effects: those of the library are there once
        _add_to(digest, tuple((name, id(each)) for name, each in value.items()))
    elif dataclasses.is_dataclass(value):
        _add_to(digest, tuple(getattr(value, field.name) for field in dataclasses.fields(value) if field.init))
    else:
        assert value is None or isinstance(value, str | int | float | Enum | np.generic), type(value)
        digest.update(f"{value!r},".encode())


# Half of a replay. Its commands, formats and types are tested with the same few recordings; tests of the registration
# itself import it from where it is.
registration_schedule.register = discovery.register = remembered(registration_schedule.register)
registration_schedule.fitting_configuration = remembered(registration_schedule.fitting_configuration)
# All of `diagnose` but reading: its options, pages and comparisons are tested with the same few recordings.
diagnose.diagnose_recordings = both_sides.diagnose_recordings = remembered(diagnose.diagnose_recordings)
for _method in ("registered", "are_axes_mirrored"):
    setattr(Readings, _method, remembered(getattr(Readings, _method)))


@pytest.fixture
def world(monkeypatch):
    """A ROS domain of the test's own, which processes that it starts are in as well."""
    from ros import World

    world = World()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(world.domain))
    yield world
    world.close()


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """For `made_once`: one folder of all processes of this run."""
    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "shared"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20261121)


@pytest.fixture(scope="session")
def snapir() -> Path:
    """Folder of the Snapir sea trials: $DVL_CALIB_SNAPIR, or ../shared/data/snapir beside the project."""
    named = os.environ.get("DVL_CALIB_SNAPIR")
    folder = Path(named) if named else ROOT.parent / "shared" / "data" / "snapir"
    if not (folder / "T12_dvl.csv").is_file():
        pytest.skip(f"no Snapir data in {folder}; name its folder in DVL_CALIB_SNAPIR")
    return folder


@pytest.fixture(scope="session")
def snapir_ins(snapir: Path) -> Path:
    """Folder of the sea trials with the vehicle's INS velocity: snapir_ins beside the other."""
    folder = snapir.parent / "snapir_ins"
    if not (folder / "T01_gnss.csv").is_file():
        pytest.skip(f"no Snapir INS data in {folder}")
    return folder
