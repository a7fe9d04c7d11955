"""All simulators by name; another one is a file like its neighbours and an entry here."""

from __future__ import annotations

from collections.abc import Mapping

from . import dave, dvl_simulator, gazebo, holoocean, stonefish, uuv_simulator
from .simulator import Simulator

SIMULATORS: Mapping[str, Simulator] = {
    "gazebo": gazebo.SIMULATOR,
    "stonefish": stonefish.SIMULATOR,
    "holoocean": holoocean.SIMULATOR,
    "dvl-simulator": dvl_simulator.SIMULATOR,
    "dave": dave.SIMULATOR,
    "uuv_simulator": uuv_simulator.SIMULATOR,
}
