"""Three covariances: of the filter alone, of this recording, of the next; and which of them is published."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from runs import MatchedRun, calibrate, make_samples

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import rotation_from_rpy, skew
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ReferenceSample
from dvl_calib_ros.files.result_file import result_document

MOUNTING = (0.1, -0.2, 0.8)
RUN = MatchedRun("box", 200.0, phi=(0.01, -0.02, 0.03), dvl_std=0.01, gnss_std=0.03, mounting_rpy=MOUNTING)
PAPERS = ("M1", "M2", "M3", "M4", "M5", "M6", "M7")
SWAY_HEAVE = (0.02, -0.01)


@cache
def calibrated(model: str = "auto") -> Calibrator:
    """Of the run, with the gate open; not to be fed any more."""
    parameters = Parameters(
        model=model, mounting_rpy=MOUNTING, gate_probability=0.0, min_speed=0.0, prior_sway_heave=SWAY_HEAVE
    )
    return calibrate(make_samples(RUN), parameters)


def closed_form(name: str) -> np.ndarray:
    """(P₀⁻¹ + Σ HᵀR⁻¹H)⁻¹ with H as the paper writes it, one sample after the other."""
    samples = make_samples(RUN)
    t = rotation_from_rpy(MOUNTING).T
    reference = {each.stamp_ns: np.array(each.velocity) for each in samples if isinstance(each, ReferenceSample)}
    parameters = Parameters()
    is_aided = name in ("M1", "M2", "M3", "M4")
    noise = parameters.gnss_aided_std if is_aided else parameters.gnss_free_std
    n = 4 if is_aided else 3
    prior = [parameters.initial_std_misalignment] * 3 + [parameters.initial_std_scale]
    information = np.diag(np.array(prior[:n]) ** -2.0)
    for each in samples:
        if not isinstance(each, DvlSample):
            continue
        v = np.array(each.velocity)
        if is_aided:
            r = t @ (reference[each.stamp_ns] * ([1, 1, 0] if name in ("M3", "M4") else [1, 1, 1]))
            h = np.column_stack([skew(r), -r * ([1, 1, 1] if name in ("M1", "M3") else [1, 0, 0])])
        elif name == "M5":
            h = skew(t @ [np.linalg.norm(v), *SWAY_HEAVE])
        else:
            h = (t.T @ skew(v))[: 3 if name == "M6" else 1]
        information = information + h.T @ h / noise**2
    return np.linalg.inv(information)


@pytest.mark.parametrize("name", PAPERS)
def test_the_covariance_of_the_filter_is_the_papers_in_closed_form(name):
    expected = closed_form(name)
    scale = np.sqrt(np.diag(expected))
    found = calibrated().estimate(name).filter_covariance
    # far below 1e-12 rad²; relative to σ, as angles that are all but one combination lose digits in any order of sums
    np.testing.assert_allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale), rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", ["M1", "M2", "M3", "M4", "M5", "M6", "full"])
def test_no_covariance_is_smaller_than_the_one_before_it(name):
    estimate = calibrated().estimate(name)
    stds = [estimate.filter_std, estimate.recording_std, estimate.std]
    assert np.all(np.diff(stds, axis=0) >= -1e-15)
    assert np.any(stds[2] > stds[0])


def test_iac_publishes_what_the_papers_filter_says_and_saves_all_three():
    calibrator = calibrated("iac")
    name = calibrator.selected
    assert name in PAPERS
    published, estimate = calibrator.published(name), calibrator.estimate()
    np.testing.assert_array_equal(published.p, estimate.filter_covariance)
    np.testing.assert_array_equal(published.x, calibrator.state(name).x)
    # what its mounting is worth is another question
    np.testing.assert_array_equal(calibrator.next_recording(name).p, estimate.covariance)
    document = result_document(calibrator.result())["models"][name]
    for key, expected in (
        ("covariance_of_filter", estimate.filter_covariance),
        ("covariance_of_recording", estimate.recording_covariance),
        ("covariance", estimate.covariance),
    ):
        np.testing.assert_array_equal(document[key], expected)


def test_by_default_σ_of_the_next_recording_is_published():
    calibrator = calibrated()
    np.testing.assert_array_equal(calibrator.published("full").p, calibrator.estimate("full").covariance)
