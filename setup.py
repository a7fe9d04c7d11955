"""What ament needs beside pyproject.toml: its index, and what is installed under share/."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "dvl_calib_ros"


def shared(folder: str) -> list:
    """The files of a folder, to be installed under share/ with their sub-folders."""
    files = [path for path in Path(folder).rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    return [(f"share/{NAME}/{path.parent.as_posix()}", [path.as_posix()]) for path in sorted(files)]


setup(
    version="0.1.0",  # catkin_prepare_release raises it here and in package.xml; a test holds all equal
    python_requires=">=3.10",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "present/templates/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *shared("bags"),
        *shared("config"),
        *shared("launch"),
    ],
    zip_safe=True,
)
