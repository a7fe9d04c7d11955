"""Reports for the tests: a replay's, an evaluation's and a diagnosis's, from little data, and how to read them."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
from io_fixtures import run, write_bag
from matplotlib.category import StrCategoryLocator
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator

from dvl_calib_ros.bag_replay.replay import Replayed, replay
from dvl_calib_ros.calibration.assessment.dead_reckoning import Drift, Navigation
from dvl_calib_ros.calibration.comparison.mounting_change import Comparison, compare
from dvl_calib_ros.calibration.models import MODELS
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.results.extrinsics import Extrinsics
from dvl_calib_ros.diagnosis.answer.gap_closure import Gap, HeldOutResiduals
from dvl_calib_ros.diagnosis.answer.gap_location import GapPlace
from dvl_calib_ros.diagnosis.answer.noise_findings import NoiseFinding
from dvl_calib_ros.diagnosis.answer.plotted_series import DiagnosisSeries, RegressorPlot
from dvl_calib_ros.diagnosis.answer.results import Diagnosis, DiagnosisVerdict, FoundEffect
from dvl_calib_ros.diagnosis.search.unexplained import Unexplained
from dvl_calib_ros.evaluation.cross_check import CrossCheck
from dvl_calib_ros.evaluation.results import (
    UNCALIBRATED,
    CalibrationRun,
    CalibrationSet,
    ConvergenceCurve,
    Coverage,
    EachStudy,
    Evaluation,
    HeldOut,
)
from dvl_calib_ros.evaluation.validation_study import TIMES_S
from dvl_calib_ros.present.page import write_report
from dvl_calib_ros.present.replay import replayed as document_of
from dvl_calib_ros.verdict.reasons import finding

# One of each kind: most of a report's time goes into pictures of the models' estimates
FEW = ("M3", "unaided")
# Of a plug-in: the installed library does not know it
OWN_EFFECT = "own_<b>$effect$</b>"


class Page(HTMLParser):
    """What a page consists of: its tags with attributes, its text, and the cells of its tables."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.rows: list[list[str]] = []
        self._text: list[str] = []
        self._in_cell = self._in_style = False
        self.source = path.read_text()
        self.feed(self.source.replace("<wbr>", ""))

    @property
    def text(self) -> str:
        return " ".join(" ".join(self._text).split())

    def row(self, name: str) -> list[str]:
        """The first row of a table that starts with this name."""
        return next(row for row in self.rows if row and row[0] == name)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self._in_style = tag in ("style", "script")
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")
            self._in_cell = True

    def handle_endtag(self, tag):
        self._in_style = self._in_style and tag not in ("style", "script")
        self._in_cell = self._in_cell and tag not in ("td", "th")

    def handle_data(self, data):
        if self._in_style:
            return
        self._text.append(data)
        if self._in_cell:
            self.rows[-1][-1] = f"{self.rows[-1][-1]} {data}".strip()

    def images(self) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.tags if tag == "img"]


def drawn(monkeypatch) -> list[Figure]:
    """Figures as they are drawn from now on, in place of being saved."""
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, file, **_: (figures.append(figure), file.write(b"<svg/>")))
    return figures


def assert_described(images, figures) -> None:
    """Every figure has alternative text and labelled axes."""
    assert len(images) == len(figures)
    assert all(len(image["alt"]) > 10 for image in images)
    for figure in figures:
        axes, *bars = figure.axes
        assert all(bar.get_ylabel() for bar in bars)
        has_names = isinstance(axes.yaxis.get_major_locator(), FixedLocator | StrCategoryLocator)
        assert axes.get_xlabel() and (axes.get_ylabel() or has_names)


def recorded(bag: Path, **parameters: Any) -> Replayed:
    return replay([bag], Parameters(**parameters), with_history=True)


def replay_page(folder: Path, samples=None, models=FEW, **bag_options: Any) -> tuple[Path, Replayed]:
    """A report of a small bag with these models' estimates, and what was replayed."""
    bag = write_bag(folder / "bag", run() if samples is None else samples, **bag_options)
    replayed = recorded(bag, dvl_position="told")
    path = folder / "report.html"
    write_report(path, document_of(replayed, [bag], list(models)))
    return path, replayed


def evaluation(**changes: Any) -> Evaluation:
    """An evaluation with made-up numbers that have the shapes of real ones. Models that need attitude are nan on E2."""
    models = tuple(MODELS)
    sets = (CalibrationSet("E1", "T12", 200.0), CalibrationSet("E2", "T$1$<b>", None))
    windows = (50.0, 100.0, 200.0, None)
    level = np.array([0.12, *np.linspace(0.03, 0.09, len(models))])
    avg_vrmse = np.tile(level[None, :, None], (2, 1, 2))
    avg_vrmse[1, -1] = np.nan
    runs = (CalibrationRun("T01", 0.0, 400.0, 1.9), CalibrationRun("T$1$<b>", 10.0, 80.0, 0.05))
    coverage = tuple(
        Coverage(
            name, MODELS[name].state_names[:3], np.full(3, 0.7), np.full(3, 0.9), 0.7, 0.5, 30, np.zeros(3), np.ones(3),
            np.ones(3),
        )
        for name in models
    )  # fmt: skip
    methods = [(name, std) for std in (0.2, 0.02) for name in ("M3", "Kinsey-Whitcomb", "Troni-Whitcomb")]
    methods += [(name, None) for name in ("unaided", "M7")]
    curves = tuple(ConvergenceCurve(*method, np.full((len(TIMES_S), 3), 0.1)) for method in methods)
    values: dict[str, Any] = {
        "source": "folder <b>$x$</b>",
        "own_generator": False,
        "notes": ("T99 is <i>missing</i>",),
        "trajectories": ("T01", "T12", "T$1$<b>"),
        "models": models,
        "sets": sets,
        "seeds": (0, 1),
        "n_combinations": 15,
        "avg_vrmse": avg_vrmse,
        "windows_s": windows,
        "avg_vrmse_by_time": np.tile(avg_vrmse[:, None], (1, len(windows), 1, 1)),
        "published": {"E1": {UNCALIBRATED: 0.121, "M1": 0.0301, "M2": 0.10}},
        "coverage": coverage,
        "convergence": curves,
        "each": EachStudy(runs, np.tile(level[None, :, None], (2, 1, 2)), np.ones((2, len(models))), coverage),
        "single_heading": None,
        "parameters": Parameters().as_dict(),
        "version": "0",
        "held_out": (HeldOut("E1", "M3", "accept", 0.12, 0.03, 0.031),),
    }  # fmt: skip
    return Evaluation(**{**values, **changes})


def diagnosis(**changes: Any) -> Diagnosis:
    """A diagnosis of two recordings with made-up numbers: a lever arm, and an effect of the user's own."""
    rng = np.random.default_rng(2)
    n = 1500
    time = np.tile(np.arange(n // 2) * 0.2, 2)
    turning = np.sin(time / 8.0) > 0.3
    traces = {
        "lever_arm": 0.03 * turning[:, None] * np.array([0.0, 1.0, 0.5]),
        OWN_EFFECT: 0.01 * np.sin(time / 20.0)[:, None] * np.array([1.0, 0.0, 0.0]),
    }
    noise = rng.normal(0.0, 0.02, (n, 3))
    held_out = HeldOutResiduals(noise + sum(traces.values()), noise, noise**2, np.arange(n) // 100)
    series = DiagnosisSeries(
        ("first", "<b>$second$</b>"), np.repeat([0, 1], n // 2), time, (slice(0, n // 2), slice(n // 2, n)), held_out,
        {"turning": turning, "straight": ~turning}, traces, np.deg2rad([1.0, -2.0, 3.0]), np.array([0.01, 0.0, -0.02]),
        np.array([*np.deg2rad([0.1, 0.2, 0.3]), 0.001, 0.002, 0.03]),
        Unexplained(-1.0, "turn rate", np.zeros((n, 3, 1)), np.zeros((n, 3, 0))),
        by_regressor=RegressorPlot("turn rate, °/s (to port)", "y", 5.0 * np.sin(time / 8.0), noise[:, 1]),
    )  # fmt: skip
    values: dict[str, Any] = {
        "verdict": DiagnosisVerdict.AMBIGUOUS,
        "reasons": (
            finding(
                "GAP_AMBIGUOUS", names="<i>two</i> effects", explained="explained", before=42.1, after=35.3, noise=34.6
            ),
        ),
        "gap": Gap(0.0421, 0.0353, 0.0346, 0.982, (0.91, 1.0), 0.007, 0.03),
        "effects": (
            FoundEffect("lever_arm", ("sideslip",), {"x_m": (0.3, 0.25, 0.35), "z_m": (-0.1, -0.3, 0.1)}, 0.85, 1e-20),
            FoundEffect(OWN_EFFECT, (), {"gain": (1500.0, 1200.0, 1800.0)}, -0.02, 1e-9),
        ),
        "noise": (NoiseFinding("outliers", {"share": (0.02, 0.01, 0.03)}, 1e-12),),
        "where": (GapPlace("y", "turning", (0.0, 150.0), (0.0, 2.5), 0.7, 1e-15),),
        "untestable": {"water_lock": "attitude"},
        "minimum_detectable": {"lever_arm": {"x_m": 0.11, "z_m": 0.9}, OWN_EFFECT: {"gain": 3.0}},
        "next_steps": (finding("NEXT_SHOW", name="lever_arm", manoeuvre="turns to both sides at two speeds"),),
        "notes": ("first: <u>gaps</u>",),
        "series": series,
    }  # fmt: skip
    return Diagnosis(**{**values, **changes})


def comparison(name: str, apart_s: int = 86_400) -> Comparison:
    """Three calibrations, so long after each other, of which the last has moved. name: of one of them."""
    std = np.array([0.001, 0.001, 0.001, 0.02, 0.02, 0.02, 0.001, 0.01])
    return compare(
        [
            Extrinsics(
                name=each, model="full", first_ns=day * apart_s * 1_000_000_000,
                last_ns=(day * apart_s + 600) * 1_000_000_000,
                value=np.array([0.0, 0.0, yaw, 0.0, 0.0, 0.0, 0.0, 0.0]),
                covariance=np.diag(std**2), shown=np.ones(8, dtype=bool), used=100, remarks=("as it is",),
            )
            for day, (each, yaw) in enumerate(((name, 0.0), ("tuesday.yaml", 0.0), ("wednesday.yaml", 0.012)))
        ]
    )  # fmt: skip


def cross_checked(name: str) -> CrossCheck:
    """Two bags that corrected each other. name: of one of them."""
    along = np.linspace(0.0, 100.0, 50)
    track = np.column_stack([along, 10.0 * np.sin(along / 20.0)])
    found = Navigation(
        distance_m=110.0, seconds=60.0, stretch_m=110.0, stretches=1, before=Drift(20.0, 2.2), after=Drift(2.0, 0.2),
        noise_per_km=1.0, on_a_map=True, stamps_ns=np.arange(50) * 1_000_000_000, distances=along,
        reference=track, track_before=1.02 * track, track_after=1.002 * track,
        error_before=np.full((50, 3), 0.1), error_after=np.full((50, 3), 0.02),
    )  # fmt: skip
    other = "tuesday"
    return CrossCheck(
        bags=(name, other), models=("full",), n_paired=(10, 10), uncorrected=np.array([0.1, 0.1]),
        corrected=np.array([[[np.nan, 0.02]], [[0.02, np.nan]]]), notes=(), parameters=Parameters().as_dict(),
        selected=("full", "full"), navigation={(name, other): found, (other, name): found},
    )  # fmt: skip
