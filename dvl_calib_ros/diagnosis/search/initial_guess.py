"""Initial guess of a diagnosis: clock offsets, lever arm and mounting from `register`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...calibration.numerics.frames import Array, turn_between
from ...calibration.numerics.samples import VelocityFrame
from ...calibration.registration.motion_streams import MotionStreams, make_motion
from ...calibration.registration.registration import Registration, register
from ...calibration.registration.unregistrable_clocks import far_clocks
from ...calibration.streams.interpolation import ImuColumns
from ...effects.base import EffectNeeds
from ...errors import InputError
from ..model.recorded_streams import RecordedStreams
from ..model.time_grid import Offsets


@dataclass(frozen=True)
class FirstGuess:
    """Initial guess of one recording. offsets: of clocks. lever_arm: (3,) m, minus the known one. phi: (3,) rad.

    registration: source of these, None without one.
    """

    offsets: Offsets
    lever_arm: Array
    phi: Array
    registration: Registration | None = None


def check_clocks(recording: RecordedStreams, rotation_dvl_from_body: Array) -> None:
    """Raise InputError if clock offsets are too large for a diagnosis.

    Parameters
    ----------
    recording: The recording to compare.
    rotation_dvl_from_body: (3, 3), the nominal mounting.
    """
    if recording.registration is not None:
        return  # registration has succeeded
    motion = _motion(recording)
    far = None if motion is None else far_clocks(motion, rotation_dvl_from_body)
    if far is not None:
        raise InputError(f"{recording.name}: {far.reason.sentence}")


def first_guess(recording: RecordedStreams, rotation_dvl_from_body: Array, lever_arm: Array) -> FirstGuess:
    """Return delays, lever arm and mounting of one recording; zeros if it cannot be registered."""
    found = recording.registration
    if found is None and (motion := _motion(recording)) is not None:
        found = register(motion, rotation_dvl_from_body.T, lever_arm)
    if found is None:
        return FirstGuess(Offsets(), np.zeros(3), np.zeros(3))
    phi = turn_between(rotation_dvl_from_body, found.rotation_body_from_dvl.T)
    return FirstGuess(Offsets(found.dvl.delay_s, found.reference.delay_s), found.lever_arm - lever_arm, phi, found)


def _motion(recording: RecordedStreams) -> MotionStreams | None:
    """Return the streams of a recording for the registration."""
    attitude, dvl, reference = recording.attitude, recording.dvl, recording.reference
    times = np.zeros(0) if attitude is None else attitude.time
    quaternions = np.zeros((0, 4)) if attitude is None else attitude.values
    rates = np.full((len(times), 3), np.nan)
    if len(times) > 1 and EffectNeeds.ANGULAR_VELOCITY in recording.available:
        rates = recording.angular_velocity(times)
    elif recording.rates is not None:
        times, rates = recording.rates.time, recording.rates.values
        quaternions = np.full((len(times), 4), np.nan)
    length = np.sqrt((quaternions * quaternions).sum(axis=1, keepdims=True))
    return make_motion(
        (dvl.time, dvl.values),
        (reference.time, reference.values),
        recording.frame is not VelocityFrame.BODY,
        recording.measured,
        ImuColumns(times, quaternions / length, rates),
    )
