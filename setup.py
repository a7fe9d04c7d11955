"""Python package and ament_python package in one."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "dvl_calib_ros"
# The lowest versions that work: .ci/lowest.txt, with which CI runs the suite on Python 3.10.
BAGS = ["rosbags>=0.11.7", "apsw>=3.46", "lz4>=4.3.2", 'backports.zstd>=1.0; python_version < "3.14"', "mcap>=1.2.1"]
ROS_FREE = ["numpy>=1.26", "scipy>=1.11.1", "pyyaml>=6.0.1", "rich>=13.7", "joblib>=1.3", *BAGS]
REPORT = ["matplotlib>=3.6.3", "jinja2>=3.1.2", "markupsafe>=2.1.0"]
DASK = ["distributed>=2023.9"]
COMPLETION = ["argcomplete>=3.1"]
ROS = ["ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces"]
DOCS = ["mkdocs>=1.6"]
PANDAS = ["pandas>=2.0"]
NOTEBOOK = ["nbclient>=0.8", "nbformat>=5.7", "ipykernel>=6.20"]
TEST = ["pytest>=8.0", "pytest-xdist>=3.5", "hypothesis>=6.100", "filterpy>=1.4.5", "playwright>=1.40"]
TEST += [*DASK, *COMPLETION, *PANDAS, *NOTEBOOK]


def shared(folder: str) -> list:
    """The files of a folder, to be installed under share/ with their sub-folders."""
    files = [path for path in Path(folder).rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    return [(f"share/{NAME}/{path.parent.as_posix()}", [path.as_posix()]) for path in sorted(files)]


setup(
    name=NAME,
    version="0.1.0",  # catkin_prepare_release raises it here and in package.xml; a test holds all equal
    description="Calibrate a Doppler velocity log (DVL), live on ROS 2 Jazzy and over recorded bags",
    long_description=Path("README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    classifiers=[
        "License :: OSI Approved :: Apache Software License",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        *(f"Programming Language :: Python :: 3.{minor}" for minor in range(10, 14)),
        "Topic :: Scientific/Engineering",
        "Typing :: Typed",
    ],
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "report/templates/*"]},
    python_requires=">=3.10",
    install_requires=[*ROS_FREE, *REPORT],
    extras_require={"ros": ROS, "dask": DASK, "completion": COMPLETION, "docs": DOCS, "pandas": PANDAS, "test": TEST},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *shared("bags"),
        *shared("config"),
        *shared("launch"),
    ],
    entry_points={
        "console_scripts": [
            "dvl-calib = dvl_calib_ros.cli.main:main",
            "calibration_node = dvl_calib_ros.node.main:main",
        ]
    },
    zip_safe=True,
)
