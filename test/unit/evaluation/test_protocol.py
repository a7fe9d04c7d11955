"""The published procedure on the published data (Snapir sea trials). Skipped without the data."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.evaluation import protocol
from dvl_calib_ros.evaluation.protocol import load_folder
from dvl_calib_ros.evaluation.results import UNCALIBRATED
from dvl_calib_ros.evaluation.validation_study import DEFAULTS, EVALUATED, Procedure, run_seed

N_SEEDS = 5


@pytest.fixture(scope="module")
def scores(snapir):
    """Set -> column -> Avg.VRMSE m/s, mean over the seeds; one P0 and one R for all models with GNSS and without."""
    runs, notes = load_folder(snapir)
    assert not notes
    procedure = Procedure(runs, EVALUATED, protocol.SETS, Parameters(**DEFAULTS), studies=False)
    values = np.mean([[run.avg_vrmse for run in run_seed(procedure, seed).by_set] for seed in range(N_SEEDS)], axis=0)
    return {
        each.name: dict(zip((UNCALIBRATED, *EVALUATED), row, strict=True))
        for each, row in zip(protocol.SETS, values.tolist(), strict=True)
    }


REPRODUCED = (
    [(name, UNCALIBRATED, 0.01) for name in protocol.PUBLISHED]
    + [("E1", model, 0.05) for model in ("M5", "M6", "M7")]
    + [("E3", model, 0.10) for model in ("M5", "M6")]
    + [(name, model, 0.25) for name in protocol.PUBLISHED for model in ("M2", "M4")]
)


@pytest.mark.parametrize(("name", "column", "within"), REPRODUCED)
def test_the_published_figure_is_reproduced(name, column, within, scores):
    assert scores[name][column] == pytest.approx(protocol.PUBLISHED[name][column], rel=within)


def test_the_paper_states_a_mean_of_m3_that_its_column_does_not_give():
    assert np.mean([row["M3"] for row in protocol.PUBLISHED.values()]) == pytest.approx(0.0376, abs=1e-4)
