"""Speed and memory as ratios against a peer in the same run."""

from __future__ import annotations

import argparse

NAME = "benchmark"
HELP = "speed and memory, as ratios against a peer in the same run"
EXAMPLE = "dvl-calib benchmark batch replay"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""


def run(arguments: argparse.Namespace) -> int:
    """Run."""
    return 0
