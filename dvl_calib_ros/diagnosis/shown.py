"""What of effects a reference that is horizontal shows, by the columns of their parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..effects.base import Effect
from .composed import Problem, Seen, Values, amplitudes, is_time_of_run, no_effect

# Of what an effect's best-shown parameter of its typical size does to what is compared: one that does less is left out,
# for what a model lacks does as much. A boat that rolls at 0.2°/s and turns at 3 shows no height of its DVL, an AUV at
# sea does; a vehicle that keeps level shows no bias upwards, and neither roll nor pitch of a mounting.
SHOWN_FROM = 0.2


def shown_parts(effects: Mapping[str, Effect], problem: Problem) -> dict[str, Effect]:
    """Effects without the parameters that references which do not measure the vertical do not show."""
    if problem.measured[2]:
        return dict(effects)
    seen = problem.all_seen(no_effect())
    return {name: _shown_part(each, problem, seen) for name, each in effects.items()}


def _shown_part(effect: Effect, problem: Problem, seen: Sequence[Seen]) -> Effect:
    specs = amplitudes(effect)
    columns = problem.columns(no_effect(), seen, effect, somewhere(effect, problem))
    of_each = (columns**2).sum(axis=(0, 1)).reshape(-1, len(specs)).max(axis=0)  # of days that which shows most
    sizes = np.sqrt(of_each) * [spec.typical for spec in specs]
    return effect.without({s.name for s, size in zip(specs, sizes, strict=True) if size < SHOWN_FROM * sizes.max()})


def somewhere(effect: Effect, problem: Problem) -> list[Values]:
    """Defaults, with what comes in the midst of the run where no time is given."""
    values: list[Values] = []
    for recording in problem.recordings:
        times = {
            spec.name: 0.5 * recording.seconds
            for spec in effect.parameters
            if is_time_of_run(spec) and not any(is_time_of_run(o) for o in effect.parameters if o is not spec)
        }
        values.append(effect.defaults | times)
    return values
