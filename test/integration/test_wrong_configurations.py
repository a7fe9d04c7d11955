"""Each grossly wrong configuration, as a bag: it is rejected, what fits is named, and apply refuses it."""

from __future__ import annotations

import heapq
import math
from functools import cache

import numpy as np
import pytest
from io_fixtures import live, write_bag
from runs import altered, pushed
from scipy.spatial.transform import Rotation

from dvl_calib_ros.bag_replay.replay import replay
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import ENU_FROM_NED, FLU_FROM_FRD
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.files.result_file import result_document, result_text
from dvl_calib_ros.simulation.scenario import Scenario, simulate
from dvl_calib_ros.simulation.sensors import DvlErrors
from dvl_calib_ros.verdict.kinds import Severity

SMALL = DvlErrors((0.01, -0.015, 0.02), (0.003,) * 3, beam_std=0.005)
BODY, ENU, NED = VelocityFrame.BODY, VelocityFrame.ENU, VelocityFrame.NED


@cache
def run(mounting_rpy=(0.0, 0.0, 0.0), trajectory="figure8", frame=ENU, gnss_std=0.05):
    samples = simulate(
        Scenario(
            trajectory, 120.0, imu_rate=10, errors=SMALL, gnss_std=gnss_std, mounting_rpy=mounting_rpy, gnss_frame=frame
        )
    )
    return tuple(heapq.merge(samples.imu, samples.gnss, samples.dvl, key=lambda sample: sample.stamp_ns))


def in_ned(samples):
    """With a reference in ENU as a driver gives it that says ENU and means NED."""
    return altered(samples, ReferenceSample, velocity=lambda s: tuple((ENU_FROM_NED.T @ s.velocity).tolist()))


def attitude_in_ned(samples):
    def turned(sample):
        rotation = ENU_FROM_NED @ Rotation.from_quat(sample.orientation).as_matrix() @ FLU_FROM_FRD
        return tuple(Rotation.from_matrix(rotation).as_quat().tolist())

    return altered(samples, ImuSample, orientation=turned)


def of_the_dvl(samples):
    """A reference that is made from the DVL's own samples, with a claim of GNSS's noise."""
    rng = np.random.default_rng(1)
    made = []
    for sample in samples:
        if isinstance(sample, ReferenceSample):
            continue
        made.append(sample)
        if isinstance(sample, DvlSample):
            velocity = tuple((np.array(sample.velocity) + rng.normal(0.0, 0.002, 3)).tolist())
            made.append(ReferenceSample(sample.stamp_ns, velocity, np.eye(3) * 0.05**2, BODY))
    return made


def swinging(samples):
    """A reference that says 0.01 m/s and is off by 0.3 m/s, slowly: some effect that no model has."""
    first = samples[0].stamp_ns

    def off(sample):
        seconds = 1e-9 * (sample.stamp_ns - first)
        return 0.3 * math.sin(seconds / 9.0), 0.3 * math.cos(seconds / 14.0), 0.0

    return altered(pushed(samples, ReferenceSample, off), ReferenceSample, covariance=np.eye(3) * 0.01**2)


def rates(samples, change):
    turned = lambda sample: tuple(change(np.array(sample.angular_velocity)).tolist())  # noqa: E731
    return altered(samples, ImuSample, angular_velocity=turned)


def with_a_compass(samples):
    """Headings from north, clockwise, in quaternions that say ENU."""

    def change(sample):
        yaw, pitch, roll = Rotation.from_quat(sample.orientation).as_euler("ZYX")
        return tuple(Rotation.from_euler("ZYX", [0.5 * math.pi - yaw, pitch, roll]).as_quat().tolist())

    return altered(samples, ImuSample, orientation=change)


def in_the_earth(samples):
    """A DVL whose driver has turned its velocities to ENU, by the attitude that came last."""
    made, attitude = [], None
    for sample in samples:
        if isinstance(sample, ImuSample):
            attitude = Rotation.from_quat(sample.orientation)
        if not isinstance(sample, DvlSample):
            made.append(sample)
        elif attitude is not None:
            made.append(sample._replace(velocity=tuple(attitude.apply(sample.velocity).tolist())))
    return made


YAW = {45: (0.0, 0.0, math.radians(45.0))}
WRONG = {
    "yaw off by 45 degrees": (lambda: run(YAW[45]), {}, "MOUNTING_FITS"),
    "z flipped": (lambda: run((math.pi, 0.0, 0.0)), {}, "DVL_AXES_TURNED"),
    "ENU, body claimed": (run, {"gnss_frame": "body"}, "REFERENCE_LOOKS"),
    # of the two next ones roll would tell, which a level vehicle does not show: 180 degrees of it are chance
    "ENU, NED claimed": (run, {"gnss_frame": "ned"}, "REFERENCE_OR_IMU_NED"),
    "NED, ENU claimed": (lambda: in_ned(run()), {}, "REFERENCE_OR_IMU_NED"),
    "NED, body claimed": (lambda: in_ned(run()), {"gnss_frame": "body"}, "REFERENCE_LOOKS"),
    "body, ENU claimed": (lambda: run(frame=BODY), {"gnss_frame": "enu"}, "REFERENCE_LOOKS"),
    "attitude in NED": (lambda: attitude_in_ned(run()), {}, "IMU_LOOKS_NED"),
    "IMU in NED": (lambda: rates(attitude_in_ned(run()), FLU_FROM_FRD.dot), {}, "IMU_LOOKS_NED"),
    "a reference with the DVL in it": (lambda: of_the_dvl(run()), {}, "HELD_OUT_IMPLAUSIBLE"),
    "rates negated": (lambda: rates(run(), np.negative), {}, "RATES_NEGATED"),
    "rates in degrees": (lambda: rates(run(), np.degrees), {}, "RATES_DEGREES"),
    "a compass heading as yaw": (lambda: with_a_compass(run()), {}, "HEADING_CLOCKWISE"),
    "a DVL in ENU": (lambda: in_the_earth(run()), {}, "DVL_TURNS_WITH_HEADING"),
    "a vehicle that stands": (
        lambda: altered(run(), (DvlSample, ReferenceSample), velocity=(0.0, 0.0, 0.0)), {}, "NO_SAMPLE_USED",
    ),
}  # fmt: skip


def codes(reasons):
    """Of reasons and of what they hold."""
    return {each.code for each in reasons}.union(*(codes(each.causes) for each in reasons))


def test_an_effect_beyond_the_model_is_noise_and_no_calibration_is_better_for_it(tmp_path):
    result = replay([write_bag(tmp_path / "bag", swinging(run(gnss_std=0.01)))], Parameters()).result
    verification = result.verifications[result.selected]
    assert verification.verdict is Severity.MARGINAL and "HELD_OUT_NO_BETTER" in codes(verification.reasons)
    assert verification.held_out.predicted > 0.2


@pytest.mark.spread(1)
@pytest.mark.parametrize("wrong", WRONG)
def test_a_bag_of_a_wrong_configuration_is_rejected_with_what_fits_and_apply_refuses_it(wrong, tmp_path, capsys):
    samples, given, code = WRONG[wrong]
    result = replay([write_bag(tmp_path / "bag", samples())], Parameters(**given)).result
    verification = result.verifications[result.selected]
    assert verification.verdict is Severity.REJECT, verification.reasons
    assert code in codes(verification.reasons), verification.reasons
    saved, urdf = tmp_path / "result.yaml", tmp_path / "robot.urdf"
    saved.write_text(result_text(result_document(result)))
    links = '<parent link="base_link"/><child link="dvl_link"/>'
    urdf.write_text(f'<robot><joint name="j" type="fixed">{links}</joint></robot>')
    assert main(["apply", str(saved), "--urdf", str(urdf)]) == 2
    assert "--force" in capsys.readouterr().err


@pytest.mark.spread(1)
@pytest.mark.parametrize(
    "samples", [run, lambda: run(frame=BODY), lambda: run(trajectory="box")], ids=["figure8", "body", "box"]
)
def test_a_right_configuration_is_not_rejected_and_nothing_else_is_said_to_fit(samples, tmp_path):
    result = replay([write_bag(tmp_path / "bag", samples())], Parameters()).result
    verification = result.verifications[result.selected]
    assert verification.verdict is Severity.ACCEPT, verification.reasons
    assert result.suggestion is None


@pytest.mark.slow
def test_what_the_node_saves_of_a_wrong_configuration_is_refused_too(tmp_path, capsys):
    document = result_document(live(write_bag(tmp_path / "bag", run(YAW[45])), Parameters()).result())
    saved, launch = tmp_path / "result.yaml", tmp_path / "tf.launch.xml"
    saved.write_text(result_text(document))
    assert main(["apply", str(saved), "--launch", str(launch)]) == 2
    error = capsys.readouterr().err
    assert "the data fit mounting_rpy 0 0 0.785" in error and not launch.exists()
