"""Values for the operator of a running calibration: mounting, predicted drift, next manoeuvre.

They are computed once per status of /diagnostics, so they cost nothing per message.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

import numpy as np

from ..calibration.assessment.manoeuvre_planner import Outlook, RecentMotion, is_good_enough, noise_of_a_second, outlook
from ..calibration.calibrator import Calibrator
from ..calibration.filters.observability import KM, PredictedDrift, predicted_drift
from ..calibration.models import MODELS
from ..calibration.numerics.kalman import GaussianState
from ..calibration.results.results import Estimate, corrected_rpy, rpy_std, scale_and_delay
from ..verdict.reasons import Reason, finding

# interval of computing the next manoeuvre, s, which takes a few milliseconds
REPLANNED_EVERY_S = 5.0
# The predicted drift varies between looks by up to a factor of two. It is good enough after all looks within STANDS_S
# are within the goal. It is no longer good enough when the median over STANDS_S, which is the displayed value, exceeds
# WITHDRAWN_RATIO times the goal: a σ of 25 blocks is known to 1/7 (1σ), so a factor of 1.5 is significant. Seconds are
# counted by DVL stamps, so a fast playback counts the same and a silent DVL counts nothing.
STANDS_S, WITHDRAWN_RATIO = 30.0, 1.5
# Number of looks that STANDS_S needs at least, which limits the step of one: a stamp far ahead counts no more.
LEAST_LOOKS = 5
# 2σ of a predicted time, relative: the time is proportional to σ², which is known to 2/7 (1σ) from 25 blocks.
SPREAD = 4.0 / 7.0
# number of statuses over which rates are averaged
RATED_OVER = 10
SECTORS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
_STREAMS = {"dvl": "dvl", "reference": "gnss", "imu": "imu"}


class RecentWorth:
    """Recent predicted drift of a calibration, and whether it is good enough.

    taken_back: why it is no longer good enough; None if it never was, or is again.
    """

    def __init__(self) -> None:
        self._model = ""
        self._drifts: deque[tuple[float, PredictedDrift]] = deque()
        self._within_since_s: float | None = None
        self.is_good = False
        self.taken_back: Reason | None = None

    def add(self, model: str, drift: PredictedDrift, target: float, now_s: float, rejected: bool) -> PredictedDrift:
        """Add a prediction and return the displayed drift, the median of the recent ones.

        now_s: time by DVL stamps. rejected: whether a replay would reject the calibration.
        """
        was_good = self.is_good
        if rejected or model != self._model:
            self._drifts.clear()
            self._model, self._within_since_s, self.is_good = model, None, False
            if rejected:
                self.taken_back = None  # the findings say why
            elif was_good:
                self.taken_back = finding("WORTH_OF_ANOTHER_MODEL", model=model)
        if self._drifts and self._drifts[-1][0] == now_s:
            self._drifts.pop()
        self._drifts.append((now_s, drift))
        while self._drifts[0][0] < now_s - STANDS_S:
            self._drifts.popleft()
        predicted = PredictedDrift(
            *(sorted(drifts)[len(drifts) // 2] for drifts in zip(*(d for _, d in self._drifts), strict=True))
        )
        if self.is_good and predicted.both > WITHDRAWN_RATIO * target:
            self.is_good, self.taken_back = False, finding("WORTH_HAS_FALLEN", worth=predicted.both)
        if rejected or drift.both > target:
            self._within_since_s = None
        elif self._within_since_s is None:
            self._within_since_s = now_s
        elif self.seconds_left(now_s) == 0.0:
            self.is_good, self.taken_back = True, None
        return predicted

    def seconds_left(self, now_s: float) -> float:
        """Return the time (s) for which the drift must still stay within the goal."""
        return STANDS_S - (0.0 if self._within_since_s is None else min(now_s - self._within_since_s, STANDS_S))


class RemainingTime:
    """Time until a calibration is good enough, s of DVL data, and why it is longer than predicted before.

    `longer`: the reason for an increase beyond the spread of the prediction, else None.
    """

    def __init__(self) -> None:
        self._ends_s: deque[tuple[float, float]] = deque()  # time of each prediction, and the predicted end
        self._latest_s, self._longer_since_s = math.inf, -math.inf  # latest predicted end
        self._drift_then = math.nan  # m per km, when that end was predicted
        self.longer: Reason | None = None

    def add(self, seconds: float | None, drift: float, now_s: float) -> float | None:
        """Add a prediction, and return the median of the last predictions of the remaining time, s.

        seconds: predicted remaining time, None if unknown. drift: predicted drift, m per km, as displayed.
        If the median end is later than any end predicted before, `longer` tells why.
        """
        if now_s - self._longer_since_s >= STANDS_S:
            self.longer = None
        self._ends_s.append((now_s, math.inf if seconds is None else now_s + seconds))
        while self._ends_s[0][0] < now_s - STANDS_S:
            self._ends_s.popleft()
        end_s = sorted(end for _, end in self._ends_s)[len(self._ends_s) // 2]
        remaining = max(end_s - now_s, 0.0)
        latest_s = end_s + SPREAD * remaining
        if end_s > self._latest_s:
            code = "LONGER_AS_DRIFT_GREW" if drift > self._drift_then else "LONGER_AS_LITTLE_SHOWN"
            self.longer, self._longer_since_s = finding(code, before=self._drift_then, now=drift), now_s
        if latest_s < self._latest_s or end_s > self._latest_s:
            self._latest_s, self._drift_then = latest_s, drift
        return remaining if math.isfinite(remaining) else None


class Card:
    """Values of successive statuses. now_s: monotonic time."""

    def __init__(self, now_s: float) -> None:
        """Start without statuses."""
        self._began_s = now_s
        self._received: deque[tuple[float, Mapping[str, int]]] = deque(maxlen=RATED_OVER)
        self._came_s: dict[str, float] = {}  # time of each stream's newest message
        self._driven_s = dict.fromkeys(SECTORS, 0.0)  # time on each course
        self._newest_ns: int | None = None
        self._shown_s = 0.0
        self._squared_speeds, self._n_speeds = 0.0, 0
        self._worth, self._remaining = RecentWorth(), RemainingTime()
        self._outlook: Outlook | None = None
        self._planned_s = self._planned_shown_s = -math.inf  # when `_outlook` was computed: by the clock, by DVL stamps

    def values(
        self,
        calibrator: Calibrator,
        estimate: Estimate,
        counts: Mapping[str, Mapping[str, int]],
        now_s: float,
        rejected: bool = False,
    ) -> dict[str, str]:
        """Return values by key of /diagnostics. rejected: whether a replay would reject the calibration."""
        return {
            "elapsed [s]": f"{now_s - self._began_s:.0f}",
            **self._streams({name: counts[name]["received"] for name in _STREAMS}, now_s),
            **_mounting(calibrator, estimate),
            **self._next(calibrator, estimate, now_s, rejected),
            **{f"driven {name} [s]": f"{seconds:.0f}" for name, seconds in self._driven_s.items()},
        }

    def _streams(self, received: Mapping[str, int], now_s: float) -> dict[str, str]:
        """Return rates and ages of the streams."""
        before_s, before = self._received[0] if self._received else (now_s, received)
        last = self._received[-1][1] if self._received else dict.fromkeys(received, 0)
        values = {}
        for stream, count in received.items():
            if count != last[stream]:
                self._came_s[stream] = now_s
            name, elapsed = _STREAMS[stream], now_s - before_s
            values[f"{name} rate [Hz]"] = f"{max(count - before[stream], 0) / elapsed:.1f}" if elapsed > 0.0 else "-"
            values[f"{name} age [s]"] = f"{now_s - self._came_s[stream]:.0f}" if stream in self._came_s else "-"
        self._received.append((now_s, received))
        return values

    def _dvl_time_step(self, newest_ns: int | None) -> float:
        """Return the DVL time since the last look, s."""
        before_ns, self._newest_ns = self._newest_ns, newest_ns
        if before_ns is None or newest_ns is None:
            return 0.0
        return min(max(1e-9 * (newest_ns - before_ns), 0.0), STANDS_S / LEAST_LOOKS)

    def _next(self, calibrator: Calibrator, estimate: Estimate, now_s: float, rejected: bool) -> dict[str, str]:
        """Update drift, goals and remaining time; return them as values of the diagnostics."""
        parameters, model = calibrator.parameters, MODELS[estimate.model]
        motion, step = calibrator.latest_motion(), self._dvl_time_step(calibrator.last_ns)
        self._shown_s += step
        if motion is not None and motion.speed > 0.0:
            self._squared_speeds, self._n_speeds = self._squared_speeds + motion.speed**2, self._n_speeds + 1
            if motion.heading is not None:
                sector = round((90.0 - math.degrees(motion.heading)) / 45.0) % len(SECTORS)
                self._driven_s[SECTORS[sector]] += step
        target, worth = parameters.target_drift, self._worth
        predicted = predicted_drift(model, estimate.velocity_covariance, parameters)
        drift = worth.add(model.name, predicted, target, self._shown_s, rejected)
        if rejected:
            plan = Outlook(finding("NEXT_REJECTED"), None)
        elif worth.is_good:
            plan = Outlook(is_good_enough(model), None)
        elif predicted.both <= target:
            plan = Outlook(finding("NEXT_STANDS"), worth.seconds_left(self._shown_s))
        elif calibrator.selection.keeps_full(parameters):
            plan = Outlook(finding("NEXT_REFERENCE", model=model.name), None)
        else:
            plan = self._suggestion(calibrator, estimate, motion, now_s)
        remaining = None
        if rejected or worth.is_good:
            self._remaining = RemainingTime()
        elif plan.next.code != "NEXT_WAIT":  # a standing vehicle keeps its last prediction
            remaining = self._remaining.add(plan.seconds, drift.both, self._shown_s)
        initial = KM * parameters.initial_std_misalignment, KM * parameters.initial_std_scale
        goal = PredictedDrift.goals(parameters)
        goals = {
            "side": _progress_percent(drift.side, initial[0], goal.side),
            "ahead": _progress_percent(drift.ahead, initial[1], goal.ahead),
            "worth": 100.0 if worth.is_good else min(_progress_percent(drift.both, math.hypot(*initial), target), 99.0),
        }
        return {
            "worth": f"{drift.both:.2f}",
            "worth to the side": f"{drift.side:.2f}",
            "worth ahead": "-" if math.isnan(drift.ahead) else f"{drift.ahead:.2f}",
            "target": f"{target:g}",
            **{f"goal {name} [%]": f"{share:.0f}" for name, share in goals.items() if not math.isnan(share)},
            "taken back": "" if worth.taken_back is None else worth.taken_back.sentence,
            "next": plan.next.sentence,
            "next code": plan.next.code,
            "seconds": "-" if remaining is None else f"{remaining:.0f}",
            "seconds spread": "-" if remaining is None else f"{SPREAD * remaining:.0f}",
            "longer": "" if self._remaining.longer is None else self._remaining.longer.sentence,
        }

    def _suggestion(
        self, calibrator: Calibrator, estimate: Estimate, motion: RecentMotion | None, now_s: float
    ) -> Outlook:
        """Return the suggested manoeuvre, computed again after `REPLANNED_EVERY_S`."""
        if self._outlook is None or now_s - self._planned_s >= REPLANNED_EVERY_S:
            self._planned_s, self._planned_shown_s = now_s, self._shown_s
            parameters, mean_square = calibrator.parameters, self._squared_speeds / max(self._n_speeds, 1)
            first_ns, last_ns = calibrator.first_ns, calibrator.last_ns
            seconds = 0.0 if first_ns is None or last_ns is None else 1e-9 * (last_ns - first_ns)
            noise = noise_of_a_second(estimate, parameters, seconds, mean_square)
            standing = RecentMotion(0.0, None, False, noise)
            usual_motion = standing if motion is None else motion._replace(noise=noise)
            if usual_motion.speed > 0.0:  # if the vehicle slows down in a turn, its usual speed
                usual_motion = usual_motion._replace(speed=max(usual_motion.speed, math.sqrt(mean_square)))
            self._outlook = outlook(estimate, parameters, usual_motion, self._outlook and self._outlook.next)
        planned, since = self._outlook.seconds, self._shown_s - self._planned_shown_s
        return self._outlook._replace(seconds=None if planned is None else max(planned - since, 0.0) + STANDS_S)


def _progress_percent(drift: float, unknown: float, target: float) -> float:
    """Return the progress from the initial uncertainty to the target on a logarithmic scale, per cent; nan if never."""
    if drift <= target or math.isnan(drift):
        return 100.0 if drift <= target else math.nan
    return max(0.0, min(99.0, 100.0 * math.log(unknown / drift) / max(math.log(unknown / target), 1e-9)))


def _mounting(calibrator: Calibrator, estimate: Estimate) -> dict[str, str]:
    """Return the mounting as in a URDF, scale and delay; no σ for a quantity that the model does not estimate."""
    parameters, model = calibrator.parameters, MODELS[estimate.model]
    angles = np.degrees(corrected_rpy(estimate.misalignment, parameters))
    stds = np.degrees(rpy_std(estimate.misalignment, estimate.covariance, parameters))
    named = zip(("roll", "pitch", "yaw"), angles, stds, strict=True)
    quantities = {name: (angle, angle_std, "deg") for name, angle, angle_std in named}
    arm = estimate.lever_arm(parameters.lever_arm)
    arm_std = estimate.std_of("lever_arm_x", "lever_arm_y", "lever_arm_z")
    for index, axis in enumerate("xyz"):
        quantities[f"arm {axis}"] = (arm[index], math.nan if arm_std is None else arm_std[index], "m")
    scale_delay = scale_and_delay(model, GaussianState(estimate.state, estimate.covariance), parameters)
    quantities["scale"] = (100.0 * scale_delay.scale, 100.0 * (scale_delay.scale_std or math.nan), "%")
    quantities["delay"] = (scale_delay.time_offset, scale_delay.time_offset_std or math.nan, "s")
    values = {}
    for name, (value, std, unit) in quantities.items():
        values[f"mounting {name} [{unit}]"] = f"{value:.3f}"
        values[f"sigma mounting {name} [{unit}]"] = "not estimated" if math.isnan(std) else f"{std:.3f}"
    return values
