"""The live card over recordings of the sea: when it says that the calibration is good enough, and what it is then."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.estimators.estimator import AtOnce
from dvl_calib_ros.calibration.filters.cross_validation import FOLDS, folds_of
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import Streams
from dvl_calib_ros.calibration.results.thinned_recording import ThinnedRecording
from dvl_calib_ros.messages.decode import MessageDecoder
from dvl_calib_ros.node.operator_card import Card
from dvl_calib_ros.recordings.recording import open_recording
from dvl_calib_ros.recordings.topics import Topics
from dvl_calib_ros.verdict.kinds import Severity

from .registry import CHEAP, Found, dvl_calib, measurement, snapir_ins
from .sea import IMPORT, RECORDINGS

SECOND = 1_000_000_000


@measurement(
    cost=CHEAP,
    command="dvl-calib import snapir_ins, each played to the live card, a look each second",
    tolerances={"*_s": 5.0, "*.ratio": 0.05, "*.worth": 0.3, "*.taken_back": 0, "*": 0.001},
)
def played(folder: Path) -> Found:
    """By recording: seconds until *good enough*, how often that is taken back, the drift predicted at the end (m/km).

    And the velocity error (m/s) of the calibration then and at the end, on all of the recording, each sample held out.
    """
    dvl_calib("import", snapir_ins(), "-o", folder / "bags", *IMPORT)
    found: dict[str, float] = {}
    for name in RECORDINGS:
        parameters = Parameters()
        streams = open_recording([folder / "bags" / name]).streams(Topics(), MessageDecoder(parameters))
        looks = _looks(streams, parameters)
        said = [each["next code"] == "NEXT_IS_GOOD" for each in looks]
        whole = _calibrated(streams, parameters)
        assert whole.recording is not None
        recording, epoch_ns = whole.recording
        end = _error(whole, recording, epoch_ns, parameters)
        found[f"{name}.end"], found[f"{name}.worth"] = end, float(looks[-1]["worth"])
        found[f"{name}.taken_back"] = sum(now and not later for now, later in pairwise(said))
        if True in said:
            good_s = 1 + said.index(True)
            then = _error(_calibrated(_until(streams, good_s), parameters), recording, epoch_ns, parameters)
            found[f"{name}.good_s"], found[f"{name}.then"], found[f"{name}.ratio"] = good_s, then, then / end
    return found


def _looks(streams: Streams, parameters: Parameters) -> list[dict[str, str]]:
    """What the card says, each second of the stamps."""
    calibrator, card = Calibrator(parameters, worker=AtOnce()), Card(0.0)
    first_ns, last_ns = _span(streams)
    looks = []
    for second in range(1, 1 + math.ceil((last_ns - first_ns) / SECOND)):
        calibrator.feed(_between(streams, first_ns + (second - 1) * SECOND, first_ns + second * SECOND))
        rejects = [each for each in calibrator.doubts_so_far if each.severity is Severity.REJECT]
        rejected = bool(calibrator.suggestion_so_far or rejects)
        looks.append(card.values(calibrator, calibrator.estimate(), calibrator.counts, float(second), rejected))
    return looks


def _span(streams: Streams) -> tuple[int, int]:
    return min(int(each.stamps_ns[0]) for each in streams), max(int(each.stamps_ns[-1]) for each in streams)


def _between(streams: Streams, from_ns: int, to_ns: int) -> Streams:
    return Streams(*(each.part(slice(*np.searchsorted(each.stamps_ns, (from_ns, to_ns)))) for each in streams))


def _until(streams: Streams, seconds: int) -> Streams:
    first_ns = _span(streams)[0]
    return _between(streams, first_ns, first_ns + seconds * SECOND)


def _calibrated(streams: Streams, parameters: Parameters) -> Calibrator:
    """With folds held out."""
    calibrator = Calibrator(parameters, verified=True)
    calibrator.feed(streams)
    calibrator.finish()
    return calibrator


def _error(calibrator: Calibrator, recording: ThinnedRecording, epoch_ns: int, parameters: Parameters) -> float:
    """Of a recording, each sample by the fold that had not seen it, rms over the vector."""
    stamps_ns = epoch_ns + np.round(SECOND * recording.dvl.times).astype(np.int64)
    folds, terms = folds_of(stamps_ns, parameters), calibrator.held_out_terms(calibrator.selected)
    errors = [recording.compared(np.flatnonzero(folds == k), terms[k][0], parameters).error for k in range(FOLDS)]
    error = np.concatenate(errors)
    return float(np.sqrt(np.nanmean((error**2).sum(axis=1))))
