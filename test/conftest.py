"""Fixtures that several test files share."""

from __future__ import annotations

import os
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # as `cli.main` does, before numpy is imported

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

# a busy machine takes its time over an example
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")
ROOT = Path(__file__).resolve().parents[1]


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
