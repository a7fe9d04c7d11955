"""What the data say against a calibration beside its verdict on data held out: of a replay, and of a running node."""

from __future__ import annotations

from collections.abc import Iterable

from ...verdict.kinds import Severity
from ...verdict.reasons import Reason, finding
from ..checks.data_warnings import one_heading_advice
from ..checks.heading_deviation import heading_advice, how_bad
from ..checks.lever_arm_check import told_arm_advice
from ..checks.residual_tests import finds_nothing, lag_of, left_over_advice, std_along
from ..models.parameters import Parameters
from ..results.results import Estimate
from ..streams.position_velocities import are_positions
from .dead_reckoning import Navigation


def doubts(
    estimate: Estimate,
    finders: Iterable[Estimate],
    navigation: Navigation | None,
    parameters: Parameters,
    *,
    suggested: bool,
    in_earth: bool,
    is_level: bool,
) -> list[Reason]:
    """Each as bad as it is to a verdict; a warning is nothing to that, but worth saying.

    Parameters
    ----------
    estimate: Of the selected model.
    finders: Estimates that hold what the data show of the lever arm, the best first; others do not matter.
    navigation: What is left with the selected model, on data held out; None where that is not known.
    parameters: What was told.
    suggested: Whether another configuration fits, which would be why the arm is another.
    in_earth: Whether the reference is in an earth frame.
    is_level: Whether the IMU knows the heading alone, see `IMU_LEVEL`.
    """
    found = [finding("IMU_LEVEL")] if is_level else []
    if not suggested:
        found += [each.weighed(Severity.MARGINAL) for each in told_arm_advice(finders, parameters)]
    if navigation is None:
        return found
    if navigation.deviation is not None:
        found.append(heading_advice(navigation.deviation).weighed(how_bad(navigation.deviation, estimate)))
    if in_earth:
        found += one_heading_advice(estimate, parameters, navigation.speed)
    return found + left_over_advice(
        navigation.followed,
        are_positions(parameters),
        lag_of(estimate, parameters),
        finds_nothing(estimate),
        std_along(estimate, parameters),
    )
