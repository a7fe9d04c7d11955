"""The version of the package, which package.xml holds."""

import sys
from pathlib import Path


def _version() -> str:
    """The version that package.xml says: of the source tree, else as installed under share/."""
    for folder in (Path(__file__).resolve().parents[1], Path(sys.prefix, "share", "dvl_calib_ros")):
        package = folder / "package.xml"
        if package.is_file():
            head, _, rest = package.read_text(encoding="utf-8").partition("<version>")
            if "<name>dvl_calib_ros</name>" in head:
                return rest.partition("</version>")[0]
    from importlib.metadata import version  # 20 ms, which the command line would feel

    return version("dvl_calib_ros")


__version__ = _version()
