"""The calibration of one DVL: feed it samples, read estimates.

    feed_dvl ──► valid? ──► in order? ──► angular velocity ──► speed, turn ──┬─► models that need nothing else
                                          (from IMU track)                   ├─► attitude (from IMU track) ──► models
    feed_reference ─► valid? ─► in order? ─► track                           │   that need it
    feed_imu ───────► valid? ─► in order? ─► track                           └─► reference (from its track) ──► models
                                                                                 with GNSS, automatic selection

The node, the replay and the evaluation all use this class; only `block_size` differs, and that changes nothing but the
speed.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar

import numpy as np

from .bank import ModelBank, nis_bounds
from .clocks import Clocks
from .folds import Moments, folds_of
from .frames import ENU_FROM_NED, Array, Quaternion, Vector, rotation_from_quaternion, slerp
from .kalman import GaussianState, Mask
from .models import MODELS, Needs
from .observability import convergence, observability
from .observations import Assumptions, Observations
from .parameters import ParameterError, Parameters
from .results import Estimate, Result
from .samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from .screening import CovarianceScreen, is_valid_velocity, unit_quaternion
from .selection import Selection
from .streams import Bracket, Order, S, Sequencer, Track
from .verification import Verification, held_out_error, verify

SECOND_NS = 1_000_000_000
# A DVL that sends nothing for so long, and for so many times its shortest interval, has dropped out.
DROPOUT_NS = SECOND_NS
DROPOUT_INTERVALS = 3
# How much of the past of GNSS and IMU is kept for a DVL that lags them, beyond what pairing waits for.
RETENTION_NS = 10 * SECOND_NS
NEVER_NS = 2**63 - 1
V = TypeVar("V")


class _Moving(NamedTuple):
    """A DVL sample on its way to the models, stamps compensated for dvl_time_offset."""

    stamp_ns: int
    velocity: Vector
    covariance: Array | None
    interval_ns: int  # since the DVL sample before
    usable: bool = True
    angular_velocity: Vector | None = None


class _Oriented(NamedTuple):
    """A DVL sample with the vehicle's attitude (ENU from body) and angular velocity (rad/s, body)."""

    sample: _Moving
    orientation: Quaternion
    angular_velocity: Vector


class _Paired(NamedTuple):
    """A DVL sample with its reference velocity, in the body or, with an orientation, in ENU or NED."""

    sample: _Moving
    velocity: Vector
    covariance: Array | None
    weight: float
    frame: VelocityFrame
    orientation: Quaternion | None
    around_s: tuple[float, float]  # since the reference sample before, until the one after


class _Block(NamedTuple):
    """What `ModelBank.update` takes: stamps (N), observations, weight (N,), whether the prior was known (N,)."""

    stamps_ns: list[int]
    seen: Observations
    weight: Array
    prior_known: Mask


def _block(
    samples: list[_Moving], seen: Observations, weight: Array | None = None, prior_known: Mask | None = None
) -> _Block:
    n = len(samples)
    stamps_ns = [sample.stamp_ns for sample in samples]
    weight = np.ones(n) if weight is None else weight
    return _Block(stamps_ns, seen, weight, np.ones(n, dtype=bool) if prior_known is None else prior_known)


class Calibrator:
    """Calibrates with all models at once, see the module's picture.

    prior_sway_heave: prior for ``prior_source: reference`` (m/s), found by the caller. initial: states to start from,
    by model name. block_size: samples that are gathered before the models are updated, if nobody asks for their state
    earlier. on_event: told of restarts in words. on_block: told of every block that the models are given, its stamps
    (ns) and observations; those with a reference are the paired ones. verified: keep what hold-out verification needs.
    """

    def __init__(
        self,
        parameters: Parameters,
        *,
        prior_sway_heave: tuple[float, float] | None = None,
        initial: Mapping[str, GaussianState] | None = None,
        block_size: int = 1,
        on_event: Callable[[str], None] = lambda _: None,
        on_block: Callable[[Sequence[int], Observations], None] = lambda *_: None,
        verified: bool = False,
    ) -> None:
        if parameters.prior_source == "reference" and prior_sway_heave is None:
            raise ParameterError("prior_source: reference needs recorded data; live, use fixed or initial_window")
        self.parameters = parameters
        self._prior_sway_heave = prior_sway_heave
        self._initial = initial
        self._block_size = block_size
        self._on_event = on_event
        self._on_block = on_block
        self._verified = verified
        self._clocks = Clocks.of(parameters)
        self._dvl_covariance, self._reference_covariance = CovarianceScreen(), CovarianceScreen()
        self._lever_arm: Vector | None = (
            tuple(parameters.lever_arm) if any(parameters.lever_arm) else None  # type: ignore[assignment]
        )
        self._needs_turn_rate = self._lever_arm is not None or parameters.max_turn_rate > 0.0
        self._assumptions = Assumptions(*(getattr(parameters, name) for name in Assumptions._fields))
        self._aided_noise = np.eye(3)[None] * parameters.gnss_aided_std**2
        self._unaided_noise = np.eye(3)[None] * parameters.gnss_free_std**2
        self.reset()

    # ------------------------------------------------------------------ state

    def reset(self) -> None:
        """Forget all samples and what was learnt from them."""
        p = self.parameters
        self.restarts = 0
        jump_ns = self._max_jump_ns = round(p.max_time_jump * 1e9)
        self._first_stamp_ns: int | None = None
        # one stream that is stamped late lags the others by as much once that is put right
        latency_ns = round(p.max_latency * 1e9) + self._clocks.spread_ns
        gnss_ns, imu_ns = round(p.gnss_timeout * 1e9), round(p.imu_timeout * 1e9)
        retention_ns = RETENTION_NS + gnss_ns + imu_ns + latency_ns
        self._dvl_order: Sequencer[DvlSample] = Sequencer(jump_ns)
        self._reference_order: Sequencer[ReferenceSample] = Sequencer(jump_ns)
        self._imu_order: Sequencer[ImuSample] = Sequencer(jump_ns)
        self._reference: Track[ReferenceSample] = Track(gnss_ns, latency_ns, retention_ns)
        self._imu: Track[ImuSample] = Track(imu_ns, latency_ns, retention_ns)
        self._tally: dict[str, Counter[str]] = {name: Counter() for name in ("dvl", "reference", "imu", "pairing")}
        # those of a stream's counters that refused messages are under
        self.refused_as: dict[str, set[str]] = {name: set() for name in ("dvl", "reference", "imu")}
        # streams that still bring samples from before a restart of the DVL's stamps
        self._before_restart: set[str] = set()
        self._forget_dvl()

    def _forget_dvl(self) -> None:
        self.selection = Selection()
        self._banks = {
            needs: ModelBank(
                [m for m in MODELS.values() if m.needs is needs], self.parameters, self._initial, self._verified
            )
            for needs in Needs
        }
        self._moments = Moments()
        self._awaiting_imu: deque[_Moving] = deque()
        self._awaiting_attitude: deque[_Moving] = deque()
        self._awaiting_reference: deque[_Moving] = deque()
        # found for the models that need attitude, until the reference of the same sample has been turned by it
        self._orientation_at: dict[int, Quaternion | None] = {}
        # what the models with these needs will be given next
        self._plain: list[tuple[_Moving, bool]] = []
        self._oriented: list[_Oriented] = []
        self._paired: list[_Paired] = []
        # what the first waiting DVL samples wait for: samples on these tracks, or any stream's stamp reaching this
        self._blocked_by: tuple[Track[Any], ...] = ()
        self._deadline_ns = NEVER_NS
        self._first_ns: int | None = None
        self.last_ns: int | None = None
        self._shortest_interval_ns = NEVER_NS
        self.longest_dropout_ns = 0
        self._velocity_before: Vector | None = None
        self._repeats = 0
        self._decided_ns: int | None = None
        self._prior = _PriorWindow(self.parameters, self._prior_sway_heave)

    # ------------------------------------------------------------------ input

    def feed_dvl(self, sample: DvlSample) -> DvlSample | None:
        """Take a DVL sample; None unless it is valid and in order, else as it goes on: in time, covariance screened."""
        tally = self._tally["dvl"]
        tally["received"] += 1
        valid, covariance = self._dvl_covariance(sample.covariance)
        if not valid or not is_valid_velocity(sample.velocity, self.parameters.max_speed):
            tally["invalid"] += 1
            return None
        if self._first_stamp_ns is None:
            self._first_stamp_ns = sample.stamp_ns
        true_ns = self._clocks.dvl(sample.stamp_ns, self._first_stamp_ns)
        sample = DvlSample(true_ns, sample.velocity, covariance)
        order, admitted = self._dvl_order.admit(sample)
        self._count_order(tally, order)
        if order is Order.CONFIRMED_RESTART:
            self._restart(admitted[0].stamp_ns)
        for one in admitted:
            interval_ns = 0 if self.last_ns is None else one.stamp_ns - self.last_ns
            self.last_ns = one.stamp_ns
            if self._first_ns is None:
                self._first_ns = one.stamp_ns
            else:
                self._note_interval(interval_ns)
            self._awaiting_imu.append(_Moving(one.stamp_ns, one.velocity, one.covariance, interval_ns))
        if not admitted:
            return None
        self._advance()
        return sample

    def _note_interval(self, interval_ns: int) -> None:
        """Count it if it is a dropout. `longest_dropout_ns` is the longest since the start or the last restart."""
        self._shortest_interval_ns = shortest_ns = min(self._shortest_interval_ns, interval_ns)
        if interval_ns > DROPOUT_NS and interval_ns > DROPOUT_INTERVALS * shortest_ns:
            self._tally["dvl"]["dropouts"] += 1
            self.longest_dropout_ns = max(self.longest_dropout_ns, interval_ns)

    def feed_reference(self, sample: ReferenceSample) -> None:
        """Take a reference (GNSS) velocity."""
        tally = self._tally["reference"]
        tally["received"] += 1
        valid, covariance = self._reference_covariance(sample.covariance)
        if not valid or not is_valid_velocity(sample.velocity, self.parameters.max_speed):
            tally["invalid"] += 1
            return
        stamp_ns = sample.stamp_ns - self._clocks.reference_ns
        if self._decided_ns is not None and stamp_ns < self._decided_ns:
            tally["late"] += 1  # a DVL sample has gone on without it: max_latency is too short
        if covariance is not sample.covariance or stamp_ns != sample.stamp_ns:
            sample = ReferenceSample(stamp_ns, sample.velocity, covariance, sample.frame)
        self._keep("reference", self._reference_order, self._reference, sample)

    def feed_imu(self, sample: ImuSample) -> None:
        """Take attitude and angular velocity."""
        tally = self._tally["imu"]
        tally["received"] += 1
        stamp_ns, given, angular_velocity = sample
        orientation = unit_quaternion(given)
        if angular_velocity is not None:
            x, y, z = angular_velocity
            if not math.isfinite(x + y + z):
                angular_velocity = None
        if orientation is None and angular_velocity is None:
            tally["invalid"] += 1
            return
        stamp_ns -= self._clocks.imu_ns
        if (stamp_ns, orientation, angular_velocity) != sample:
            sample = ImuSample(stamp_ns, orientation, angular_velocity)
        self._keep("imu", self._imu_order, self._imu, sample)

    def refuse(self, stream: str, reason: str) -> None:
        """Count a message of a stream (dvl, reference, imu) that could not be made a sample of, and why."""
        self.refused_as[stream].add(reason)
        self._tally[stream]["received"] += 1
        self._tally[stream][reason] += 1

    def _keep(self, name: str, sequencer: Sequencer[S], track: Track[S], sample: S) -> None:
        """Put a sample on its track if its stamp allows, and let waiting DVL samples go on if it decides them."""
        if not self._before_restart and sequencer.goes_on(sample.stamp_ns):
            track.append(sample)
        elif not self._keep_unusual(name, sequencer, track, sample):
            return
        if sample.stamp_ns >= self._deadline_ns or track in self._blocked_by:
            self._advance()

    def _keep_unusual(self, name: str, sequencer: Sequencer[S], track: Track[S], sample: S) -> bool:
        """`_keep` for what is not simply the next sample; whether the track has grown."""
        order, admitted = sequencer.admit(sample)
        self._count_order(self._tally[name], order)
        if order is Order.CONFIRMED_RESTART:
            track.clear()
            self._before_restart.discard(name)
        if name in self._before_restart and admitted:
            dvl_ns = self._dvl_order.last_ns or 0
            if admitted[-1].stamp_ns > dvl_ns + self._max_jump_ns:
                self._tally[name]["before_restart"] += len(admitted)
                return False
            self._before_restart.discard(name)
        for one in admitted:
            track.append(one)
        return bool(admitted)

    @staticmethod
    def _count_order(tally: Counter[str], order: Order) -> None:
        if order in (Order.DUPLICATE, Order.OUT_OF_ORDER):
            tally[order.value] += 1

    def _restart(self, stamp_ns: int) -> None:
        """DVL stamps went back: a bag loops, or the clock was set. Start anew with this sample."""
        self.restarts += 1
        dvl_order = self._dvl_order
        back = (self.last_ns or stamp_ns) - stamp_ns
        self._on_event(f"DVL stamps went back by {back * 1e-9:.1f} s: the calibration starts anew")
        self._tally["dvl"] = Counter(received=2)  # the two samples that showed it
        for name in ("reference", "imu", "pairing"):
            self._tally[name].clear()
        dvl_order.stray = 0
        self._forget_dvl()
        # a stream that has not gone back yet brings what must not be paired with what comes now
        for name, track in (("reference", self._reference), ("imu", self._imu)):
            if track.newest_ns is not None and track.newest_ns > stamp_ns + self._max_jump_ns:
                track.clear()
                self._before_restart.add(name)

    # ------------------------------------------------------------------ pairing

    def _advance(self) -> None:
        """Let DVL samples go on as far as their partners are decided; note what the next ones wait for."""
        horizon_ns = self._horizon_ns()
        self._blocked_by = ()
        self._deadline_ns = NEVER_NS
        while self._awaiting_imu:
            sample = self._awaiting_imu[0]
            if self._needs_turn_rate and not self._is_decided(self._imu, sample.stamp_ns, horizon_ns):
                break
            self._awaiting_imu.popleft()
            self._take_plain(sample)
        while self._awaiting_attitude:
            sample = self._awaiting_attitude[0]
            if not self._is_decided(self._imu, sample.stamp_ns, horizon_ns):
                break
            self._awaiting_attitude.popleft()
            self._take_oriented(sample)
        while self._awaiting_reference:
            sample = self._awaiting_reference[0]
            if not self._is_decided(self._reference, sample.stamp_ns, horizon_ns):
                break
            bracket = self._reference.bracket(sample.stamp_ns)
            in_earth_frame = bracket is not None and bracket.after.frame is not VelocityFrame.BODY
            if in_earth_frame and not self._is_decided(self._imu, sample.stamp_ns, horizon_ns):
                break
            self._awaiting_reference.popleft()
            self._decided_ns = sample.stamp_ns
            self._take_paired(sample, bracket)
        size = self._block_size
        if len(self._plain) >= size:
            self._update(Needs.NOTHING)
        if len(self._oriented) >= size:
            self._update(Needs.ATTITUDE)
        if len(self._paired) >= size:
            self._update(Needs.REFERENCE)

    def _horizon_ns(self) -> int:
        """Newest stamp of any stream that keeps the DVL's time.

        One whose clock is far ahead would say of every DVL sample that nothing can come for it any more.
        """
        dvl_ns = self._dvl_order.last_ns or 0
        tracks_ns = (self._reference.newest_ns or 0, self._imu.newest_ns or 0)
        return max((ns for ns in tracks_ns if dvl_ns < ns <= dvl_ns + self._max_jump_ns), default=dvl_ns)

    def _is_decided(self, track: Track[Any], stamp_ns: int, horizon_ns: int) -> bool:
        """Whether a DVL sample need not wait for a track any more; if it must, note for what and until when."""
        if track.decided(stamp_ns, horizon_ns):
            return True
        self._blocked_by = (*self._blocked_by, track)
        self._deadline_ns = min(self._deadline_ns, track.deadline_ns(stamp_ns))
        return False

    def _take_plain(self, sample: _Moving) -> None:
        if self._needs_turn_rate:
            sample = sample._replace(
                angular_velocity=_interpolated(self._imu.bracket(sample.stamp_ns), _ANGULAR_VELOCITY, _mix)
            )
        unusable = self._unusable(sample)
        if unusable is None:
            if self._lever_arm is not None and sample.angular_velocity is None:
                self._tally["dvl"]["lever_arm_uncompensated"] += 1
            prior_known = self._prior.known_at(sample.stamp_ns, sample.velocity)
            self._plain.append((sample, prior_known))
            self._awaiting_attitude.append(sample)
        else:
            self._tally["dvl"][unusable] += 1
            sample = sample._replace(usable=False)
        self._awaiting_reference.append(sample)

    def _unusable(self, sample: _Moving) -> str | None:
        """Why a valid sample is not used, as its counter's name, or None."""
        p = self.parameters
        x, y, z = sample.velocity
        if x * x + y * y + z * z < p.min_speed * p.min_speed:
            return "slow"
        if self._is_frozen(sample.velocity):
            return "frozen"
        if p.max_turn_rate > 0.0:
            if sample.angular_velocity is None:
                return "no_turn_rate"
            x, y, z = sample.angular_velocity
            if x * x + y * y + z * z > p.max_turn_rate * p.max_turn_rate:
                return "turning"
        return None

    def _is_frozen(self, velocity: Vector) -> bool:
        """Whether a velocity has been repeated, to the last bit, more often than max_repeats allows."""
        if velocity != self._velocity_before:
            self._velocity_before, self._repeats = velocity, 0
            return False
        self._repeats += 1
        self._tally["dvl"]["repeated"] += 1
        return 0 < self.parameters.max_repeats < self._repeats

    def _take_oriented(self, sample: _Moving) -> None:
        bracket = self._imu.bracket(sample.stamp_ns)
        orientation = _interpolated(bracket, _ORIENTATION, slerp)
        rate = _interpolated(bracket, _ANGULAR_VELOCITY, _mix)
        if self._decided_ns is None or sample.stamp_ns > self._decided_ns:  # its reference is still to come
            self._orientation_at[sample.stamp_ns] = orientation
        if orientation is None or rate is None:
            self._tally["pairing"]["not_oriented"] += 1
            return
        self._tally["pairing"]["oriented"] += 1
        self._oriented.append(_Oriented(sample, orientation, rate))

    def _take_paired(self, sample: _Moving, bracket: Bracket[ReferenceSample] | None) -> None:
        paired = None if bracket is None else self._pair(sample, bracket)
        self._tally["pairing"]["paired" if paired else "unpaired"] += 1
        self._orientation_at.pop(sample.stamp_ns, None)
        self.selection.update(sample.stamp_ns, paired is not None, self.parameters)
        if paired is not None and sample.usable:
            self._paired.append(paired)

    def _pair(self, sample: _Moving, bracket: Bracket[ReferenceSample]) -> _Paired | None:
        before, after, fraction = bracket
        velocity, covariance = after.velocity, after.covariance
        if fraction != 1.0:
            assert before is not None
            if before.frame is not after.frame:
                return None
            velocity = _mix(before.velocity, after.velocity, fraction)
            # The mean of two samples is less noisy than each, but its neighbours share them: over a run a reference
            # sample carries its own information once, which is what the plain mean of the covariances gives.
            if before.covariance is None or after.covariance is None:
                covariance = None
            elif before.covariance is not after.covariance:
                covariance = (1.0 - fraction) * before.covariance + fraction * after.covariance
        weight = 1.0
        if before is not None and sample.interval_ns > 0:
            weight = 1.0 / max(1, round((after.stamp_ns - before.stamp_ns) / sample.interval_ns))
        orientation = None
        if after.frame is not VelocityFrame.BODY:
            orientation = self._orientation(sample.stamp_ns)
            if orientation is None:
                self._tally["pairing"]["without_attitude"] += 1
                return None
        around_s = (0.0, 0.0)
        if fraction != 1.0 and before is not None:
            around_s = (1e-9 * (sample.stamp_ns - before.stamp_ns), 1e-9 * (after.stamp_ns - sample.stamp_ns))
        return _Paired(sample, velocity, covariance, weight, after.frame, orientation, around_s)

    def _orientation(self, stamp_ns: int) -> Quaternion | None:
        if stamp_ns in self._orientation_at:
            return self._orientation_at[stamp_ns]
        return _interpolated(self._imu.bracket(stamp_ns), _ORIENTATION, slerp)

    # ------------------------------------------------------------------ models

    def _n_waiting(self, needs: Needs) -> int:
        if needs is Needs.NOTHING:
            return len(self._plain)
        return len(self._oriented if needs is Needs.ATTITUDE else self._paired)

    def _update(self, needs: Needs) -> None:
        """Give the models with these needs the samples that wait for them."""
        if not self._n_waiting(needs):
            return
        take = {
            Needs.NOTHING: self._block_of_plain,
            Needs.ATTITUDE: self._block_of_oriented,
            Needs.REFERENCE: self._block_of_paired,
        }
        block = take[needs]()
        self._on_block(block.stamps_ns, block.seen)
        self._banks[needs].update(*block)
        if self._verified and needs is Needs.REFERENCE:
            self._moments.add(folds_of(block.stamps_ns, self.parameters), block.seen)

    def _block_of_plain(self) -> _Block:
        block, self._plain = self._plain, []
        samples = [sample for sample, _ in block]
        known = np.array([known for _, known in block])
        return _block(samples, self._observations(samples), prior_known=known)

    def _block_of_oriented(self) -> _Block:
        block, self._oriented = self._oriented, []
        samples = [each.sample for each in block]
        seen = self._observations(
            samples,
            rotation_enu_from_body=rotation_from_quaternion(np.array([each.orientation for each in block])),
            angular_velocity=np.array([each.angular_velocity for each in block]),
        )
        return _block(samples, seen)

    def _block_of_paired(self) -> _Block:
        block, self._paired = self._paired, []
        samples = [each.sample for each in block]
        velocity = np.array([each.velocity for each in block])
        rotation = _body_from_reference(block)
        if rotation is not None:
            velocity = np.einsum("nij,nj->ni", rotation, velocity)
        seen = self._observations(
            samples,
            reference_body=velocity,
            noise=self._paired_covariance(block, rotation),
            reference_around=np.array([each.around_s for each in block]),
        )
        return _block(samples, seen, weight=np.array([each.weight for each in block]))

    def _observations(self, samples: list[_Moving], **paired_with: Any) -> Observations:
        """What models see of these samples; `paired_with`: the fields of `Observations` that come from elsewhere."""
        lever = None
        if self._lever_arm is not None:
            rates = np.array([sample.angular_velocity or (0.0, 0.0, 0.0) for sample in samples])
            lever = np.cross(rates, self._lever_arm)
        fields: dict[str, Any] = {"reference_body": None, "noise": self._unaided_noise} | paired_with
        return Observations(
            velocity_dvl=np.array([sample.velocity for sample in samples]),
            lever_velocity=lever,
            rotation_dvl_from_body=self.parameters.rotation_dvl_from_body,
            sway_heave=self._prior.sway_heave,
            interval=1e-9 * np.array([sample.interval_ns for sample in samples]),
            assumptions=self._assumptions,
            **fields,
        )

    def _paired_covariance(self, block: list[_Paired], body_from_reference: Array | None) -> Array:
        """R of the aided models (N or 1, 3, 3): T R_gnss Tᵀ + R_dvl where the messages give them."""
        given = [paired.covariance is not None for paired in block]
        if not self.parameters.use_message_covariance or not any(given):
            return self._aided_noise
        rotation = self.parameters.rotation_dvl_from_body
        rotation = rotation if body_from_reference is None else rotation @ body_from_reference
        unknown, dvl_unknown = self._aided_noise[0], self._unaided_noise[0]
        reference = np.array([unknown if paired.covariance is None else paired.covariance for paired in block])
        own = np.array([dvl_unknown if (cov := paired.sample.covariance) is None else cov for paired in block])
        noise = rotation @ reference @ np.swapaxes(rotation, -1, -2) + own
        return noise if all(given) else np.where(np.array(given)[:, None, None], noise, unknown)

    # ------------------------------------------------------------------ output

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Where the messages went, since the start or the last restart.

        dvl: received = invalid + duplicate + out_of_order + stray + held + refused ones (`refuse`) + accepted;
        accepted = slow + frozen + turning + no_turn_rate + usable + awaiting_imu; repeated and dropouts are counted
        beside these. pairing: accepted and decided = paired +
        unpaired; awaiting_reference is the rest. usable = oriented + not_oriented (no attitude or no angular velocity)
        + awaiting_attitude. A model's used + gated (+ samples in its prior window) is what it was given: usable
        samples, for the models with GNSS those that were paired, for those with attitude the oriented ones.
        """
        counts = {name: dict(tally) for name, tally in self._tally.items()}
        for name, order in (("dvl", self._dvl_order), ("reference", self._reference_order), ("imu", self._imu_order)):
            counts[name]["stray"] = order.stray
            counts[name]["held"] = int(order.held is not None)
            for key in ("received", "invalid", "duplicate", "out_of_order"):
                counts[name].setdefault(key, 0)
        dvl, pairing = counts["dvl"], counts["pairing"]
        unused = ("slow", "frozen", "turning", "no_turn_rate")
        for key in (*unused, "repeated", "dropouts", "wrong_frame"):
            dvl.setdefault(key, 0)
        for key in ("wrong_frame", "late"):
            counts["reference"].setdefault(key, 0)
        for key in ("paired", "unpaired", "without_attitude", "oriented", "not_oriented"):
            pairing.setdefault(key, 0)
        not_accepted = {"invalid", "duplicate", "out_of_order", "stray", "held", *self.refused_as["dvl"]}
        dvl["accepted"] = dvl["received"] - sum(dvl.get(key, 0) for key in not_accepted)
        dvl["awaiting_imu"] = len(self._awaiting_imu)
        dvl["usable"] = dvl["accepted"] - sum(dvl[key] for key in (*unused, "awaiting_imu"))
        pairing["gnss_losses"] = self.selection.gnss.losses
        pairing["awaiting_reference"] = len(self._awaiting_reference)
        pairing["awaiting_attitude"] = len(self._awaiting_attitude)
        counts["calibration"] = {"restarts": self.restarts}
        return counts

    @property
    def newest_ns(self) -> dict[str, int | None]:
        """Stamp of the newest sample of each stream; None before the first."""
        return {"dvl": self.last_ns, "reference": self._reference.newest_ns, "imu": self._imu.newest_ns}

    @property
    def selected(self) -> str:
        """Name of the selected model."""
        return self.selection.model(self.parameters)

    def set_parameters(self, parameters: Parameters) -> None:
        """Change parameters that can change at run time (`ParameterSpec.read_only` False)."""
        self.parameters = parameters
        if self._decided_ns is not None:
            self.selection.record(self._decided_ns, parameters)

    def n_given(self, name: str) -> int:
        """Number of samples that a model was given so far; it grows when there may be a new estimate."""
        needs = MODELS[name].needs
        return self._banks[needs].n_given + self._n_waiting(needs)

    def state(self, name: str) -> GaussianState:
        """State and covariance of one model."""
        needs = MODELS[name].needs
        self._update(needs)
        return self._banks[needs].state(name)

    def estimate(self, name: str | None = None) -> Estimate:
        """Estimate of one model, by default the selected one, with all that is known about it."""
        model = MODELS[name or self.selected]
        state, covariance = self.state(model.name)
        used, gated, mean_nis = self._banks[model.needs].counts(model.name)
        return Estimate(
            model=model.name,
            state=state,
            covariance=covariance,
            used=used,
            gated=gated,
            mean_nis=mean_nis,
            nis_bounds=nis_bounds(model, self.parameters, used),
            convergence=convergence(model, covariance, self.parameters),
            observability=observability(model, covariance, self.parameters),
        )

    def verification(self, name: str) -> Verification:
        """The verdict on one model's calibration, by hold-out; for a calibrator made with ``verified``."""
        estimate = self.estimate(name)
        model, state = MODELS[name], GaussianState(estimate.state, estimate.covariance)
        self._update(Needs.REFERENCE)
        held_out = held_out_error(
            model,
            self._banks[model.needs].states_without_folds(name),
            self._moments,
            self.parameters.rotation_dvl_from_body,
        )
        return verify(model, state, estimate.convergence, held_out, self.parameters)

    def latest_angular_velocity(self, stamp_ns: int) -> Vector | None:
        """Newest angular velocity (rad/s, body), if not older than imu_timeout: for output without delay."""
        newest = self._imu.newest
        if newest is None or abs(stamp_ns - newest.stamp_ns) > self.parameters.imu_timeout * 1e9:
            return None
        return newest.angular_velocity

    def result(self) -> Result:
        """Everything, as of now."""
        return Result(
            selected=self.selected,
            selected_because=self.selection.reason(self.parameters),
            estimates={name: self.estimate(name) for name in MODELS},
            segments=tuple(self.selection.segments),
            counts=self.counts,
            first_ns=self._first_ns,
            last_ns=self.last_ns,
            parameters=self.parameters.as_dict(),
            verifications={name: self.verification(name) for name in MODELS} if self._verified else {},
        )


class _PriorWindow:
    """Prior sway and heave of the models that need them."""

    def __init__(self, parameters: Parameters, given: tuple[float, float] | None) -> None:
        self._rotation_body_from_dvl = parameters.rotation_dvl_from_body.T
        self._window_ns = round(parameters.prior_window * 1e9)
        self._start_ns: int | None = None
        self._sum = np.zeros(2)
        self._count = 0
        self.sway_heave: Array = np.array(parameters.prior_sway_heave if given is None else given)
        self._collecting = parameters.prior_source == "initial_window"

    def known_at(self, stamp_ns: int, velocity_dvl: Vector) -> bool:
        """Whether the prior is known; until then, take the sample into its mean."""
        if not self._collecting:
            return True
        if self._start_ns is None:
            self._start_ns = stamp_ns
        if stamp_ns - self._start_ns >= self._window_ns:
            self._collecting = False
            self.sway_heave = self._sum / self._count
            return True
        self._sum += (self._rotation_body_from_dvl @ velocity_dvl)[1:]
        self._count += 1
        return False


_ORIENTATION, _ANGULAR_VELOCITY = attrgetter("orientation"), attrgetter("angular_velocity")


def _interpolated(
    bracket: Bracket[ImuSample] | None, read: Callable[[ImuSample], V | None], mix: Callable[[V, V, float], V]
) -> V | None:
    """What the IMU gives for a time; None where it has nothing to interpolate between."""
    if bracket is None:
        return None
    after = read(bracket.after)
    if bracket.fraction == 1.0 or bracket.before is None:
        return after
    before = read(bracket.before)
    return None if before is None or after is None else mix(before, after, bracket.fraction)


def _mix(a: Vector, b: Vector, fraction: float) -> Vector:
    return (
        a[0] + (b[0] - a[0]) * fraction,
        a[1] + (b[1] - a[1]) * fraction,
        a[2] + (b[2] - a[2]) * fraction,
    )


def _body_from_reference(block: list[_Paired]) -> Array | None:
    """Rotations (N, 3, 3) that take each reference velocity to the body frame; None if all are in it."""
    if all(paired.orientation is None for paired in block):
        return None
    # attitude is enu from body, so its transpose turns ENU into the body; the quaternion's conjugate is just that
    conjugates = [(-q[0], -q[1], -q[2], q[3]) if (q := p.orientation) else (0.0, 0.0, 0.0, 1.0) for p in block]
    rotation = rotation_from_quaternion(np.array(conjugates))
    is_ned = np.array([paired.frame is VelocityFrame.NED for paired in block])
    return np.where(is_ned[:, None, None], rotation @ ENU_FROM_NED, rotation) if is_ned.any() else rotation
