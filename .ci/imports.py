"""Import every module of the installed package."""

import importlib
import pkgutil
import sys

import dvl_calib_ros

names = [module.name for module in pkgutil.walk_packages(dvl_calib_ros.__path__, "dvl_calib_ros.")]
for name in names:
    importlib.import_module(name)
print(f"Python {sys.version.split()[0]}: {len(names)} modules imported from {dvl_calib_ros.__path__[0]}")
