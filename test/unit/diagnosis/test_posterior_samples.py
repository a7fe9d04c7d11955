"""Draws of simulator settings from the posterior of a diagnosis."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from command_line import fail, succeed
from test_diagnosis import LEVER, diagnosed

from dvl_calib_ros.bags.writer import Compression, Storage
from dvl_calib_ros.diagnosis.answer.posterior_samples import with_samples
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import Scenario, write_bag
from dvl_calib_ros.simulator_export.dvl_description import load_description


@pytest.fixture(scope="module")
def arm():
    return diagnosed(effects=[LEVER], seconds=300.0, gnss_std=0.02)


@pytest.mark.slow
def test_draws_scatter_as_the_intervals_say(arm):
    samples = with_samples(arm, 400)["samples"]
    drawn = [{each["name"]: each["parameters"] for each in sample["effects"]} for sample in samples]
    for name, (value, low, high) in arm.effects[0].parameters.items():
        values = [each["lever_arm"][name]["value"] for each in drawn]
        std = (high - low) / 3.92
        assert np.mean(values) == pytest.approx(value, abs=0.2 * std)
        assert np.std(values) == pytest.approx(std, rel=0.15)
    yaws = [sample["calibration"]["phi_rad"]["z"]["value"] for sample in samples]
    value, low, high = arm.calibration[2]
    assert np.std(yaws) == pytest.approx((high - low) / 3.92, rel=0.15)


def test_every_member_of_an_or_list_is_drawn_by_its_weight(arm):
    """Of two equal explanations each is drawn in half of the samples."""
    selection = arm.selection
    twin = replace(selection.selected[0], rivals=(selection.fit.hypothesis,))
    twins = replace(arm, selection=replace(selection, selected=(twin,)))
    worse = replace(twin, rivals=(selection.base.hypothesis,))
    alone = replace(arm, selection=replace(selection, selected=(worse,)))
    names = [[each["name"] for each in sample["effects"]] for sample in with_samples(alone, 50)["samples"]]
    assert names == [["lever_arm"]] * 50
    assert len(with_samples(twins, 50)["samples"]) == 50


@pytest.mark.slow
def test_a_draw_is_written_and_exported(tmp_path, capsys):
    effects = (injection("lever_arm:x_m=0.8,y_m=-0.3"),)
    scenario = Scenario(trajectory="free", seconds=200.0, gnss_std=0.02, gnss_rate=5.0, effects=effects)
    write_bag(scenario, tmp_path / "bag", Storage.MCAP, Compression.NONE)
    succeed(capsys, "diagnose", tmp_path / "bag", "--samples", 5, tmp_path / "samples.json")
    assert len(json.loads((tmp_path / "samples.json").read_text())["samples"]) == 5
    arms = [load_description(tmp_path / "samples.json", number).lever_arm[0] for number in range(5)]
    assert len({*arms}) == 5 and np.mean(arms) == pytest.approx(0.8, abs=0.1)
    succeed(capsys, "export", "gazebo", tmp_path / "samples.json", "--sample", 3, "-o", tmp_path / "dvl.sdf")
    assert f"{arms[3]:.4f}"[:5] in (tmp_path / "dvl.sdf").read_text()
    sdf = tmp_path / "other.sdf"
    says = fail(capsys, "export", "gazebo", tmp_path / "samples.json", "--sample", 5, "-o", sdf)
    assert "no sample 5; it has 5, numbered from 0" in says
    for damaged, says in (
        ({"a": 1}, "no sample 0; it has 0"),
        ([3, 4], "damaged diagnosis"),
        ([{"effects": 5}], "damaged"),
    ):
        content = json.loads((tmp_path / "samples.json").read_text()) | {"samples": damaged}
        (tmp_path / "damaged.json").write_text(json.dumps(content))
        assert says in fail(capsys, "export", "gazebo", tmp_path / "damaged.json", "--sample", 0, "-o", sdf)
    assert "from 1 to 5000" in fail(capsys, "diagnose", tmp_path / "bag", "--samples", "many", tmp_path / "x.json")
