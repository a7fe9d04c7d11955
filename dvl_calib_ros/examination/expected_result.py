"""What a calibration will claim: as a replay of the recording does, of a part of it where it is long."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..calibration.assessment.model_selection import eligible
from ..calibration.calibrator import Calibrator
from ..calibration.filters.observability import OBSERVED_SHARE, scale_std_ahead
from ..calibration.models import MODELS
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.samples import Stream
from ..calibration.registration.registration import Registration
from ..calibration.results.mounting_quantities import Quantity, quantities
from ..calibration.results.results import Estimate, rpy_std
from ..messages.decode import MessageDecoder
from ..recordings.recording import Recording
from ..recordings.topics import Topics

# Of a longer recording a calibration is made with so much of it: that shows what kind of motion there is.
EXPECTED_FROM_S = 300.0
BLOCK_SIZE = 8192
_NAMES = ("roll", "pitch", "yaw", "scale")


@dataclass(frozen=True)
class Shown:
    """What the motion shows of one error.

    std: standard deviation to expect, degrees or per cent. share: of the way from knowing nothing (0) to fine (1).
    needs: the manoeuvre that shows more, '' if it is shown.
    """

    name: str
    unit: str
    std: float
    share: float
    needs: str


def expected(
    recording: Recording, topics: Topics, parameters: Parameters, registration: Registration | None
) -> tuple[Shown, ...]:
    """Of roll, pitch, yaw and scale; none where no sample can be used. registration: as it was found, where it was."""
    topics = topics.found_in(recording.types)
    p = recording.of_types(topics, parameters).replace(prior_source="fixed")
    calibrator = Calibrator(
        p, block_size=BLOCK_SIZE, recordings_ns=recording.between_ns, models=eligible(p), registration=registration
    )
    named = {topics.imu: Stream.IMU, topics.gnss: Stream.REFERENCE, topics.dvl: Stream.DVL}
    start_ns, end_ns = recording.span_ns
    share = min(1.0, EXPECTED_FROM_S / max(1e-9 * (end_ns - start_ns), 1e-9))
    decoder = MessageDecoder(p)
    decoder.on_fix = calibrator.feed_fix
    for stretch in recording.stretches(named, decoder, share):
        calibrator.feed(stretch.streams)
    calibrator.finish()
    result = calibrator.result()
    if not result.estimate.used:
        return ()
    return tuple(_shown(each, result.estimate, p, share) for each in quantities(result) if each.name in _NAMES)


def _shown(found: Quantity, estimate: Estimate, parameters: Parameters, share: float) -> Shown:
    """By a calibration with a share of the recording; what is the same however much there is stays as it is."""
    model = MODELS[estimate.model]
    stays = estimate.covariance - estimate.velocity_covariance + estimate.left_open
    # more of the recording shows more of a bias where speeds show it, and no more at one speed: between the two
    of_all = stays - (1.0 - math.sqrt(share)) * estimate.of_bias.covariance
    if found.name == "scale":
        unit, prior, fine = 100.0, parameters.initial_std_scale, parameters.fine_std_scale
        part, floor = (float(scale_std_ahead(model, each, parameters)[0]) for each in (stays, of_all))
    else:
        unit, prior, fine = math.degrees(1.0), parameters.initial_std_misalignment, parameters.fine_std_misalignment
        axis = _NAMES.index(found.name)
        part, floor = (float(rpy_std(estimate.misalignment, each, parameters)[axis]) for each in (stays, of_all))
    of_share = max((found.std / unit) ** 2 - part**2, 1e-12)
    told = max(1.0 / of_share - prior**-2, 0.0) / share
    std = math.sqrt(floor**2 + min(of_share, 1.0 / (told + prior**-2)))
    is_shown = found.shown or std <= OBSERVED_SHARE * prior
    missing = (each.missing for each in estimate.observability if each.axis == found.name and each.missing)
    needs = "" if is_shown else next(missing, model.shown_by[found.name])
    way = min(1.0, max(0.0, math.log(prior / std) / math.log(prior / fine)))
    return Shown(found.name, found.unit.strip(), std * unit, way, needs)
