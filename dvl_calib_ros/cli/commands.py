"""List of all commands of ``dvl-calib``, in the order of the help, without importing any.

A command is a module of this package with `add_arguments` and `run`; its docstring is the command's description. It is
imported only when called, so its imports do not slow down other commands.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from types import ModuleType


class Command(NamedTuple):
    """One command: its name, its help in one line, an example, and its module."""

    name: str
    help: str
    example: str
    module: str = ""

    def load(self) -> ModuleType:
        """Import the command's module."""
        return import_module(f".{self.module or self.name}", __package__)


COMMANDS = (
    Command(
        "run",
        "run the calibration node, live",
        "dvl-calib run --params vehicle.yaml --dvl-topic /dvl/velocity -p result_file:=/data/calibration.yaml",
    ),
    Command(
        "watch",
        "watch a node that runs elsewhere, in the terminal",
        "dvl-calib watch --node /port/dvl_calibration",
    ),
    Command(
        "param",
        "list, read and set parameters of a running node, also where ros2 param is not installed",
        "dvl-calib param set model M4",
    ),
    Command(
        "play",
        "play recorded bags over ROS 2, also where ros2 bag is not installed",
        "dvl-calib play my_bag --rate 5 --remap /a50/velocity:=/dvl/twist --clock",
    ),
    Command(
        "doctor",
        "examine a bag: its topics, its faults, and whether it can calibrate",
        "dvl-calib doctor my_bag",
    ),
    Command("replay", "calibrate with recorded bags", "dvl-calib replay my_bag --save calibration.yaml"),
    Command("salvage", "recover damaged recordings into a new bag", "dvl-calib salvage cut_off_bag -o whole_bag"),
    Command(
        "apply",
        "write a saved calibration into URDF, parameters, TF, robot_localization or the instrument, or undo that",
        "dvl-calib apply calibration.yaml --urdf robot.urdf --launch dvl_tf.launch.xml --fusion dvl_ekf.yaml",
    ),
    Command(
        "compare",
        "compare calibrations: has the mounting moved?",
        "dvl-calib compare monday.yaml tuesday.yaml --report compared.html",
    ),
    Command(
        "fleet",
        "calibrate all recordings below folders or object stores into a catalogue (Parquet), with a page",
        "dvl-calib fleet dives --out catalogue",
    ),
    Command(
        "diagnose",
        "find what causes the velocity error that remains in recorded bags after calibration",
        "dvl-calib diagnose my_bag --apply compensated.yaml",
    ),
    Command(
        "export",
        "write a diagnosed DVL as the settings of another simulator",
        "dvl-calib export gazebo diagnosis.json -o dvl.sdf",
    ),
    Command(
        "evaluate",
        "run the published validation procedure, or check bags against each other",
        "dvl-calib evaluate snapir --seeds 5 --jobs 0 --json evaluation.json --report evaluation.html",
    ),
    Command(
        "simulate",
        "write a bag from a motion, an error model and any effects",
        "dvl-calib simulate my_bag --misalignment 1.5 -2 3 --scale 0.5 --effect lever_arm:x_m=0.3,z_m=-0.1",
    ),
    Command(
        "import",
        "turn CSV or NPY trajectories, or logs of a DVL (Water Linked, RDI, Nortek) or of ArduPilot, into bags",
        "dvl-calib import T12_dvl.csv --gnss T12_gnss.csv --attitude T12_attitude.csv -o T12",
        module="import_",
    ),
    Command(
        "parameters",
        "list every parameter, model, effect, driver, warning or command, or write a parameter file",
        "dvl-calib parameters --yaml > vehicle.yaml",
    ),
    Command("demo", "live node, replay and truth side by side on a shipped bag", "dvl-calib demo --speed 5"),
)
