"""Results of a replay: the mounting and the calibration; results of all kinds as text, HTML and data frames."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..bag_replay.replay import Replayed, replay_document
from ..calibration.models import MODELS
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import Array
from ..calibration.results.mounting_quantities import LATE, Quantity, quantities
from ..discovery.discovery import Discovery
from ..errors import InputError, printable
from ..present.document import Document
from ..verdict.reasons import Reason

if TYPE_CHECKING:
    import os

    import pandas
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Mounting:
    """Calibrated mounting of the DVL.

    Parameters
    ----------
    rpy_deg
        Corrected roll, pitch, yaw of the DVL in the body, degrees, as in a URDF origin (fixed axes X, Y, Z).
    std_deg
        Their standard deviations (1σ), degrees.
    nominal_rpy_deg
        Configured roll, pitch, yaw, degrees.
    xyz_m, xyz_std_m
        Lever arm: position of the DVL from the reference point, body frame, m, estimated or else configured; its
        standard deviations, nan if the model has no lever arm.
    position_m
        Position of the DVL in the body, m; None if the position of the reference point is unknown.
    not_observable
        Names of estimated quantities that the data do not make observable, as in the report.
    time_offset_s, time_offset_std_s
        Delay of the DVL's stamps against the IMU's, s, estimated or else configured; of several recordings the last
        one's (`Result.delays`).
    scale_percent, scale_std_percent
        Scale error of forward motion, positive if the DVL measures too much; nan if the model has no scale.
    base_frame, dvl_frame
        Names of the frames.
    """

    rpy_deg: tuple[float, float, float]
    std_deg: tuple[float, float, float]
    nominal_rpy_deg: tuple[float, float, float]
    xyz_m: tuple[float, float, float]
    xyz_std_m: tuple[float, float, float]
    time_offset_s: float
    time_offset_std_s: float
    scale_percent: float
    scale_std_percent: float
    base_frame: str
    dvl_frame: str
    position_m: tuple[float, float, float] | None = None
    not_observable: tuple[str, ...] = ()

    @property
    def urdf(self) -> str:
        """Origin of the DVL's joint for a URDF, in forward-left-up axes as `mounting_rpy`."""
        from ..files.urdf import origin_tag

        return origin_tag(self.position_m, np.radians(self.rpy_deg))

    def __str__(self) -> str:
        angles = zip(("roll", "pitch", "yaw"), self.rpy_deg, self.std_deg, strict=True)
        parts = [f"{name} {angle:.2f}° ± {std:.2f}°{self._remark(name)}" for name, angle, std in angles]
        arm = ", ".join(
            f"{axis} {value:.2f} ± {std:.2f} m{self._remark(f'lever arm {axis}')}"
            for axis, value, std in zip("xyz", self.xyz_m, self.xyz_std_m, strict=True)
        )
        if all(map(math.isnan, self.xyz_std_m)):
            arm = "{:g} {:g} {:g} m as configured, not estimated".format(*self.xyz_m)
        offset = f"{self.time_offset_s:.3f} ± {self.time_offset_std_s:.3f} s{self._remark(LATE)}"
        if math.isnan(self.time_offset_std_s):
            offset = f"{self.time_offset_s:g} s as configured, not estimated"
        parts += [f"lever arm {arm}", f"{LATE} {offset}"]
        return printable(f"{self.dvl_frame} in {self.base_frame}: {', '.join(parts)}")

    def _remark(self, name: str) -> str:
        return " (not observable)" if any(each.startswith(name) for each in self.not_observable) else ""

    __repr__ = __str__


@dataclass(frozen=True)
class Calibration:
    """Result of a replay.

    Parameters
    ----------
    replayed
        Every model's estimate, counts, verification and history.
    discovery
        Findings in the bags, and the topics and parameters of the replay.
    bags
        Paths of the bags.
    """

    replayed: Replayed = field(repr=False)
    discovery: Discovery = field(repr=False)
    bags: tuple[Path, ...]

    def __repr__(self) -> str:
        return f"{self.verdict} ({self.model}): {self.mounting}"

    def _repr_html_(self) -> str:
        from ..present.replay import replayed

        return text_of(replayed(self.replayed, self.bags, ()), as_html=True)

    @property
    def model(self) -> str:
        """Name of the selected model."""
        return self.replayed.result.selected

    @property
    def verdict(self) -> str:
        """Verdict of the held-out data: accept, marginal or reject."""
        return self.replayed.result.verifications[self.model].verdict.value

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons for the verdict, in sentences, the decisive one first."""
        return tuple(each.sentence for each in self.replayed.result.verifications[self.model].reasons)

    @property
    def codes(self) -> tuple[str, ...]:
        """Codes of ``reasons``, which never change their meaning."""
        return tuple(each.code for each in self.replayed.result.verifications[self.model].reasons)

    @property
    def found(self) -> tuple[str, ...]:
        """Sentences on what was found in the bags."""
        return self.discovery.found

    @property
    def findings(self) -> tuple[Reason, ...]:
        """Faults of the data for the selected model, each with its code and remedy."""
        others = tuple(f"{name}: " for name in self.replayed.result.estimates if name != self.model)
        return tuple(each for each in self.replayed.findings if not each.says.startswith(others))

    @property
    def mounting(self) -> Mounting:
        """Corrected mounting with its standard deviations."""
        result = self.replayed.result
        estimate, parameters = result.estimate, Parameters.from_mapping(result.parameters)
        found = {each.name: each for each in quantities(result)}
        roll, pitch, yaw = (found[name] for name in ("roll", "pitch", "yaw"))
        arm = [found.get(f"lever arm {axis}", _given(at)) for axis, at in zip("xyz", parameters.lever_arm, strict=True)]
        scale = found.get("scale", _given(math.nan))
        offset_std = estimate.std_of("time_offset")
        return Mounting(
            (roll.value, pitch.value, yaw.value),
            (roll.std, pitch.std, yaw.std),
            (roll.nominal, pitch.nominal, yaw.nominal),
            (arm[0].value, arm[1].value, arm[2].value),
            (arm[0].std, arm[1].std, arm[2].std),
            estimate.dvl_time_offset(parameters.dvl_time_offset),
            math.nan if offset_std is None else float(offset_std[0]),
            scale.value,
            scale.std,
            parameters.base_frame,
            self.replayed.dvl_frame,
            result.position_in_body,
            tuple(each.name for each in quantities(result) if not each.shown),
        )

    def correct(self, velocity_dvl: Array, angular_velocity: Array | None = None) -> Array:
        """Correct measured velocities and rotate them to the body.

        Parameters
        ----------
        velocity_dvl
            Measured velocities (..., 3), m/s, in the DVL's forward-left-up axes.
        angular_velocity
            Angular velocities (..., 3), rad/s, in the body's axes, to subtract the lever arm's velocity in turns.

        Returns
        -------
        ndarray
            Velocities (..., 3), m/s, in the body's axes: of the reference point with angular_velocity, else of the DVL.
            They are valid ``mounting.time_offset_s`` before their stamps.

        Raises
        ------
        InputError
            For arrays of another shape.
        """
        measured = _vectors("velocity_dvl", velocity_dvl)
        rotation = self.discovery.parameters.rotation_dvl_from_body
        velocity = self.replayed.result.estimate.corrected_velocity(measured, rotation)
        if angular_velocity is None:
            return velocity
        turning = _vectors("angular_velocity", angular_velocity)
        if turning.shape not in ((3,), measured.shape):
            raise InputError(f"angular_velocity: shape {turning.shape}; velocity_dvl has {measured.shape}")
        return velocity - np.cross(turning, self.mounting.xyz_m)

    def tables(self) -> dict[str, pandas.DataFrame]:
        """Return the tables of the report as data frames.

        Returns
        -------
        dict of str to pandas.DataFrame
            ``mounting``, one row per quantity in its unit; ``held_out``, ``models`` and ``streams``. Names of numeric
            columns end in their unit (``_deg``, ``_percent``, ``_mps``), then in ``_std`` for a standard deviation
            (1σ).

        Raises
        ------
        InputError
            Without pandas.
        """
        from ..present.replay import replayed

        frames = frames_of(replayed(self.replayed, self.bags, tuple(MODELS)))
        import pandas

        mounting = pandas.DataFrame(quantities(self.replayed.result)).set_index("name")
        mounting.insert(2, "change", mounting["value"] - mounting["nominal"])
        mounting = mounting.rename(columns={"nominal": "configured", "value": "corrected"})
        mounting["configured"] = mounting["configured"].round(9)  # an angle of 1e-31 prints all others as powers of ten
        named = {key: frames[heading] for key, heading in TABLES.items() if heading in frames}
        return {"mounting": mounting} | {key: each.rename(columns=_column) for key, each in named.items()}

    def to_pandas(self) -> pandas.DataFrame:
        """Return the states of the selected model over time.

        Returns
        -------
        pandas.DataFrame
            By ``time_s`` since the first DVL sample: the states in SI units, which their names end with, and their σ as
            ``*_std``.

        Raises
        ------
        InputError
            Without pandas, or if the replay kept no history.
        """
        try:
            import pandas
        except ModuleNotFoundError:
            raise InputError("to_pandas needs the Python package pandas; pip install pandas") from None
        history = self.replayed.history
        if history is None:
            raise InputError("this replay kept no history; replay with history=True")
        model, estimate = history.models[self.model], self.replayed.result.estimate
        units = {each.name: each.unit for each in MODELS[self.model].nuisance}
        first_ns = self.replayed.result.first_ns or 0
        time = pandas.Index(1e-9 * (history.stamps_ns - first_ns), name="time_s")
        columns: dict[str, Array] = {}
        for index, name in enumerate(estimate.state_names):
            unit = units.get(name, "rad" if name.startswith("phi") else "")
            label = "_".join(filter(None, (name, SUFFIXES.get(unit, unit))))
            columns[label], columns[f"{label}_std"] = model.state[:, index], model.std[:, index]
        return pandas.DataFrame(columns, index=time)

    def plot(self) -> Figure:
        """Draw the mounting over time with ±1σ, and the velocity error before and after correction.

        Returns
        -------
        matplotlib.figure.Figure
            To show or save.

        Raises
        ------
        InputError
            If the replay kept no history.
        """
        from ..present.replay_figures import calibration_figure

        if self.replayed.history is None:
            raise InputError("this replay kept no history; replay with history=True")
        return calibration_figure(self.replayed)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the result file, which the node and `dvl-calib apply` read.

        Parameters
        ----------
        path
            File to write (YAML); earlier files are kept as backups next to it.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        from ..files.result_file import result_document, save_result

        target = Path(path)
        run = self.replayed
        document = result_document(run.result, run.dvl_frame, run.turned, run.water)
        save_result(target, document, round(self.discovery.parameters.result_backups))
        return target

    def report(self, path: str | os.PathLike[str]) -> Path:
        """Write the report with pictures.

        Parameters
        ----------
        path
            File to write (HTML).

        Returns
        -------
        Path
            The file.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        from ..present.page import write_report
        from ..present.replay import replayed

        target = Path(path)
        write_report(target, replayed(self.replayed, self.bags, list(MODELS)))
        return target

    def document(self, models: Sequence[str] = tuple(MODELS)) -> dict[str, Any]:
        """Return everything as plain data, as `dvl-calib replay --json` writes it.

        Parameters
        ----------
        models
            Names of the models to include.

        Returns
        -------
        dict
            As docs/json_schema.json describes.
        """
        return replay_document(self.replayed, models) | {"discovery": self.discovery.document()}


# Tables of a replay: key -> heading on the report's page
TABLES = {"held_out": "Held-out verification", "models": "Estimates", "streams": "Data"}
SUFFIXES = {"°": "deg", "%": "percent", "m/s": "mps"}
_MPS = ("uncorrected", "corrected", "predicted")


def _column(heading: str) -> str:
    """Turn a table heading into a column name, such as ``phi_x_deg_std``."""
    name, _, unit = heading.removesuffix(" ±1σ").removesuffix(" shown").partition(", ")
    name = name.replace("φ", "phi_").replace("δk", "scale").replace("NIS/m", "nis_per_component").replace(" ", "_")
    words = [name or "stream", SUFFIXES.get(unit, unit) or ("mps" if name in _MPS else "")]
    words += ["std"] * heading.endswith(" ±1σ") + ["shown"] * heading.endswith(" shown")
    return "_".join(filter(None, words))


def _vectors(name: str, given: Array) -> Array:
    """Return an argument as vectors (..., 3). Raises InputError naming it."""
    try:
        found = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"{name}: no numbers; expected an array of shape (..., 3)") from None
    if found.shape[-1:] != (3,):
        raise InputError(f"{name}: shape {found.shape}; expected (..., 3)")
    return found


def _given(value: float) -> Quantity:
    """Return a quantity that the model does not estimate, with its configured value."""
    return Quantity("", value, value, math.nan, "", False)


# Results as text, as HTML for a notebook, and as data frames.

# Width of printed output in columns, equal to the commands' output into a pipe.
WIDTH = 160


def printed(result: object, as_html: bool) -> str:
    """Format a result with its tables, as text or HTML."""
    from ..present.result_documents import DOCUMENTS

    return text_of(DOCUMENTS[type(result)](result), as_html)


def framed(result: object) -> dict[str, pandas.DataFrame]:
    """Return the tables of a result by their headings. Raises InputError without pandas."""
    from ..present.result_documents import DOCUMENTS

    return frames_of(DOCUMENTS[type(result)](result))


def frames_of(document: Document) -> dict[str, pandas.DataFrame]:
    """Return the tables of a document by their headings. Raises InputError without pandas."""
    try:
        return document.frames()
    except ModuleNotFoundError:
        raise InputError("tables need the Python package pandas; pip install pandas") from None


def text_of(document: Document, as_html: bool) -> str:
    """Render a document as on a terminal, as text or as HTML."""
    if as_html:
        from ..present.page import fragment

        return fragment(document)
    from rich.console import Console

    from ..present.terminal import shown

    # force_jupyter: rich would otherwise also display the text by itself in a notebook
    console = Console(file=io.StringIO(), record=True, width=WIDTH, force_jupyter=False, highlight=False, emoji=False)
    for each in shown(document):
        console.print(each)
    return "\n".join(line.rstrip() for line in console.export_text().splitlines())
