"""Bags of the twins that a diagnosis makes of recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..bags.writer import BagWriter, Compression, Storage
from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample
from ..messages.encode import SampleWriter
from .twin import Twin


def twin_paths(folder: Path, name: str) -> tuple[Path, Path]:
    """Where the twins of a recording go, without and with what was found."""
    return folder / f"{name}_without", folder / f"{name}_with"


def write_twins(folder: Path, twin: Twin) -> None:
    """Write NAME_without and NAME_with: DVL simulated without noise, reference and IMU as recorded. Raises InputError.

    Stamps are the recording's, less what the parameters know of its clocks.
    """
    for path, velocity in zip(twin_paths(folder, twin.recording.name), (twin.without, twin.with_effects), strict=True):
        with BagWriter(path, Storage.MCAP, Compression.NONE) as bag:
            SampleWriter(bag).recording(*_streams(twin, velocity))


def _streams(twin: Twin, velocity: Array) -> tuple[list[ImuSample], list[ReferenceSample], list[DvlSample]]:
    recording = twin.recording

    def stamps(time: Array) -> list[int]:
        return [recording.first_ns + round(1e9 * each) for each in time.tolist()]

    dvl = [DvlSample(at, (x, y, z)) for at, (x, y, z) in zip(stamps(twin.time), velocity.tolist(), strict=True)]
    reference = [
        ReferenceSample(at, (x, y, z), None, recording.frame)
        for at, (x, y, z) in zip(stamps(recording.reference.time), recording.reference.values.tolist(), strict=True)
    ]
    imu: list[ImuSample] = []
    oriented = recording.attitude or recording.rates
    if oriented is not None:
        time = oriented.time
        rates = recording.angular_velocity(time).tolist()
        quaternions: list[list[float]] = []
        if recording.attitude is not None:
            values = recording.attitude(time)
            quaternions = (values / np.linalg.norm(values, axis=1)[:, None]).tolist()
        for i, at in enumerate(stamps(time)):
            x, y, z = rates[i]
            imu.append(ImuSample(at, tuple(quaternions[i]) if quaternions else None, (x, y, z)))  # type: ignore[arg-type]
    return imu, reference, dvl
