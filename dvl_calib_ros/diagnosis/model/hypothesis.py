"""Hypothesis: effects with parameter values, and the calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...calibration.numerics.frames import Array
from ...effects.base import Effect, EffectParameter, EffectWithMemory, Injection

Values = Mapping[str, float]
# Effects that every vehicle has to a small degree: lever arm and velocity bias
OF_EVERY = "lever_arm", "velocity_bias"


def is_time_of_run(spec: EffectParameter) -> bool:
    """Return whether a parameter is the time at which an effect begins or ends."""
    return spec.unit == "s" and not np.isfinite(spec.high)


def amplitudes(effect: Effect) -> list[EffectParameter]:
    """Return parameters with a derivative: all but times of the run."""
    return [spec for spec in effect.parameters if not is_time_of_run(spec)]


def whose_parameters(effect: Effect, n_recordings: int) -> list[int | None]:
    """Return recordings with their own parameters for an effect; [None] if all share them."""
    if not effect.per_recording or n_recordings == 1:
        return [None]
    return list(range(1 if effect.relative_to_first else 0, n_recordings))


@dataclass(frozen=True)
class Parameter:
    """One fitted number. recording: its recording, None for all (of the vehicle)."""

    effect: Effect
    spec: EffectParameter
    recording: int | None


@dataclass(frozen=True)
class Hypothesis:
    """Calibration and effects with values per recording. phi: (3,) rad, scale: (3,), DVL frame."""

    phi: Array
    scale: Array
    effects: tuple[Effect, ...] = ()
    values: Mapping[str, tuple[Values, ...]] = field(default_factory=dict)

    def injections(self, recording: int) -> list[Injection]:
        """Return the effects with the values of one recording."""
        return [Injection(effect, self.values[effect.name][recording]) for effect in self.effects]

    def lags(self, recording: int) -> list[tuple[EffectWithMemory, Values]]:
        """Return the effects with a memory and their values in one recording."""
        with_memory = [effect for effect in self.effects if isinstance(effect, EffectWithMemory)]
        return [(effect, self.values[effect.name][recording]) for effect in with_memory]

    @property
    def without_memory(self) -> Hypothesis:
        """Return the hypothesis without effects with a memory."""
        return replace(self, effects=tuple(each for each in self.effects if not isinstance(each, EffectWithMemory)))

    def parameters(self) -> list[Parameter]:
        """Return the parameters after the calibration, in order."""
        return [each for effect in self.effects for each in self.parameters_of(effect)]

    def parameters_of(self, effect: Effect) -> list[Parameter]:
        """Return the parameters of one effect, once or for every recording."""
        each = self.values[effect.name]
        whose = whose_parameters(effect, len(each))
        return [Parameter(effect, spec, recording) for recording in whose for spec in amplitudes(effect)]

    def indices_of(self, name: str) -> NDArray[np.intp]:
        """Return the indices in `vector` of the parameters of an effect."""
        return 6 + np.flatnonzero([each.effect.name == name for each in self.parameters()])

    def value(self, parameter: Parameter) -> float:
        """Return the value of a parameter."""
        return self.values[parameter.effect.name][parameter.recording or 0][parameter.spec.name]

    def vector(self) -> Array:
        """Return φ, δk and all values, (6 + p,)."""
        return np.concatenate([self.phi, self.scale, [self.value(each) for each in self.parameters()]])

    def moved(self, step: Array) -> Hypothesis:
        """Return the hypothesis after a step (6 + p,), within the bounds of each parameter."""
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
        """Return the hypothesis with other effects for n recordings, with values of `start`, its own or the defaults.

        Missing parameters, for example of a second clock jump, have their default.
        """
        given = {effect.name: start.get(effect.name) or self.values.get(effect.name) or ({},) * n for effect in effects}
        values = {effect.name: tuple({**effect.defaults, **each} for each in given[effect.name]) for effect in effects}
        return replace(self, effects=tuple(effects), values=values)

    def body_from_measured(self, rotation_dvl_from_body: Array, turn: Array | None = None) -> Array:
        """Return D⁻¹ (3, 3), or (N, 3, 3) if the rotation in addition to φ is (N, 3)."""
        angles = self.phi if turn is None else self.phi + turn
        turned = Rotation.from_rotvec(angles).as_matrix() @ rotation_dvl_from_body
        return np.swapaxes(turned, -1, -2) / (1.0 + self.scale)


def no_effect(phi: Array | None = None, scale: Array | None = None) -> Hypothesis:
    """Return a hypothesis without effects, by default without calibration."""
    return Hypothesis(np.zeros(3) if phi is None else phi, np.zeros(3) if scale is None else scale)
