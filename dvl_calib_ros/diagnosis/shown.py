"""What of effects a reference that is horizontal shows, by the columns of their parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..effects.base import Effect
from .composed import Problem, Seen, Values, amplitudes, is_time_of_run, no_effect

# A parameter of its typical size that does less to what is compared than this share of what its effect's best-shown one
# does, or of a usual bias (m/s), is left out, for what a model lacks does as much. A boat that rolls at 0.2°/s shows no
# height of its DVL, an AUV at sea does at 1°/s; one that keeps level no bias upwards, nor roll and pitch of a mounting.
SHOWN_FROM, USUAL_MPS = 0.2, 0.02


def shown_parts(
    effects: Mapping[str, Effect], problem: Problem, guessed: Mapping[str, Values] | None = None
) -> dict[str, Effect]:
    """Effects without the parameters that references which do not measure the vertical do not show.

    guessed: of effects, how large a first guess has them. A height that does more than usual ones is shown by that.
    """
    if problem.measured[2]:
        return dict(effects)
    seen, guessed = problem.all_seen(no_effect()), guessed or {}
    return {name: _shown_part(each, problem, seen, guessed.get(name, {})) for name, each in effects.items()}


def _shown_part(effect: Effect, problem: Problem, seen: Sequence[Seen], guessed: Values) -> Effect:
    specs = amplitudes(effect)
    columns = problem.columns(no_effect(), seen, effect, somewhere(effect, problem))
    squares = (columns**2).sum(axis=1).mean(axis=0)
    of_each = squares.reshape(-1, len(specs)).max(axis=0)  # of days the one that shows most
    sizes = np.sqrt(of_each) * [max(spec.typical, abs(guessed.get(spec.name, 0.0))) for spec in specs]
    least = SHOWN_FROM * min(float(sizes.max()), USUAL_MPS)
    return effect.without({spec.name for spec, size in zip(specs, sizes, strict=True) if size < least})


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
