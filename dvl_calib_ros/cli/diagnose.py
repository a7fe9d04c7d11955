"""Diagnose recorded bags: where the DVL differs from the calibration's prediction, and which effect causes it.

With --simulator: what the simulator's DVL lacks compared with the vehicle's. The answer comes first, in one sentence.
Several bags must be of one vehicle; whole bags are then held out.

Exit code 0: the data answer. 1: the answer is unknown, or not observable. 2: bad usage or input.
"""

from __future__ import annotations

import argparse
import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError
from . import common

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..discovery.discovery import Discovery
    from ..unpaired.both_sides import RecordedSide

# at rest a bias is observable that looks like scale at speed
DEFAULTS = {"min_speed": 0.0}
# a file of more is larger than `export` reads
MOST_SAMPLES = 5000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 folder, .mcap, .db3 or .bag")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the diagnosis as JSON")
    parser.add_argument(
        "--apply", type=Path, metavar="FILE",
        help="write a parameter file for node and replay that compensates the effects found, added to --params and -p",
    )  # fmt: skip
    parser.add_argument(
        "--twin", type=Path, metavar="FOLDER",
        help="write bags with a simulated DVL on the recorded motion: NAME_without and NAME_with the effects found",
    )  # fmt: skip
    parser.add_argument(
        "--samples", nargs=2, metavar=("N", "FILE"),
        help="write the diagnosis with N draws of calibration and effects from their posterior, for export --sample",
    )  # fmt: skip
    parser.add_argument("-v", "--verbose", action="store_true", help="print all tables as well")
    common.add_report_option(parser)
    common.add_discovery_options(parser)
    add_simulator_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Diagnose, print, save. Return 1 if the data do not answer."""
    if arguments.simulator:
        return run_against_simulator(arguments)
    for option in NEEDS_SIMULATOR:
        if getattr(arguments, option) is not None:
            raise InputError(f"--{option.replace('_', '-')} works only with --simulator")
    from ..diagnosis.answer.compensation import parameter_file, verified_corrections
    from ..diagnosis.answer.posterior_samples import with_samples
    from ..diagnosis.answer.results import DiagnosisVerdict
    from ..diagnosis.answer.simulated_twin import write_twins
    from ..diagnosis.diagnose import diagnose
    from ..diagnosis.model.recorded_streams import recording_names
    from ..disk.atomic import own_stream, save_all
    from ..examination.examine import rejection
    from ..present import diagnosis as present
    from ..verdict.kinds import Severity

    parameters = common.load(arguments)
    names = recording_names(arguments.bags)
    paths_by_recording = _apply_paths(arguments.apply, names)
    count, sampled = _samples(arguments.samples)
    common.check_outputs(
        arguments,
        "json",
        "apply",
        "report",
        folders=["twin"],
        also_written={f"--apply of {name}": path for name, path in paths_by_recording.items()}
        | ({} if sampled is None else {"--samples": sampled}),
    )
    _check_twins(arguments.twin, names)
    recording, discovery = common.discovered(arguments, arguments.bags, parameters)
    parameters = discovery.diagnosed
    rejected = rejection(recording, discovery)  # before the messages are forgotten
    with common.progress("diagnosing") as on_progress:
        diagnosis = diagnose(
            recording,
            common.load(arguments, DEFAULTS).replace(**discovery.values),
            discovery.topics,
            on_progress,
            with_series=arguments.report is not None,
            forget=True,
        )
    diagnosis = diagnosis.led_by(rejected)

    written: list[str] = []

    def answer() -> None:
        """Print the diagnosis and the written files."""
        layout = present.diagnosis if arguments.verbose else present.first_screen
        common.print_document(layout(diagnosis), discovery.doubts)
        common.print_found(discovery, arguments.bags, first_only=not arguments.verbose)
        for line in written:
            common.console().print(line, soft_wrap=True, markup=False)

    def apply(path: Path) -> None:
        """Write the parameters that correct the diagnosed errors, per recording if they differ."""
        paths: dict[int | None, Path] = {None: path}
        if any(effect.by_recording for effect in diagnosis.effects):
            paths |= {index: paths_by_recording[name] for index, (name, _) in enumerate(diagnosis.recordings)}
        try:
            corrections = verified_corrections(parameters, diagnosis, [*paths])
        except InputError as error:
            raise InputError(f"--apply {path}: {error}") from None
        save_all({paths[day]: parameter_file(each.parameters).encode() for day, each in corrections.items()})
        files = {day: each for day, each in corrections.items() if own_stream(paths[day]) is None}
        written.extend(f"wrote {paths[day]}: {each.sentence}" for day, each in files.items())

    common.deliver(
        answer,
        *common.result_files(arguments, diagnosis),
        (sampled, lambda path: common.write_json(path, with_samples(diagnosis, count))),
        (arguments.apply, apply),
        (arguments.twin, lambda folder: [*map(partial(write_twins, folder), diagnosis.twins)]),
    )
    cannot = diagnosis.verdict in (DiagnosisVerdict.UNKNOWN, DiagnosisVerdict.INSUFFICIENT_EXCITATION)
    return int(cannot or diagnosis.reasons[0].severity is Severity.REJECT)


def _apply_paths(path: Path | None, names: Sequence[str]) -> dict[str, Path]:
    """Return parameter files per recording, next to --apply, if there are several. Raises InputError."""
    from ..disk.atomic import own_stream

    if path is None or len(names) < 2:
        return {}
    if own_stream(path) is not None:
        raise InputError(f"--apply {path}: with several bags, one file per bag is written next to it; name a file")
    return {name: path.with_name(f"{path.stem}.{name}{path.suffix}") for name in names}


def _samples(words: Sequence[str] | None) -> tuple[int, Path | None]:
    """Return the number of posterior samples and their file, 0 and None without --samples. Raises InputError."""
    if words is None:
        return 0, None
    if not words[0].isdecimal() or not 1 <= int(words[0]) <= MOST_SAMPLES:
        raise InputError(f"--samples {words[0]}: give a number from 1 to {MOST_SAMPLES}, and a file")
    return int(words[0]), Path(words[1])


def _check_twins(folder: Path | None, names: Sequence[str]) -> None:
    """Raise InputError if a twin exists already, before work is done."""
    from ..diagnosis.answer.simulated_twin import twin_paths

    if folder is None:
        return
    for path in (path for name in names for path in twin_paths(folder, name)):
        if os.path.lexists(path):
            raise InputError(f"{path}: exists already; give another folder, or remove it first")


NOT_WITH = ("apply", "twin", "samples")
NEEDS_SIMULATOR = ("simulator_params", "rounds", "keep")


def add_simulator_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --simulator and its further options."""
    parser.add_argument(
        "--simulator", nargs="+", type=Path, metavar="SIM",
        help="bags of a simulator, of any motion and with its true velocity: report what its DVL lacks",
    )  # fmt: skip
    parser.add_argument(
        "--simulator-params", type=Path, metavar="FILE", help="parameter file of the simulator, if it differs"
    )
    parser.add_argument(
        "--rounds", type=int, metavar="N",
        help="correct the simulator's DVL by the differences, simulate it on the simulator's motion and compare "
        "again, up to N times",
    )  # fmt: skip
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER",
        help="write each round's simulated DVL (round_1.json, for export and simulate --diagnosis) and bag (round_1)",
    )  # fmt: skip


def run_against_simulator(arguments: argparse.Namespace) -> int:
    """Compare, print, save. Return 1 if the recordings cannot answer."""
    from ..present.result_documents import DOCUMENTS
    from ..unpaired.results import SimulatorVerdict
    from ..unpaired.simulator_rounds import against, check_rounds

    for option in NOT_WITH:
        if getattr(arguments, option) is not None:
            raise InputError(f"--{option} works only without --simulator")
    check_rounds(arguments.rounds, arguments.keep)
    common.check_outputs(arguments, "json", "report", folders=["keep"])
    real = _open_side(arguments, arguments.bags, arguments.params)
    sim = _open_side(arguments, arguments.simulator, arguments.simulator_params or arguments.params)
    with common.progress("comparing") as on_progress:
        found = against(
            real[0], sim[0], arguments.rounds, arguments.keep, on_progress, with_series=arguments.report is not None
        )

    def answer() -> None:
        common.print_document(DOCUMENTS[type(found)](found), [*real[1].doubts, *sim[1].doubts])
        common.print_found(real[1], arguments.bags)
        common.print_found(sim[1], arguments.simulator)

    common.deliver(answer, *common.result_files(arguments, found))
    return int(found.verdict is SimulatorVerdict.CANNOT_TELL)


def _open_side(
    arguments: argparse.Namespace, bags: Sequence[Path], params: Path | None
) -> tuple[RecordedSide, Discovery]:
    """Open one side's bags and discover their topics and frames."""
    from ..unpaired.both_sides import RecordedSide

    side_arguments = argparse.Namespace(**{**vars(arguments), "params": params})
    recording, discovery = common.discovered(side_arguments, bags, common.load(side_arguments))
    parameters = common.load(side_arguments, DEFAULTS).replace(**discovery.values)
    return RecordedSide(recording, parameters, discovery.topics), discovery
