"""Effects on the noise that simulators or message covariances lack."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from ..calibration.numerics.frames import Array
from .base import ActsOn, Disturbance, EffectInput, EffectNeeds, EffectParameter, NoiseEffect

_SHARE = "share of the samples, 0 .. 1"


class Outliers(NoiseEffect):
    """Occasional samples with large errors."""

    name = "outliers"
    summary = "some DVL samples have large errors"
    parameters = (
        EffectParameter("share", "1", 0.01, 0.0, 1.0, _SHARE),
        EffectParameter(
            "std_mps", "m/s", 0.5, 0.0, 20.0, "standard deviation of what an outlier adds, per axis", 0.5, said="std"
        ),
    )
    acts_on = ActsOn.DVL

    def disturb(
        self, velocity: Array, motion: EffectInput, values: Mapping[str, float], rng: np.random.Generator
    ) -> Array:
        """Add normal errors to a share of the samples, on all axes together."""
        hit = rng.random(len(velocity)) < values["share"]
        return velocity + hit[:, None] * rng.normal(0.0, values["std_mps"], velocity.shape)

    def following(self, values: Mapping[str, float], rng: np.random.Generator) -> Disturbance:
        """Return `disturb` for consecutive batches; the probability is equal, the outliers are other samples."""
        return lambda velocity, motion: self.disturb(velocity, motion, values, rng)


class StaleSamples(NoiseEffect):
    """Occasional repetition of the previous sample with a new stamp."""

    name = "stale_samples"
    summary = "some DVL samples repeat the one before"
    parameters = (EffectParameter("share", "1", 0.05, 0.0, 1.0, _SHARE),)
    acts_on = ActsOn.DVL

    def following(self, values: Mapping[str, float], rng: np.random.Generator) -> Disturbance:
        """Return a function that remembers the last fresh sample."""
        last: Array = np.empty((0, 3))

        def disturbance(velocity: Array, motion: EffectInput) -> Array:
            """Replace a share of the samples (N, 3) by the fresh one before them."""
            nonlocal last
            stale = rng.random(len(velocity)) < values["share"]
            known = np.vstack([last, velocity])
            before = len(last)
            stale[: 1 - before] = False
            fresh = np.where(stale, 0, np.arange(before, len(known)))
            out: Array = known[np.maximum.accumulate(fresh)]
            last = out[-1:] if len(out) else last
            return out

        return disturbance


class NoiseInflation(NoiseEffect):
    """More white noise than the DVL reports, or noise that grows with speed or turn rate."""

    name = "noise_inflation"
    summary = "the DVL's noise is larger than reported, or grows with speed or turn rate"
    parameters = (
        EffectParameter("std_mps", "m/s", 0.02, 0.0, 10.0, "standard deviation added, per axis", said="std"),
        EffectParameter("per_speed", "1", 0.01, 0.0, 10.0, "its growth per m/s of speed", said="per speed"),
        EffectParameter(
            "per_turn_rate_m", "m", 0.1, 0.0, 100.0, "its growth per rad/s of turn rate", said="per turn rate"
        ),
    )
    acts_on = ActsOn.DVL
    needs = frozenset({EffectNeeds.ANGULAR_VELOCITY})

    def disturb(
        self, velocity: Array, motion: EffectInput, values: Mapping[str, float], rng: np.random.Generator
    ) -> Array:
        """Add white noise of std + per_speed · speed + per_turn_rate · ‖ω‖."""
        turn_rate = np.linalg.norm(motion.turn_rate, axis=1)
        std = values["std_mps"] + values["per_speed"] * motion.speed + values["per_turn_rate_m"] * turn_rate
        return velocity + std[:, None] * rng.standard_normal(velocity.shape)

    def following(self, values: Mapping[str, float], rng: np.random.Generator) -> Disturbance:
        """Return `disturb`: white noise needs no memory."""
        return lambda velocity, motion: self.disturb(velocity, motion, values, rng)


class ColouredReferenceNoise(NoiseEffect):
    """Slowly varying noise of the reference, for example by multipath."""

    name = "coloured_reference_noise"
    summary = "the reference's noise is correlated in time"
    parameters = (
        EffectParameter("std_mps", "m/s", 0.05, 0.0, 10.0, "standard deviation, per axis", said="std"),
        EffectParameter(
            "correlation_time_s", "s", 5.0, 0.0, 3600.0, "time in which it falls to 1/e", 5.0, said="correlation time"
        ),
    )
    acts_on = ActsOn.REFERENCE

    def following(self, values: Mapping[str, float], rng: np.random.Generator) -> Disturbance:
        """Return a function that remembers the last noise and its time."""
        tau = values["correlation_time_s"]
        last: tuple[float, Array] | None = None

        def disturbance(velocity: Array, motion: EffectInput) -> Array:
            """Add first-order Gauss-Markov noise to samples (N, 3) m/s."""
            nonlocal last
            noise = values["std_mps"] * rng.standard_normal(velocity.shape)
            if tau > 0.0:
                for i, time in enumerate(motion.time.tolist()):
                    if last is not None:
                        decay = math.exp(-(time - last[0]) / tau)
                        noise[i] = decay * last[1] + math.sqrt(1.0 - decay**2) * noise[i]
                    last = time, noise[i]
            return velocity + noise

        return disturbance
