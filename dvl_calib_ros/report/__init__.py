"""Reports that people read: one self-contained HTML file from a replay or an evaluation.

Needs matplotlib and jinja2; nothing else in the package imports this, the commands do so when a report is asked for.
"""

from .evaluation_report import write_evaluation_report
from .replay_report import write_replay_report

__all__ = ["write_evaluation_report", "write_replay_report"]
