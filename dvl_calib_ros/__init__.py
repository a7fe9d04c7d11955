"""Calibrate a Doppler velocity log before a dive: live on ROS 2 Jazzy and over recorded bags."""

__version__ = "0.1.0"
