"""A hypothesis: effects with the values of their parameters, and the calibration beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ...calibration.numerics.frames import Array
from ...effects.base import Effect, EffectParameter, EffectWithMemory
from ...effects.composition import Injection

Values = Mapping[str, float]
# Effects of which every vehicle has a little: where its DVL sits, and the DVL's bias
OF_EVERY = "lever_arm", "velocity_bias"


def is_time_of_run(spec: EffectParameter) -> bool:
    """Whether a parameter is a time at which an effect begins or ends."""
    return spec.unit == "s" and not np.isfinite(spec.high)


def amplitudes(effect: Effect) -> list[EffectParameter]:
    """Parameters with a derivative: all but times of the run."""
    return [spec for spec in effect.parameters if not is_time_of_run(spec)]


def whose_parameters(effect: Effect, n_recordings: int) -> list[int | None]:
    """Recordings that have parameters of their own for an effect; [None] if all share them."""
    if not effect.of_the_day or n_recordings == 1:
        return [None]
    return list(range(1 if effect.relative_to_first else 0, n_recordings))


@dataclass(frozen=True)
class Parameter:
    """One number that is fitted. recording: whose, None for all (of the vehicle)."""

    effect: Effect
    spec: EffectParameter
    recording: int | None


@dataclass(frozen=True)
class Hypothesis:
    """A calibration and effects with their values, per recording. phi: (3,) rad, scale: (3,), DVL frame."""

    phi: Array
    scale: Array
    effects: tuple[Effect, ...] = ()
    values: Mapping[str, tuple[Values, ...]] = field(default_factory=dict)

    def injections(self, recording: int) -> list[Injection]:
        """The effects as one recording has them."""
        return [Injection(effect, self.values[effect.name][recording]) for effect in self.effects]

    def lags(self, recording: int) -> list[tuple[EffectWithMemory, Values]]:
        """The effects of one recording with a memory, and their values."""
        with_memory = [effect for effect in self.effects if isinstance(effect, EffectWithMemory)]
        return [(effect, self.values[effect.name][recording]) for effect in with_memory]

    @property
    def without_memory(self) -> Hypothesis:
        """The same without effects that have one."""
        return replace(self, effects=tuple(each for each in self.effects if not isinstance(each, EffectWithMemory)))

    def parameters(self) -> list[Parameter]:
        """What is fitted beside the calibration, in order."""
        return [each for effect in self.effects for each in self.parameters_of(effect)]

    def parameters_of(self, effect: Effect) -> list[Parameter]:
        """Those of one effect: of the vehicle once, of the day for every recording."""
        each = self.values[effect.name]
        whose = whose_parameters(effect, len(each))
        return [Parameter(effect, spec, recording) for recording in whose for spec in amplitudes(effect)]

    def value(self, parameter: Parameter) -> float:
        """The value of one."""
        return self.values[parameter.effect.name][parameter.recording or 0][parameter.spec.name]

    def vector(self) -> Array:
        """(6 + p,) φ, δk and all values."""
        return np.concatenate([self.phi, self.scale, [self.value(each) for each in self.parameters()]])

    def moved(self, step: Array) -> Hypothesis:
        """A step (6 + p,) on, within the bounds of each parameter."""
        values = {name: [dict(each) for each in per] for name, per in self.values.items()}
        for parameter, change in zip(self.parameters(), step[6:].tolist(), strict=True):
            spec = parameter.spec
            per = values[parameter.effect.name]
            for recording in range(len(per)) if parameter.recording is None else [parameter.recording]:
                per[recording][spec.name] = float(np.clip(per[recording][spec.name] + change, spec.low, spec.high))
        return replace(
            self,
            phi=self.phi + step[:3],
            scale=self.scale + step[3:6],
            values={name: tuple(per) for name, per in values.items()},
        )

    def with_effects(self, effects: Sequence[Effect], n: int, start: Mapping[str, tuple[Values, ...]]) -> Hypothesis:
        """Of other effects, with values of `start`, else their own, else the defaults; of n recordings.

        What a value has no word of, as a leap that came once has none of a second, is at its default.
        """
        given = {effect.name: start.get(effect.name) or self.values.get(effect.name) or ({},) * n for effect in effects}
        values = {effect.name: tuple({**effect.defaults, **each} for each in given[effect.name]) for effect in effects}
        return replace(self, effects=tuple(effects), values=values)

    def body_from_measured(self, rotation_dvl_from_body: Array, turn: Array | None = None) -> Array:
        """D⁻¹ (3, 3), or (N, 3, 3) if what the mounting is turned on top of φ is (N, 3)."""
        angles = self.phi if turn is None else self.phi + turn
        turned = Rotation.from_rotvec(angles).as_matrix() @ rotation_dvl_from_body
        return np.swapaxes(turned, -1, -2) / (1.0 + self.scale)


def no_effect(phi: Array | None = None, scale: Array | None = None) -> Hypothesis:
    """A calibration alone, by default none."""
    return Hypothesis(np.zeros(3) if phi is None else phi, np.zeros(3) if scale is None else scale)
