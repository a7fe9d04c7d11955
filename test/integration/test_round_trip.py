"""Vehicle -> diagnosis -> export -> another simulator -> its log: what differs is what the export said is missing."""

from __future__ import annotations

import pytest
from round_trip import run

from dvl_calib_ros.simulator_export.simulators import SIMULATORS


@pytest.mark.slow
@pytest.mark.parametrize("simulator, seed", [(name, 2000 + number) for number, name in enumerate(SIMULATORS)])
def test_the_log_of_a_simulator_differs_in_nothing_but_what_the_export_said_it_cannot_represent(
    simulator, seed, tmp_path
):
    outcome = run(simulator, seed, tmp_path)
    assert outcome.unsaid == set(), outcome
    # and what is said to be missing is missing: effects that were found and are no setting of that simulator
    assert {name for name in outcome.found if name in outcome.missing} <= outcome.differs
