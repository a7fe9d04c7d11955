"""A scale-factor error that follows the depth, as sound speed does in layers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import VelocityFrame
from dvl_calib_ros.diagnosis.answer.results import DiagnosisVerdict
from dvl_calib_ros.diagnosis.diagnose import diagnose_recordings
from dvl_calib_ros.diagnosis.model.recorded_streams import RecordedStreams, make_recording

LAYER = "sound_speed_layer"


def yo_yo(ratio_per_m: float, frame: VelocityFrame = VelocityFrame.ENU, pitch_rad: float = 0.3) -> RecordedStreams:
    """Four dives, of 14 m at a pitch of 0.3 rad, with turns; the DVL is aligned and its scale grows with depth."""
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 480.0, 0.2)
    yaw = 0.8 * np.sin(0.02 * time) + 0.002 * time
    pitch = pitch_rad * np.sin(2.0 * np.pi * time / 120.0)
    attitude = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, 0.05 * np.sin(0.5 * time)]))
    body = np.column_stack([1.2 + 0.3 * np.sin(0.013 * time), 0.05 * np.sin(0.3 * time), 0.0 * time])
    enu = attitude.apply(body)
    depth = -np.cumsum(enu[:, 2]) * 0.2
    dvl = body * (1.0 + ratio_per_m * depth[:, None]) + rng.normal(0.0, 0.01, body.shape)
    reference = (enu if frame is VelocityFrame.ENU else body) + rng.normal(0.0, 0.03, body.shape)
    return make_recording("yo-yo", (time, dvl), (time, reference), frame=frame, attitude=(time, attitude.as_quat()))


@pytest.mark.parametrize("frame", [VelocityFrame.ENU, VelocityFrame.BODY])
def test_a_scale_that_follows_the_depth_is_named_with_its_size(frame):
    diagnosis = diagnose_recordings([yo_yo(0.003, frame)], Parameters())
    (found,) = diagnosis.effects
    value, low, high = found.parameters["ratio_per_m"]
    assert diagnosis.verdict is DiagnosisVerdict.KNOWN and found.name == LAYER
    assert low < 0.003 < high and value == pytest.approx(0.003, rel=0.1)


def test_a_dive_without_layers_has_none():
    assert diagnose_recordings([yo_yo(0.0)], Parameters()).verdict is DiagnosisVerdict.NO_GAP


def test_it_needs_a_dive_and_a_reference_that_measures_it():
    horizontal = replace(yo_yo(0.0), measured=(True, True, False))
    for recording in (yo_yo(0.0, pitch_rad=0.0), horizontal):
        assert diagnose_recordings([recording], Parameters()).untestable[LAYER] == "a dive"
