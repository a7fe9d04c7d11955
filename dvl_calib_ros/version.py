"""Version of the package, from package.xml."""

import sys
from pathlib import Path


def _version() -> str:
    """Read the version from package.xml in the source tree or under share/, else from the installed metadata."""
    for folder in (Path(__file__).resolve().parents[1], Path(sys.prefix, "share", "dvl_calib_ros")):
        package = folder / "package.xml"
        if package.is_file():
            head, _, rest = package.read_text(encoding="utf-8").partition("<version>")
            if "<name>dvl_calib_ros</name>" in head:
                return rest.partition("</version>")[0]
    from importlib.metadata import version  # takes 20 ms, noticeable on the command line

    return version("dvl_calib_ros")


__version__ = _version()
